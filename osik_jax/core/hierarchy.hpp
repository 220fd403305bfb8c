// A hierarchy of least-squares problems, solved level by level: the candidate that solvers/hqp certifies.
//
//   level k:  min 1/2 |w_k|^2 + 1/2 damping_k |x|^2   over the minimisers of the levels above it,
//             w_k = A_k x - clip(A_k x, lower_k, upper_k),   inside the hard rows
//
// The hard rows q are the box (q < n, rows of the identity) and, from q = n on, the rows of earlier levels that have
// inequalities. The JAX functions that this file equals are solve_cascade (solvers/hqp/_cascade.py),
// solve_on_working_set, primal_active_set and freeze (docs/dev/derivations.md, "The freezing rule").
//
// One orthonormal basis Z [h, n] goes through all levels. Row q is N_q Z, N_q the q-th hard row; the first n rows are
// Z itself. Its columns are
//   [0, first_active)           frozen by the levels above
//   [first_active, first_free)  spanned by the active hard rows of this level
//   [first_free, n)             free: the level's rows are factored in these, R = A Z
#pragma once
#include "constants.hpp"
#include "workspace.hpp"

namespace osik {

// Sizes of all problems of a call.
struct Sizes {
  int L, m, n, h, max_iterations;  // levels, rows of the longest level, variables, hard rows
  const int* row_counts;           // [L] rows of each level
  const int* level_of_hard;        // [h] level of each hard row, -1 for the box
  const int* row_of_hard;          // [h - n] index of each hard row among the rows of its level
};

// The data of one problem. Entry i of row a of level k is at matrix[(first + a) row + i column], where `first` is k m,
// or the number of rows of the earlier levels if the levels are packed.
struct Problem {
  const double *matrix, *lower, *upper;             // [L, m, n], [L, m], [L, m]
  const double *hard, *hard_lower, *hard_upper;     // [h - n, n], [h], [h]
  const double *damping, *bends, *tolerances;       // [L, 3] constant, unmet, demand; [L, n]; [4] rank, step, multiplier,
                                                    // feasible
  const int *equality, *pinned;                     // [L, m], [h] flags
  const int *guess_hard, *guess_own;                // [L, h], [L, m] working sets of the warm start; 0 for none
  int row, column;
  bool packed;
};

// The results of one problem. Sides are -1 (lower), 1 (upper) or 2 (equality or pinned), 0 for inactive.
struct Answer {
  double *x, *multipliers, *slack_norms, *dampings, *residual;          // [n], [L, h], [L], [L], [1]
  int *active_bounds, *active, *frozen, *in_cost, *own, *ranks, *report;  // [n], [L, h], [L, h], [L, m], [L, m], [L],
                                                                          // [3] done, changes, factorizations
};

// Move to the data of the next problem of a batch, `by` problems further.
OSIK_FN void advance(Problem& p, const Sizes& s, size_t by = 1) {
  const size_t L = s.L, m = s.m, n = s.n, h = s.h;
  size_t rows = L * m;
  if (p.packed) {
    rows = 0;
    for (int k = 0; k < s.L; ++k) rows += s.row_counts[k];
  }
  p.matrix += by * rows * n, p.lower += by * L * m, p.upper += by * L * m, p.hard += by * (h - n) * n;
  p.hard_lower += by * h, p.hard_upper += by * h, p.damping += by * 3 * L, p.bends += by * L * n, p.tolerances += by * 4;
  p.equality += by * L * m, p.pinned += by * h, p.guess_hard += by * L * h, p.guess_own += by * L * m;
}
OSIK_FN void advance(Answer& a, const Sizes& s, size_t by = 1) {
  const size_t L = s.L, m = s.m, n = s.n, h = s.h;
  a.x += by * n, a.multipliers += by * L * h, a.slack_norms += by * L, a.dampings += by * L, a.residual += by;
  a.active_bounds += by * n, a.active += by * L * h, a.frozen += by * L * h, a.in_cost += by * L * m;
  a.own += by * L * m, a.ranks += by * L, a.report += by * 3;
}

template <class Team> struct Hierarchy {
  using Int = typename Team::Int;
  using Algebra = LinearAlgebra<Team>;
  Team t;
  Sizes size;
  // n, m, h as above; strides of the basis and of the level's factors; strides of A; the current level and its rows
  int n, m, h, ld, lm, row, column, level, rows;
  int first_active, first_free, rank, first_row, changes, factorizations;
  bool has_inequalities;
  double longest, longest_square, frobenius;  // norms of the level's longest row (with the damping) and of its matrix
  double damping, unmet, demand;              // of the level: total, the part of unmet tasks, the norm of its targets
  double x_max, slack_norm, root_cost, gradient_norm, residual;
  double largest;  // x_max of the largest guess from which the search of a level went on
  double rank_tol, step_tol, multiplier_tol, feasible_tol;
  const double* A;  // the level's rows, entry i of row a at A[a row + i column]

  // ---- the workspace
  using Space = Workspace<Hierarchy, Team, Sizes>;
  static constexpr int VECTORS = 19, MATRICES = 5, INTEGERS = 13;
  static constexpr OSIK_HOST int width(const Sizes& s) {
    const int n = Team::variables(s.n), m = Team::level_rows(s.m), h = Team::hard_rows(s.h);
    return Team::stride(h > m ? h : m > n ? m : n);
  }
  static constexpr OSIK_HOST int numbers_of(int matrix, const Sizes& s) {
    const int n = Team::variables(s.n), m = Team::level_rows(s.m), h = Team::hard_rows(s.h), ld = Team::stride(n);
    const int of_factors = m * Team::stride(m) + (Team::COPIES ? 8 : 0);  // their last row is read on
    const int numbers[] = {h * ld, m * ld, (h - n) * ld, Team::COPIES ? m * ld : 0, of_factors};
    return numbers[matrix];
  }
  static constexpr OSIK_HOST int bytes(const Sizes& s) { return Space::bytes(s, INTEGERS * width(s)); }
  char* space;
  OSIK_PLACED(Matrix, 0, Z);       // [h, ld] the basis
  OSIK_PLACED(Matrix, 1, R);       // [m, ld] the level's rows in the basis
  OSIK_PLACED(Matrix, 2, hard);    // [h - n, ld] hard rows beside the box
  OSIK_PLACED(Matrix, 3, copied);  // [m, ld] the level's rows, padded, if the team copies them
  OSIK_PLACED(Matrix, 4, V);       // [m, lm] reflections above the diagonal
  OSIK_PLACED(Matrix, 4, S);       // the same one: a Cholesky factor below the diagonal
  // vectors, as long as the longest of n, m and h
  OSIK_PLACED(Numbers, 0, X, START, STEP, WORK, DOWNHILL, CURVATURE, HARD_LOWER, HARD_UPPER, HARD_NORM, MULTIPLIER, LOWER,
              UPPER, ROW_NORM, VALUE, SLACK, RATE, RIGHT, SCALE, INVERSE);
  OSIK_PLACED(Numbers, 4, DIAGONAL);  // in the place of DOWNHILL: a Gram matrix is factored before multipliers are computed
  OSIK_PLACED(Labels, 0, ACTIVE, ACTIVE_ABOVE, FROZEN, PENDING, FREEZES, EQUALITY, IN_COST, OWN, PIVOT, NONZERO, NONZERO_END,
              ACTIVE_BOUND, ACTIVE_ROW);

  OSIK_FN Hierarchy(const Sizes& s, char* space)
      : size(s), n(s.n), m(s.m), h(s.h), ld(Team::stride(Team::variables(n))), lm(Team::stride(Team::level_rows(m))),
        row(ld), column(1), space(space) {}

  // ---- single rows
  OSIK_FN double hard_value(int q, const double* d) const {
    return q < n ? d[q] : t.own_dot_on(hard + (q - n) * ld, d, 0, n);
  }
  OSIK_FN double target(int a, double value) const { return EQUALITY[a] ? LOWER[a] : clip(value, LOWER[a], UPPER[a]); }
  OSIK_FN bool may_block(int q) const { return !FROZEN[q] && size.level_of_hard[q] < level; }
  OSIK_FN double row_value(int a, const double* d) const {
    return t.own_row(A + a * row, d, NONZERO[a], NONZERO_END[a], n, column);
  }
  OSIK_FN void copy(const double* a, double* b, int count) { Algebra::copy(t, a, b, count); }
  OSIK_FN void copy(const Int* a, Int* b, int count) { Algebra::copy(t, a, b, count); }

  // ---- the basis
  // out = Z WORK over the columns [start, stop)
  OSIK_FN void from_basis(int start, int stop, double* out) { Algebra::times(t, Z, WORK, out, ld, start, stop, n); }
  // out = Z' a in the columns from `start` on
  OSIK_FN void to_basis(int start, const double* a, double* out) { Algebra::transposed_times(t, Z, a, out, ld, start, n); }
  // M (I - scale v v') for the rows [first, stop) of M, from column `at` on
  OSIK_FN void reflect(double* M, int first, int stop, const double* v, double scale, int at) {
    t.reflect(M + first * ld, ld, stop - first, v, scale, at, n);
  }

  // ---- factors
  // R R' over the columns from `start` on, to DIAGONAL and the upper or the lower triangle of S; returns the trace
  OSIK_FN double gram(int count, int start, bool lower) {
    Algebra::gram(t, R, S, DIAGONAL, ld, lm, count, start, n, lower);
    return t.sum(0, count, [&](int a) { return DIAGONAL[a]; });
  }
  OSIK_FN double gram_of_columns(int start) {  // R'R of the columns from `start` on, in the same way, to the upper triangle
    Algebra::product(t, R + start, 1, ld, R + start, ld, S, lm, n - start, rows, n - start, true);
    t.each(0, n - start, [&](int j) { DIAGONAL[j] = S[j * lm + j]; });
    return t.sum(0, n - start, [&](int j) { return DIAGONAL[j]; });
  }
  OSIK_FN void cholesky(int count, double ridge, bool lower) {
    Algebra::cholesky(t, S, DIAGONAL, INVERSE, lm, count, ridge, lower);
  }
  OSIK_FN void rows_in_basis(int start) {  // R = A Z for the rows in the cost
    Algebra::rows_times_basis(t, A, row, column, Z, R, ld, IN_COST, NONZERO, NONZERO_END, rows, start, n);
  }
  // Rotate the active hard rows into the columns [first_active, first_free). A row that depends on the frozen rows and
  // the rows before it leaves the active set.
  OSIK_METHOD void factor_active_rows() {
    copy(ACTIVE, PENDING, h);
    first_free = first_active;
    while (first_free < n) {
      // squared distance of the unit row from the span of frozen rows and of the pivots so far
      const Best<double> b = t.best(-1.0, 0, h, [&](int q) {
        if (!PENDING[q]) return -1.0;
        const double outside = t.own_dot_on(Z + q * ld, Z + q * ld, first_free, n);
        return q < n ? outside : outside / (HARD_NORM[q] * HARD_NORM[q]);
      });
      if (!(b.value > rank_tol * rank_tol)) break;
      rotate_active_row(b.which);
      t.once([&] { PENDING[b.which] = 0; });
    }
    t.each(0, h, [&](int q) { ACTIVE[q] = PENDING[q] ? 0 : ACTIVE[q]; });
  }
  // Rotate hard row q, as it is outside of the active rows so far, into column first_free.
  OSIK_FN void rotate_active_row(int q) {
    const double scale = Algebra::reflection(t, Z + q * ld, first_free, n, WORK);
    reflect(Z, 0, h, WORK, scale, first_free);
    t.once([&] { ACTIVE_ROW[first_free - first_active] = q; });
    ++first_free;
  }
  // Add one row to the factors of the active rows, which leaves the active set if it depends on them.
  OSIK_METHOD void add_active_row(int q) {
    const double outside = t.dot(Z + q * ld, Z + q * ld, first_free, n);
    if (first_free < n && outside > rank_tol * rank_tol * HARD_NORM[q] * HARD_NORM[q]) rotate_active_row(q);
    else t.once([&] { ACTIVE[q] = 0; });
  }
  // Remove one row from the factors: the rows after it are rotated anew.
  OSIK_METHOD void remove_active_row(int q) {
    const int count = first_free - first_active;
    const int place = t.best(-1.0, 0, count, [&](int k) { return ACTIVE_ROW[k] == q ? 1.0 : -1.0; }).which;
    if (place < 0) return;
    first_free = first_active + place;
    for (int k = place + 1; k < count; ++k) add_active_row(ACTIVE_ROW[k]);
  }
  // Q' (A Z) = R by reflections with column pivoting, in the free columns
  OSIK_METHOD void factor_level_rows() {
    ++factorizations;
    rows_in_basis(first_free);
    // With damping the step has a curvature in every direction: it uses all pivots above roundoff. A row that is left
    // out of the step stays in the gradient, and the two would contradict each other where a bound is released.
    const double least = (damping > 0.0 ? DAMPED_RANK : rank_tol) * longest;
    rank = Algebra::pivoted_qr(t, R, V, V, WORK, SCALE, PIVOT, ld, lm, rows, first_free, n, least);
    if (damping > 0.0) {
      gram(rank, first_free, true);
      cholesky(rank, damping + FACTOR_RIDGE * longest * longest, true);
    }
  }
  // The number of pivots above the rank tolerance: the rows that the level determines for the levels below.
  OSIK_FN int determined_rank() const {
    return t.count(0, rank, [&](int k) { return fabs(R[k * ld + PIVOT[k]]) > rank_tol * longest; });
  }
  // Move the columns that the level determines in front of the free columns, for the levels below.
  OSIK_METHOD void freeze_columns() {
    first_active = first_free + rank;
    if (first_active == n) return;
    for (int k = 0; k < rank; ++k) {
      const double scale = Algebra::reflection(t, R + k * ld, first_free + k, n, WORK);
      reflect(Z, 0, h, WORK, scale, first_free + k);
      reflect(R, k + 1, rank, WORK, scale, first_free + k);
    }
  }

  // ---- steps and multipliers
  // the step d in the free columns that minimises 1/2 |slack + A d|^2 + 1/2 damping |x + d|^2
  OSIK_METHOD void least_squares_step() {
    double* y = RIGHT;
    t.each(0, rows, [&](int a) { y[a] = IN_COST[a] ? -SLACK[a] : 0.0; });
    for (int k = 0; k < rank; ++k) {
      const double by = -SCALE[k] * t.dot(V + k * lm, y, k, rows);
      t.axpy(y, by, V + k * lm, k, rows);
    }
    if (damping > 0.0) {
      to_basis(first_free, X, DOWNHILL);
      t.each(0, rank, [&](int k) { y[k] += t.own_dot_on(R + k * ld, DOWNHILL, first_free, n); });
      t.forward(S, lm, INVERSE, y, rank);
      t.backward(S, lm, INVERSE, y, rank);
      t.columns(first_free, n, [&](auto c) {
        auto total = typename decltype(c)::P(0.0);
        total.fma(-1.0, c.load(DOWNHILL));
        for (int k = 0; k < rank; ++k) total.fma(y[k], c.load(R + k * ld));
        c.store(WORK, total);
      });
    } else {
      t.each(first_free, n, [&](int j) { WORK[j] = 0.0; });
      for (int k = rank - 1; k >= 0; --k) {
        const double z = y[k] / R[k * ld + PIVOT[k]];
        t.each(0, k + 1, [&](int b) {
          if (b < k) y[b] -= R[b * ld + PIVOT[k]] * z;
          else WORK[PIVOT[k]] = z;
        });
      }
    }
    from_basis(first_free, n, STEP);
  }
  OSIK_FN void restoring_step() {  // the shortest step that brings the active rows to their bounds
    for (int k = 0; k < first_free - first_active; ++k) {
      const int q = ACTIVE_ROW[k], j = first_active + k;
      const double value = q < n ? X[q] : t.dot(hard + (q - n) * ld, X, 0, n);
      const double gap = (ACTIVE[q] < 0 ? HARD_LOWER[q] : HARD_UPPER[q]) - value;
      const double z = (gap - t.dot(Z + q * ld, WORK, first_active, j)) / Z[q * ld + j];
      t.once([&] { WORK[j] = z; });
    }
    from_basis(first_active, first_free, STEP);
  }
  OSIK_METHOD void multipliers() {  // of the active rows, by substitution, and the stationarity residual
    double* gradient = STEP;
    t.columns(0, n, [&](auto c) {
      using P = typename decltype(c)::P;
      P total(0.0);
      total.fma(damping, c.load(X));
      for (int a = 0; a < rows; ++a)
        if (IN_COST[a]) {
          if constexpr (Team::COPIES) total.fma(SLACK[a], c.load(A + a * row));
          else total.fma(SLACK[a], P(A[a * row + c.at * column]));
        }
      c.store(gradient, total);
    });
    gradient_norm = sqrt(t.dot(gradient, gradient, 0, n));
    to_basis(first_active, gradient, DOWNHILL);
    t.each(first_active, n, [&](int j) { WORK[j] = DOWNHILL[j] = -DOWNHILL[j]; });
    residual = t.most(0.0, first_free, n, [&](int j, double) { return fabs(DOWNHILL[j]); });
    t.each(0, h, [&](int q) { MULTIPLIER[q] = 0.0; });
    for (int k = first_free - first_active - 1; k >= 0; --k) {
      const int q = ACTIVE_ROW[k], j = first_active + k;
      const double multiplier = WORK[j] / Z[q * ld + j];
      t.once([&] { MULTIPLIER[q] = multiplier; });
      t.axpy(WORK, -multiplier, Z + q * ld, first_active, j);
    }
  }
  OSIK_METHOD void evaluate() {  // values and slacks at x, their norm, and the root of twice the cost
    x_max = t.most(0.0, 0, n, [&](int i, double) { return fabs(X[i]); });
    t.each(0, rows, [&](int a) {
      VALUE[a] = row_value(a, X);
      SLACK[a] = VALUE[a] - target(a, VALUE[a]);
    });
    const double square = t.dot(SLACK, SLACK, 0, rows);
    slack_norm = sqrt(square);
    root_cost = sqrt(square + damping * t.dot(X, X, 0, n));
  }
  OSIK_FN double slack_roundoff() const { return step_tol * (longest * x_max + root_cost); }
  OSIK_FN double gradient_roundoff() const { return longest * slack_roundoff(); }
  OSIK_FN double sign_tolerance() const { return multiplier_tol * gradient_norm + gradient_roundoff(); }
  OSIK_FN bool is_stationary() const {
    return residual <= STATIONARITY_TOL * (multiplier_tol * longest * root_cost + gradient_roundoff());
  }

  // ---- the working set of the warm start, improved at once a few times
  OSIK_FN void working_set_slack() {
    t.each(0, rows, [&](int a) { SLACK[a] = IN_COST[a] ? row_value(a, X) - (OWN[a] == 1 ? UPPER[a] : LOWER[a]) : 0.0; });
  }
  OSIK_METHOD void solve_on_working_set() {
    copy(START, X, n);
    t.each(0, rows, [&](int a) { IN_COST[a] = OWN[a] != 0; });
    factor_active_rows();
    factor_level_rows();
    for (int again = 0; again < 2; ++again) {  // the second time is a step of refinement against exact residuals
      restoring_step();
      t.axpy(X, 1.0, STEP, 0, n);
      working_set_slack();
      least_squares_step();
      t.axpy(X, 1.0, STEP, 0, n);
    }
    evaluate();
    working_set_slack();
    root_cost = sqrt(t.dot(SLACK, SLACK, 0, rows) + damping * t.dot(X, X, 0, n));
  }
  OSIK_FN static int usable_side(int side, double lower, double upper) {
    if (side < 0 && is_finite(lower)) return -1;
    return side > 0 && is_finite(upper) ? 1 : 0;
  }
  struct Improvement {
    bool feasible, consistent, signs;
    int changes;
  };
  OSIK_FN Improvement improve_working_set() {
    const double tolerance = sign_tolerance();
    const int of_hard = t.count(0, h, [&](int q) {
      if (ACTIVE[q]) {
        if (!(-MULTIPLIER[q] * ACTIVE[q] * HARD_NORM[q] > tolerance)) return 0;
        ACTIVE[q] = 0;
        return 1;
      }
      if (!may_block(q)) return 0;
      const double value = hard_value(q, X), near = feasible_tol * (HARD_NORM[q] * x_max + fabs(value));
      if (larger(HARD_LOWER[q] - value, value - HARD_UPPER[q]) <= near) return 0;
      ACTIVE[q] = value < HARD_LOWER[q] ? -1 : 1;
      return 1 << 12;
    });
    const int of_own = t.count(0, rows, [&](int a) {
      const double near = feasible_tol * (ROW_NORM[a] * x_max + fabs(VALUE[a]));
      const double below = LOWER[a] - VALUE[a], above = VALUE[a] - UPPER[a];
      const int own = OWN[a];
      // of a row that is not in the cost, no violation; of one that is, no place inside its interval
      if (own == 2 || (own == 0 ? larger(below, above) <= near : (own < 0 ? below : above) >= -near)) return 0;
      OWN[a] = own != 0 ? 0 : below > above ? -1 : 1;
      return 1;
    });
    return {of_hard < 1 << 12, of_own == 0, (of_hard & 0xfff) == 0, (of_hard & 0xfff) + (of_hard >> 12) + of_own};
  }
  // whether the point is optimal; `factored`: whether the factors are those of its working set
  OSIK_METHOD bool try_guess(const int* guess_hard, const int* guess_own, bool& factored) {
    t.each(0, h, [&](int q) {
      ACTIVE_ABOVE[q] = ACTIVE[q];
      ACTIVE[q] = may_block(q) ? usable_side(guess_hard[q], HARD_LOWER[q], HARD_UPPER[q]) : 0;
    });
    t.each(0, rows, [&](int a) { OWN[a] = EQUALITY[a] ? 2 : usable_side(guess_own[a], LOWER[a], UPPER[a]); });
    bool feasible = false;
    for (int attempt = 0; attempt < MAX_ATTEMPTS; ++attempt) {
      solve_on_working_set();
      if (!is_finite(x_max)) {
        feasible = false;
        break;
      }
      multipliers();
      copy(ACTIVE, PENDING, h);
      const Improvement now = improve_working_set();
      feasible = now.feasible;
      if (now.feasible && now.consistent && now.signs && is_stationary()) {
        largest = larger(largest, x_max);
        return factored = true;
      }
      if (now.changes == 0 || attempt + 1 == MAX_ATTEMPTS) {
        copy(PENDING, ACTIVE, h);
        break;
      }
      changes += now.changes;
    }
    if (feasible) largest = larger(largest, x_max);
    else {
      copy(START, X, n);
      copy(ACTIVE_ABOVE, ACTIVE, h);
    }
    factored = feasible;
    return false;
  }

  // ---- the primal active-set method
  // derivative at s of the level's cost along x + s d
  OSIK_FN double line_derivative(double s, double damping_x, double damping_d) const {
    double total = damping_x + s * damping_d;
    for (int a = 0; a < rows; ++a) {
      const double value = VALUE[a] + s * RATE[a];
      total += RATE[a] * (value - target(a, value));
    }
    return total;
  }
  OSIK_METHOD double line_search(double damping_x, double damping_d) {
    auto knot = [&](int e) {
      const int a = e / 2;
      const double bound = e % 2 ? UPPER[a] : LOWER[a];
      if (e == 2 * rows || RATE[a] == 0.0 || !is_finite(bound)) return 1.0;
      return larger(0.0, (bound - VALUE[a]) / RATE[a]);
    };
    const double before = t.most(0.0, 0, 2 * rows + 1, [&](int e, double so_far) {
      const double s = knot(e);
      return s > so_far && line_derivative(s, damping_x, damping_d) < 0.0 ? s : 0.0;
    });
    const double after = -t.most(-INFINITE, 0, 2 * rows + 1, [&](int e, double) {
      const double s = knot(e);
      return s > before ? -s : -INFINITE;
    });
    const double probe = is_finite(after) ? 0.5 * (before + after) : before + 1.0;
    const double first = line_derivative(before, damping_x, damping_d);
    const double second = line_derivative(probe, damping_x, damping_d);
    return second > first ? larger(0.0, before - first * (probe - before) / (second - first)) : before;
  }
  OSIK_METHOD bool primal_active_set(bool factored) {
    int stalled = 0;
    int added = -1, removed = -1;
    bool weak_tried = false, stays = false;
    for (int iteration = 0; iteration < size.max_iterations; ++iteration) {
      evaluate();
      const bool active_changed = !factored || added >= 0 || removed >= 0;
      if (!factored) factor_active_rows();
      else if (added >= 0) add_active_row(added);
      else if (removed >= 0) remove_active_row(removed);
      const int other = t.count(0, rows, [&](int a) {
        const int in_cost = EQUALITY[a] || SLACK[a] != 0.0, is_other = in_cost != IN_COST[a];
        IN_COST[a] = in_cost;
        return is_other;
      });
      if (active_changed || other) factor_level_rows();
      factored = true, added = removed = -1;
      least_squares_step();
      t.each(0, rows, [&](int a) { RATE[a] = row_value(a, STEP); });
      const double square = t.sum(0, rows, [&](int a) { return IN_COST[a] ? RATE[a] * RATE[a] : 0.0; });
      const double step_square = t.dot(STEP, STEP, 0, n);
      const double damping_x = damping * t.dot(X, STEP, 0, n), damping_d = damping * step_square;
      // a step that is roundoff is no descent direction, and the line search would stay where it is
      const bool descends = t.dot(RATE, SLACK, 0, rows) + damping_x < 0.0;
      bool weak = false;
      if (stays || !descends || sqrt(square + damping_d) <= step_tol * (longest * x_max + root_cost)) {
        multipliers();
        weak = !weak_tried && !is_stationary();
        if (!weak) {
          const double tolerance = sign_tolerance();
          const bool least_index = stalled > MAX_STALLED;
          const Best<double> b = t.best(0.0, 0, h, [&](int q) {
            const double wrong = ACTIVE[q] ? -MULTIPLIER[q] * ACTIVE[q] * HARD_NORM[q] : 0.0;
            return wrong > tolerance ? (least_index ? 1.0 : wrong) : 0.0;
          });
          if (b.which < 0) return true;
          t.once([&] { ACTIVE[b.which] = 0; });
          removed = b.which, stays = false, ++changes;
          continue;
        }
        weak_tried = true;
        const double by = 1.0 / (EXTRA_DAMPING * longest * longest + damping);
        t.each(first_free, n, [&](int j) { WORK[j] = DOWNHILL[j] * by; });
        from_basis(first_free, n, STEP);
      }
      const double step_norm = sqrt(weak ? t.dot(STEP, STEP, 0, n) : step_square);
      const Best<double> b = t.best(-INFINITE, 0, h, [&](int q) {  // the shortest step to a hard row that blocks
        if (ACTIVE[q] || !may_block(q)) return -INFINITE;
        const double rate = hard_value(q, STEP);
        if (!(fabs(rate) > rank_tol * step_norm * HARD_NORM[q])) return -INFINITE;
        const double gap = (rate > 0.0 ? HARD_UPPER[q] : HARD_LOWER[q]) - hard_value(q, X);
        return -larger(0.0, gap / rate);
      });
      const double shortest = -b.value;
      const double ideal = has_inequalities && !weak ? line_search(damping_x, damping_d) : 1.0;
      const bool blocked = shortest <= ideal;
      const double length = blocked ? shortest : ideal;
      const double moved = t.most(0.0, 0, n, [&](int i, double) { return length * fabs(STEP[i]); });
      if (blocked) {
        const double rate = b.which < n ? STEP[b.which] : t.dot(hard + (b.which - n) * ld, STEP, 0, n);
        t.once([&] { ACTIVE[b.which] = rate > 0.0 ? 1 : -1; });
        ++changes, added = b.which, weak_tried = false;
      }
      t.axpy(X, length, STEP, 0, n);
      stalled = moved > 0.0 ? 0 : stalled + 1;
      stays = !blocked && moved <= EPSILON * x_max;  // a row at its bound to roundoff holds the line search up
    }
    return false;
  }

  // ---- damping of a level, and the box that it leaves to those below
  // one sweep that projects base + Z WORK onto each violated row of the levels above in turn
  OSIK_FN void stay_inside(const double* base) {
    for (int q = n; q < h; ++q) {
      if (!may_block(q)) continue;
      const double square = t.dot(Z + q * ld, Z + q * ld, first_active, n);
      if (!(square > BLOCKING_PART * BLOCKING_PART * HARD_NORM[q] * HARD_NORM[q])) continue;
      const double value = t.dot(hard + (q - n) * ld, base, 0, n) + t.dot(Z + q * ld, WORK, first_active, n);
      const double gap = clip(value, HARD_LOWER[q], HARD_UPPER[q]) - value;
      t.axpy(WORK, gap / square, Z + q * ld, first_active, n);
    }
  }
  OSIK_METHOD double level_damping(double constant) {
    const double least = NEGLIGIBLE_DAMPING * longest_square;
    double total = constant;
    if (unmet > least) {
      double ratio = 1.0, before = 0.0;
      double *base = START, *end = STEP, *goal = RATE;
      to_basis(first_active, X, WORK);
      from_basis(first_active, n, STEP);
      t.each(0, n, [&](int i) { base[i] = X[i] - STEP[i]; });
      // where a row stands on its bound, roundoff must not decide whether the step has to keep it there
      const double tie = TIE_ROUNDOFF * EPSILON * t.most(0.0, 0, n, [&](int i, double) { return fabs(X[i]); });
      t.each(0, rows, [&](int a) {
        const double value = row_value(a, base), miss = target(a, value) - value;
        IN_COST[a] = EQUALITY[a] || fabs(miss) > tie * ROW_NORM[a];
        goal[a] = IN_COST[a] ? miss : 0.0;
      });
      rows_in_basis(first_active);
      const int free = n - first_active, in_cost = t.count(0, rows, [&](int a) { return IN_COST[a] != 0; });
      const bool by_columns = free < in_cost;  // rows that are not in the cost are 0, and R'R may be singular beside them
      const int count = by_columns ? free : rows;
      if (by_columns) {
        Algebra::combine(t, R + first_active, goal, SLACK, ld, rows, 0, free, false);
        goal = SLACK;
      }
      const double trace = by_columns ? gram_of_columns(first_active) : gram(rows, first_active, false);
      for (int again = 0; again < DAMPING_ITERATIONS && ratio != before && unmet * ratio > least; ++again) {
        // the damped step d = R' (R R' + damping I)^-1 goal = (R'R + damping I)^-1 R' goal, clipped into the box
        before = ratio;
        const double ridge = constant + unmet * ratio + DAMPING_RIDGE * trace;
        cholesky(count, ridge > 0.0 ? ridge : 1.0, false);
        copy(goal, RIGHT, count);
        t.forward(S, lm, INVERSE, RIGHT, count);
        t.backward(S, lm, INVERSE, RIGHT, count);
        if (by_columns) copy(RIGHT, WORK + first_active, free);
        else Algebra::combine(t, R + first_active, RIGHT, WORK + first_active, ld, rows, 0, free, false);
        stay_inside(base);
        from_basis(first_active, n, end);
        t.each(0, n, [&](int i) { end[i] = clip(base[i] + end[i], HARD_LOWER[i], HARD_UPPER[i]); });
        const double square = t.sum(0, rows, [&](int a) {
          const double value = row_value(a, end), miss = value - target(a, value);
          return miss * miss;
        });
        ratio = sqrt(square) / (demand > 0.0 ? demand : 1.0);
        ratio = ratio < 1.0 ? ratio : 1.0;
      }
      total = constant + unmet * ratio;
    }
    return total > least ? total : 0.0;
  }
  OSIK_METHOD void narrow_box(const double* bends) {
    const double missed = slack_norm < demand ? slack_norm : demand, ratio = missed / (demand > 0.0 ? demand : 1.0);
    t.each(0, n, [&](int i) { CURVATURE[i] = larger(CURVATURE[i], bends[i] / (frobenius > 0.0 ? frobenius : 1.0)); });
    if (!(unmet * ratio > NEGLIGIBLE_DAMPING * longest_square)) return;
    const double by = missed * frobenius;
    const double least = NEGLIGIBLE_CURVATURE * t.most(0.0, 0, n, [&](int i, double) { return by * CURVATURE[i]; });
    const int count = t.count(0, n, [&](int i) { return by * CURVATURE[i] > least; });
    const double gain = COST_FRACTION * (demand - missed) * (demand + missed);
    t.each(0, n, [&](int i) {
      const double cost = by * CURVATURE[i];
      if (!(cost > least)) return;
      const double room = sqrt(gain / (count * cost)) + MIN_RADIUS;
      HARD_LOWER[i] = larger(HARD_LOWER[i], X[i] - room);
      HARD_UPPER[i] = -larger(-HARD_UPPER[i], -X[i] - room);
    });
  }

  // ---- the levels
  OSIK_METHOD void begin(const Problem& p) {
    largest = 0.0;
    t.each(0, h, [&](int q) {
      ACTIVE[q] = 0, HARD_NORM[q] = 1.0, HARD_LOWER[q] = p.hard_lower[q], HARD_UPPER[q] = p.hard_upper[q];
      for (int j = 0; j < ld; ++j) Z[q * ld + j] = 0.0;
      const int pinned = q < n && p.pinned[q] != 0;
      FROZEN[q] = pinned;
      if (q < n) CURVATURE[q] = 0.0, X[q] = clip(0.0, p.hard_lower[q], p.hard_upper[q]), ACTIVE_BOUND[q] = 2 * pinned;
    });
    first_active = t.count(0, n, [&](int i) { return FROZEN[i] != 0; });
    t.once([&] {
      int next = first_active;
      for (int i = 0; i < n; ++i)
        if (!FROZEN[i]) Z[i * ld + next++] = 1.0;
    });
    for (int q = n; q < h; ++q) {
      double* r = hard + (q - n) * ld;
      copy(p.hard + (q - n) * n, r, n);
      to_basis(first_active, r, Z + q * ld);
      const double norm = sqrt(t.dot(r, r, 0, n));
      t.once([&] { HARD_NORM[q] = norm > 0.0 ? norm : 1.0; });
    }
  }
  OSIK_METHOD void begin_level(const Problem& p) {
    const int at = level * m;
    if constexpr (Team::COPIES) {
      A = copied;
      for (int a = 0; a < rows; ++a) copy(p.matrix + (at + a) * n, copied + a * ld, n);
    } else A = p.matrix + (p.packed ? first_row : at) * p.row, row = p.row, column = p.column;
    t.nonzero(A, row, column, rows, n, NONZERO, NONZERO_END);
    t.each(0, rows, [&](int a) {
      const double square = t.own_square(A + a * row, NONZERO[a], NONZERO_END[a], column);
      LOWER[a] = p.lower[at + a], UPPER[a] = p.upper[at + a], EQUALITY[a] = p.equality[at + a];
      ROW_NORM[a] = sqrt(square), VALUE[a] = square;
    });
    longest_square = t.most(0.0, 0, rows, [&](int a, double) { return VALUE[a]; });
    frobenius = sqrt(t.sum(0, rows, [&](int a) { return VALUE[a]; }));
    longest = sqrt(longest_square);
    damping = level_damping(p.damping[3 * level]);
    longest = larger(longest, sqrt(damping));
    copy(X, START, n);
  }
  // active rows with a multiplier, and own rows that miss their interval, are frozen; returns the rank in the cost
  OSIK_METHOD int freeze(const Answer& to) {
    const int at = level * m, hard_at = level * h;
    evaluate();
    const double force_tol = sign_tolerance() + damping * sqrt(t.dot(X, X, 0, n)), roundoff = slack_roundoff();
    const bool same_cost = 0 == t.count(0, rows, [&](int a) {  // a short row has the roundoff of the longest one
      const double slack_tol = larger(multiplier_tol * (ROW_NORM[a] * x_max + root_cost), roundoff);
      const int now = EQUALITY[a] || fabs(SLACK[a]) > slack_tol, other = now != IN_COST[a];
      IN_COST[a] = now;
      to.in_cost[at + a] = now ? (SLACK[a] > 0.0 ? 1 : -1) : 0;
      to.own[at + a] = EQUALITY[a] ? 2 : to.in_cost[at + a];
      return other;
    });
    const bool all_freeze = 0 == t.count(0, h, [&](int q) {
      FREEZES[q] = ACTIVE[q] && fabs(MULTIPLIER[q]) * HARD_NORM[q] > force_tol;
      to.active[hard_at + q] = ACTIVE[q], to.multipliers[hard_at + q] = MULTIPLIER[q];
      return FREEZES[q] != (ACTIVE[q] != 0);
    });
    const int before = determined_rank();
    if (!(same_cost && all_freeze)) {  // the level's own factors serve where they have just the rows that are frozen
      t.each(0, h, [&](int q) { ACTIVE[q] = FREEZES[q] ? ACTIVE[q] : 0; });
      factor_active_rows();
      factor_level_rows();
    }
    rank = determined_rank();
    const bool tie = same_cost && rank != before && damping == 0.0;
    t.each(0, h, [&](int q) {
      const int active = to.active[hard_at + q];
      to.frozen[hard_at + q] = FREEZES[q] || tie ? active : 0;
      if (q < n) ACTIVE_BOUND[q] = active ? active : FROZEN[q] ? ACTIVE_BOUND[q] : 0;
      else if (size.level_of_hard[q] == level) {  // levels below may not make a row of this one worse than it is
        const double value = hard_value(q, X);
        HARD_LOWER[q] = value < HARD_LOWER[q] ? value : HARD_LOWER[q], HARD_UPPER[q] = larger(HARD_UPPER[q], value);
        FROZEN[q] = FROZEN[q] || IN_COST[size.row_of_hard[q - n]];
      }
      FROZEN[q] = FROZEN[q] || FREEZES[q];
      ACTIVE[q] = FREEZES[q] ? 0 : active;
    });
    return tie ? before : rank;
  }
  // the residual in units of the terms of the level's gradient
  OSIK_FN double relative_residual() const {
    const double terms = longest * larger(longest * x_max, root_cost);
    return residual / (terms > 0.0 ? terms : 1.0);
  }
  // all levels, from the guesses of a warm start or without them; returns whether each is optimal
  OSIK_METHOD bool solve_levels(const Problem& p, const Answer& to, bool warm) {
    const int L = size.L;
    t.each(0, L * h, [&](int e) { to.multipliers[e] = 0.0, to.active[e] = to.frozen[e] = 0; });
    t.each(0, L * m, [&](int e) { to.in_cost[e] = to.own[e] = 0; });
    t.each(0, L, [&](int k) { to.ranks[k] = 0, to.slack_norms[k] = INFINITE, to.dampings[k] = 0.0; });
    begin(p);
    bool done = true;
    double worst = 0.0;
    for (level = first_row = 0; level < L && first_active < n; ++level) {
      rows = size.row_counts[level], unmet = p.damping[3 * level + 1], demand = p.damping[3 * level + 2];
      has_inequalities = t.count(n, h, [&](int q) { return size.level_of_hard[q] == level; }) > 0;
      begin_level(p);
      bool factored = false;
      bool optimal = warm && try_guess(p.guess_hard + level * h, p.guess_own + level * m, factored);
      if (!optimal) optimal = primal_active_set(factored);
      const int in_cost_rank = freeze(to);
      done = done && optimal, worst = larger(worst, relative_residual());
      t.once([&] { to.ranks[level] = in_cost_rank, to.slack_norms[level] = slack_norm, to.dampings[level] = damping; });
      narrow_box(p.bends + level * n);
      freeze_columns();
      first_row += rows;
    }
    t.once([&] { to.residual[0] = worst; });
    return done;
  }
  OSIK_METHOD void solve(const Problem& p, const Answer& to) {
    rank_tol = p.tolerances[0], step_tol = p.tolerances[1], multiplier_tol = p.tolerances[2];
    feasible_tol = p.tolerances[3];
    const bool warm = t.count(0, size.L * m, [&](int e) { return p.guess_own[e] != 0; }) > 0;
    changes = factorizations = 0;
    bool done = false;
    for (bool guessed = warm;; guessed = false) {
      done = solve_levels(p, to, guessed);
      // a guess far beyond the answer has left its roundoff there: all levels are solved again without guesses
      if (!guessed || (done && largest <= MAX_DETOUR * x_max)) break;
    }
    t.each(0, n, [&](int i) {  // a bound that levels narrowed for those below them is none of the box
      const int at = ACTIVE_BOUND[i];
      const bool narrowed = at < 0 ? HARD_LOWER[i] > p.hard_lower[i] : HARD_UPPER[i] < p.hard_upper[i];
      to.x[i] = X[i], to.active_bounds[i] = narrowed ? 0 : at;
    });
    t.once([&] { to.report[0] = done, to.report[1] = changes, to.report[2] = factorizations; });
  }
};
}  // namespace osik
