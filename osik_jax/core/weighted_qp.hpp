// A weighted least-squares problem in a box, with rows that are hard or soft: the candidate that solvers/qp certifies.
//
//   min 1/2 sum_i weight_i (A x - target)_i^2 + 1/2 sum_j damping_j (x_j - center_j)^2 + 1/2 sum_q t_q^2 / compliance_q
//   over lower <= [x; C x + t] <= upper
//
// With B = [sqrt(W) A; C], the compliance E of its rows (1 for those of A), z the residuals of the rows of A and the
// multipliers of those of C, the minimiser on an active set has, over the free variables F,
//
//   D (x - center) = B' z,   B x + E z = target   =>   (B_F D_F^-1 B_F' + E) z = target - B x0,   x = x0 + D_F^-1 B_F' z
//
// where x0 is the center, or the bound of an active variable (Sherman, Morrison, Woodbury): a system as large as the
// rows. With more rows than variables the system is the Hessian's. Either is solved again for what the point leaves of
// the two equations on the left, until that is roundoff; so its factors need not be accurate.
//
// The search: from a guessed active set, all constraints with a wrong label change it at once (block principal
// pivoting, Judice and Pires 1994). Where that stops helping, the dual method (dual_active_set.hpp) begins without
// active constraints; it cannot cycle.
#pragma once
#include "constants.hpp"
#include "dual_active_set.hpp"
#include "workspace.hpp"

namespace osik {

// Sizes of all problems of a call.
struct QPSizes {
  int m, n, p, max_changes;  // rows of A, variables, rows of C; limit on the changes of the active set
};

// The data of one problem; N = n + p constraints.
template <class Real> struct QPData {
  const Real *matrix, *target, *weight, *damping, *center;  // [m, n], [m], [m], [n], [n]
  const Real *rows, *compliance, *lower, *upper;            // [p, n], [p], [N], [N]
  const int* guess;                                         // [N] labels of the active set to try first
  Real tolerance;                                           // relative violation that counts as none
};

// The results of one problem.
template <class Real> struct QPAnswer {
  Real *x, *multipliers;  // [n], [p] multipliers of the rows of C
  int *active, *report;   // [N] labels; [3] Outcome (qp_certificate.hpp), changes, factorizations
};

template <class Team> struct WeightedQP {
  using Real = typename Team::Real;
  using Int = typename Team::Int;
  using Algebra = LinearAlgebra<Team>;
  using Data = QPData<Real>;
  using Answer = QPAnswer<Real>;
  static constexpr Real EPS = sizeof(Real) == 8 ? EPSILON : 1.1920929e-07;
  static constexpr bool IS_SINGLE = sizeof(Real) == 4;
  static constexpr Real VIOLATION = IS_SINGLE ? VIOLATION_TOL : 1;
  static constexpr Real RELEASE = IS_SINGLE ? SINGLE_BOUND_MULTIPLIER : BOUND_MULTIPLIER;
  Team t;
  int max_changes, used, changes, factorizations;  // used: rows in the system of the active set
  Real tolerance;
  const Real *lower, *upper;

  // ---- the workspace, whose numbers begin as zeros
  using Space = Workspace<WeightedQP, Team, QPSizes>;
  static constexpr int VECTORS = Team::SPARES_SPACE ? 19 : 21, MATRICES = 8, INTEGERS = 4;
  static constexpr OSIK_HOST int width(const QPSizes& s) {
    const int k = Team::level_rows(s.m) + Team::hard_rows(s.p), N = Team::variables(s.n) + Team::hard_rows(s.p);
    return Team::stride(k > N ? k : N);
  }
  // the order of the system of the active set. In single precision it is the Hessian's: the rows' needs a damping that is
  // far above roundoff.
  static constexpr OSIK_HOST int order(int k, int n) { return k < n && !IS_SINGLE ? k : n; }
  static constexpr OSIK_HOST int size_of(int which, const QPSizes& s) {
    const int m = Team::level_rows(s.m), n = Team::variables(s.n), p = Team::hard_rows(s.p), k = m + p;
    const int size[] = {m, n, p, k, n + p, Team::stride(n), Team::stride(p), Team::stride(order(k, n))};
    return size[which];
  }
  // the last two matrices are the dual method and an end
  static constexpr OSIK_HOST int numbers_of(int matrix, const QPSizes& s) {
    const int n = Team::variables(s.n), p = Team::hard_rows(s.p), k = Team::level_rows(s.m) + p, q = order(k, n);
    const int kept = q < k || IS_SINGLE ? p : 0;  // rows that are kept where the system is the Hessian's
    const int of_b = k * Team::stride(n), of_v = kept * Team::stride(n);
    const int of_s = q * Team::stride(q), of_t = kept * Team::stride(p), apart = Team::SPARES_SPACE ? 0 : 1;
    const int dual = apart * DualActiveSet<Team>::doubles(n, p);
    const int numbers[] = {of_b, of_v, of_s, apart * of_s, of_t, apart * of_t, dual, Team::stride(0)};
    return numbers[matrix];
  }
  static constexpr OSIK_HOST int bytes(const QPSizes& s) {
    return Space::bytes(s, INTEGERS * width(s) + Team::variables(s.n) + Team::hard_rows(s.p));
  }
  char* space;
  QPSizes size;
  OSIK_PLACED(Size, 0, m, n, p, k, N, ld, lp, lq);  // k: all rows; N: all constraints; strides of n, p and order(k, n)
  OSIK_PLACED(Matrix, 0, B);                                // [k, ld] the rows
  OSIK_PLACED(Matrix, 1, V);  // [p, ld] if the system is the Hessian's: M times active rows of C
  OSIK_PLACED(Matrix, 2, S);  // [q, lq] the system of the active set, q = order(k, n)
  OSIK_PLACED(Matrix, Team::SPARES_SPACE ? 2 : 3, M);  // [q, lq] the inverse of its factor, perhaps in the place of S
  OSIK_PLACED(Matrix, 4, T);  // [p, lp] with V: the Schur complement of the active rows of C
  OSIK_PLACED(Matrix, Team::SPARES_SPACE ? 4 : 5, TM);  // [p, lp] the inverse of its factor
  OSIK_PLACED(Matrix, 6, DUAL);
  // vectors, as long as the longest of k and N
  OSIK_PLACED(Numbers, 0, TARGET, COMPLIANCE, DAMPING, CENTER, ROOT, INVERSE_ROOT, X, Z, STEP, GRADIENT, GAP, RIGHT, SOLVED,
              PIVOT, TERMS, VALUE, VALUE_ROUNDOFF, MULTIPLIER_ROUNDOFF, SMALL_PIVOT);
  OSIK_PLACED(Numbers, 15, INVERSE, DIAGONAL, SMALL);  // while a point is solved for, whose roundoff is found afterwards
  OSIK_PLACED(Numbers, 19, SCALED);  // of a CPU, with the next one [2, ld]
  OSIK_PLACED(Labels, 0, LABEL, NEXT, USED, END, ORDER);  // END: a row of B is 0 from this column on
  DualActiveSet<Team> dual;

  // outside: space of the dual method, if the team spares space
  OSIK_FN WeightedQP(const QPSizes& s, char* space, Real* outside = nullptr)
      : max_changes(s.max_changes), space(space), size(s) {
    dual.begin(n, p, Team::SPARES_SPACE ? outside : DUAL, ORDER);
    t.each(n, width(s), [&](int j) { DAMPING[j] = 1; });  // which has an inverse
  }

  // ---- one problem
  OSIK_CALL void begin(const Data& d) {
    t.fetch_rows(B, ld, d.matrix, m), t.fetch_rows(B + m * ld, ld, d.rows, p);
    t.fetch(GAP, d.weight, m), t.fetch(TARGET, d.target, m), t.fetch(COMPLIANCE + m, d.compliance, p);
    t.fetch(DAMPING, d.damping, n), t.fetch(CENTER, d.center, n);
    lower = d.lower, upper = d.upper, tolerance = d.tolerance, changes = factorizations = 0;
    t.each(0, ld, [&](int j) { X[j] = STEP[j] = GRADIENT[j] = SOLVED[j] = TERMS[j] = RIGHT[j] = 0; });
    t.arrive();
    t.each(0, k, [&](int i) {
      const Real root = i < m ? sqrt(GAP[i]) : Real(1);
      GAP[i] = root, TARGET[i] = i < m ? root * TARGET[i] : 0, Z[i] = 0;
      if (i < m) COMPLIANCE[i] = 1;
    });
    t.scaled_rows(B, ld, GAP, d.matrix, m, n);
    t.scaled_rows(B + m * ld, ld, nullptr, d.rows, p, n);
    t.each(0, k, [&](int i) { END[i] = t.own_end(B + i * ld, n); });
    t.each(n, Team::padded(n), [&](int j) { ROOT[j] = 1; });
    t.columns(0, n, [&](auto c) {
      auto total = c.load(DAMPING);
      OSIK_UNROLL_4
      for (int i = 0; i < m; ++i) total.square(c.load(B + i * ld));
      c.store(ROOT, total);
    });
    t.each(0, Team::padded(n), [&](int j) { ROOT[j] = sqrt(ROOT[j]); });
    t.each(0, Team::padded(n), [&](int j) { INVERSE_ROOT[j] = Real(1) / ROOT[j]; });
  }
  // The guess where the bounds that it names exist. Pinned variables are active, equality rows where guessed.
  OSIK_FN void first_labels(const int* guess, Int* label) {
    t.each(0, N, [&](int i) {
      const Real bound = guess[i] == AT_UPPER ? upper[i] : lower[i];
      const bool active = guess[i] != INACTIVE && fabs(bound) < Real(INFINITE);
      const bool equality = lower[i] == upper[i] && (i < n || guess[i] != INACTIVE);
      label[i] = equality ? EQUALITY : !active ? INACTIVE : guess[i] == AT_UPPER ? AT_UPPER : AT_LOWER;
    });
  }
  OSIK_FN Real bound(int i) const { return LABEL[i] == AT_UPPER ? upper[i] : lower[i]; }
  OSIK_FN Real* row(int a) const { return B + USED[a] * ld; }

  // ---- what a point leaves of the two equations
  OSIK_CALL void find_gap() {  // target - B x for the rows of A, target - B x - E z for those of C
    t.rows_times([&](int i) { return B + i * ld; }, [&](int i) { return END[i]; }, X, GAP, k);
    t.each(0, k, [&](int i) {
      const Real target = i < m ? TARGET[i] : LABEL[n + i - m] == INACTIVE ? 0 : bound(n + i - m) - COMPLIANCE[i] * Z[i];
      GAP[i] = target - GAP[i];
    });
  }
  OSIK_CALL void find_gradient() {  // D (x - center) - B' z, with z the residuals of the rows of A
    find_gap();
    t.each(0, m, [&](int i) { Z[i] = GAP[i]; });
    t.columns(0, n, [&](auto c) {
      auto total = c.load(X);
      total -= c.load(CENTER);
      total *= c.load(DAMPING);
      OSIK_UNROLL_4
      for (int i = 0; i < k; ++i) total.fma(-Z[i], c.load(B + i * ld));
      c.store(GRADIENT, total);
    });
  }
  // Whether a correction is the last: the next one would be far below roundoff if they shrink alike, or it shrinks no more,
  // or too little for a small one. `before`: the size of the one before it; the first of all may be small by chance.
  OSIK_FN bool is_last(int round, Real& before) const {
    const Real moved = t.largest(STEP, ROOT, n), far = t.largest(X, ROOT, n);
    const bool is_roundoff = moved * moved <= CORRECTION * far * before;
    const bool stalls = (round > 1 && moved >= before) ||
                        (moved > Real(MIN_DECREASE) * before && moved <= Real(SMALL_CORRECTION) * far);
    const bool last = before < Real(INFINITE) && (is_roundoff || stalls);
    before = moved;
    return last;
  }
  static constexpr Real CORRECTION = sizeof(Real) == 8 ? KERNEL_CORRECTION : SINGLE_CORRECTION;

  // ---- the minimiser on the active set; returns whether the factors are regular
  OSIK_CALL bool solve_on_active_set() {
    ++factorizations;
    t.each(0, m, [&](int i) { USED[i] = i; });
    used = m;
    for (int i = m; i < k; ++i) {
      const bool in = LABEL[n + i - m] != INACTIVE;
      t.once([&] { in ? void(USED[used] = i) : void(Z[i] = 0); });
      used += in;
    }
    return used <= n && !IS_SINGLE ? solve_by_rows() : solve_by_hessian();
  }
  static constexpr Real RIDGE = IS_SINGLE ? SINGLE_RIDGE * EPS : 0;
  OSIK_CALL bool solve_by_rows() {
    t.columns(0, n, [&](auto c) { c.store(X, c.load(CENTER)), c.store(INVERSE, c.load(DAMPING).inverse()); });
    t.each(0, n, [&](int j) {
      if (LABEL[j] != INACTIVE) X[j] = bound(j), INVERSE[j] = 0;
    });
    t.each(0, k, [&](int i) { Z[i] = 0; });
    find_gap();
    t.each(0, used, [&](int a) { RIGHT[a] = GAP[USED[a]]; });
    t.weighted_gram([&](int a) { return row(a); }, [&](int a) { return END[USED[a]]; }, INVERSE, S, SCALED, lq, ld, used);
    t.each(0, used, [&](int a) { S[a * lq + a] += COMPLIANCE[USED[a]]; });
    if (!Algebra::inverse_factor(t, S, M, PIVOT, DIAGONAL, lq, used, Real(KERNEL_PIVOT) * EPS)) return false;
    t.each(0, n, [&](int j) { GRADIENT[j] = 0; });
    Real before = INFINITE;
    for (int round = 0; round < KERNEL_REFINEMENTS; ++round) {
      Algebra::apply_inverse(t, M, PIVOT, RIGHT, SOLVED, lq, used);
      t.each(0, used, [&](int a) { Z[USED[a]] += RIGHT[a]; });
      t.columns(0, n, [&](auto c) {
        auto total = c.load(GRADIENT);
        for (int a = 0; a < used; ++a) total.fma(-RIGHT[a], c.load(row(a)));
        total *= c.load(INVERSE);
        c.store(STEP, total);
        auto x = c.load(X);
        c.store(X, x -= total);
      });
      find_gradient();
      if (is_last(round, before)) break;
      t.columns(0, n, [&](auto c) {
        auto step = c.load(GRADIENT);
        c.store(STEP, step *= c.load(INVERSE));
      });
      t.rows_times([&](int a) { return row(a); }, [&](int a) { return END[USED[a]]; }, STEP, RIGHT, used);
      t.each(m, used, [&](int a) { RIGHT[a] += GAP[USED[a]]; });
    }
    return true;
  }
  // H_F = B_F' B_F + D_F, with a row and a column of the identity for active variables; V = M C_F' and V D^-1 V' + E
  OSIK_CALL bool factor_hessian() { return invert_hessian() && invert_complement(); }
  OSIK_FN bool invert_hessian() {
    if constexpr (Team::HOLDS_COLUMNS) {
      t.each(0, n, [&](int j) { STEP[j] = LABEL[j] == INACTIVE ? INVERSE_ROOT[j] : Real(0), PIVOT[j] = 1; });
      return t.inverse_factor_of_gram(B, DAMPING, STEP, RIDGE, EPS, M, TERMS, ld, lq);
    }
    if constexpr (Team::SPARES_SPACE)
      t.pairs(n, [&](int a, int b) {
        Real even = 0, odd = 0;
        int i = 0;
        for (; i + 1 < m; i += 2) even += B[i * ld + a] * B[i * ld + b], odd += B[(i + 1) * ld + a] * B[(i + 1) * ld + b];
        S[a * lq + b] = i < m ? even + odd + B[i * ld + a] * B[i * ld + b] : even + odd;
      });
    else Algebra::product(t, B, 1, ld, B, ld, S, lq, n, m, n, true);
    t.each(0, n, [&](int b) {
      const bool free = LABEL[b] == INACTIVE;
      for (int a = 0; a < b; ++a)
        if (!free || LABEL[a] != INACTIVE) S[a * lq + b] = 0;
      S[b * lq + b] = free ? (S[b * lq + b] + DAMPING[b]) * (1 + RIDGE) : Real(1);
    });
    return Algebra::inverse_factor(t, S, M, PIVOT, DIAGONAL, lq, n, EPS);
  }
  OSIK_FN bool invert_complement() {
    for (int a = 0; a < used - m; ++a) {
      t.each(0, n, [&](int j) { STEP[j] = LABEL[j] == INACTIVE ? row(m + a)[j] : Real(0); });
      t.each(0, Team::padded(n), [&](int i) { V[a * ld + i] = i < n ? t.own_dot_on(M + i * lq, STEP, 0, n) : Real(0); });
      t.each(0, n, [&](int j) { STEP[j] = V[a * ld + j] * PIVOT[j]; });
      t.each(0, a + 1, [&](int b) {
        T[b * lp + a] = t.own_dot_on(V + b * ld, STEP, 0, n) + (a == b ? COMPLIANCE[USED[m + a]] : Real(0));
      });
    }
    return Algebra::inverse_factor(t, T, TM, SMALL_PIVOT, DIAGONAL, lp, used - m, Real(KERNEL_PIVOT) * EPS);
  }
  // H_F dx - C_F' dy = -gradient, C_F dx + E dy = gap: (V' D^-1 V + E) dy = gap + V' D^-1 M gradient
  OSIK_CALL bool solve_by_hessian() {
    if (!factor_hessian()) return false;
    const int rows = used - m;
    // in single precision from the point before, towards which corrections may be slow
    t.each(0, n, [&](int j) { X[j] = LABEL[j] != INACTIVE ? bound(j) : IS_SINGLE ? X[j] : Real(0); });
    t.each(m, k, [&](int i) { Z[i] = 0; });
    Real before = INFINITE;
    find_gradient();
    for (int round = 0; round < KERNEL_REFINEMENTS; ++round) {
      t.each(0, n, [&](int j) { RIGHT[j] = LABEL[j] == INACTIVE ? -GRADIENT[j] : Real(0); });
      t.each(0, n, [&](int i) { SOLVED[i] = PIVOT[i] * t.own_dot_on(M + i * lq, RIGHT, 0, i + 1); });
      t.each(0, rows, [&](int a) { SMALL[a] = GAP[USED[m + a]] - t.own_dot_on(V + a * ld, SOLVED, 0, n); });
      Algebra::apply_inverse(t, TM, SMALL_PIVOT, SMALL, TERMS, lp, rows);
      t.each(0, rows, [&](int a) { Z[USED[m + a]] += SMALL[a]; });
      for (int a = 0; a < rows; ++a) t.each(0, n, [&](int i) { SOLVED[i] += PIVOT[i] * SMALL[a] * V[a * ld + i]; });
      t.columns(0, n, [&](auto c) {
        auto total = typename decltype(c)::P(0);
        OSIK_UNROLL_4
        for (int i = 0; i < n; ++i) total.fma(SOLVED[i], c.load(M + i * lq));
        c.store(STEP, total);
      });
      t.each(0, n, [&](int j) { X[j] += STEP[j]; });
      find_gradient();
      if (is_last(round, before)) break;
    }
    return true;
  }

  // ---- roundoff of values and multipliers, as constraint_scales in solvers/qp/_problem.py: invariant to units
  OSIK_CALL void find_roundoff() {
    t.columns(0, n, [&](auto c) {  // the Newton step of the cost, by the diagonal of its Hessian
      auto total = c.load(GRADIENT);
      for (int i = m; i < k; ++i) total.fma(Z[i], c.load(B + i * ld));
      total *= c.load(INVERSE_ROOT);
      c.store(STEP, total *= c.load(INVERSE_ROOT));
    });
    t.each(0, n, [&](int j) { TERMS[j] = 1; });
    Real most = t.largest(X, ROOT, n), longest = t.largest(X, TERMS, n);
    const Real newton_most = t.largest(STEP, ROOT, n);
    if (most <= Real(ZERO_TOL) * EPS * newton_most) most = newton_most, longest = t.largest(STEP, TERMS, n);
    t.each(0, N, [&](int i) {
      Real reach = 0, unit = 1, per_root = 0, value;
      if (i < n) per_root = INVERSE_ROOT[i], value = X[i];
      else {
        const Real* r = B + (m + i - n) * ld;
        value = t.own_dot_on(r, X, 0, n), unit = t.own_size_on(r, TERMS, n), per_root = t.own_size_on(r, INVERSE_ROOT, n);
      }
      reach = most * per_root < longest * unit ? most * per_root : longest * unit;
      const Real low = fabs(lower[i]), high = fabs(upper[i]), nearest = low < high ? low : high;
      const Real scale = reach + fabs(value) + (nearest < Real(INFINITE) ? nearest : Real(0));
      VALUE[i] = value, VALUE_ROUNDOFF[i] = VIOLATION * tolerance * scale;
      if (i >= n) MULTIPLIER_ROUNDOFF[i] = tolerance * scale / square(larger(per_root, Team::SMALLEST_ROOT));
    });
    if (t.count(0, IS_SINGLE ? n : N, [&](int i) { return LABEL[i] != INACTIVE; })) find_gradient_roundoff();
  }
  // of multipliers: of a variable on its bound that of its gradient's terms, of a row the least that shows in a gradient
  OSIK_CALL void find_gradient_roundoff() {
    t.each(0, k, [&](int i) { TERMS[i] = i < m ? fabs(TARGET[i]) + t.own_size_on(B + i * ld, X, n) : fabs(Z[i]); });
    t.columns(0, n, [&](auto c) {
      auto size = c.load(X).size();
      size += c.load(CENTER).size();
      size *= c.load(DAMPING);
      OSIK_UNROLL_4
      for (int i = 0; i < k; ++i) size.fma(TERMS[i], c.load(B + i * ld).size());
      c.store(SOLVED, size);
    });
    t.each(0, n, [&](int j) { MULTIPLIER_ROUNDOFF[j] = RELEASE * EPS * SOLVED[j]; });
    if (IS_SINGLE) return;
    t.each(n, N, [&](int i) {
      const Real* row = B + (m + i - n) * ld;
      for (int j = 0; j < n; ++j)
        if (MULTIPLIER_ROUNDOFF[i] * fabs(row[j]) > MULTIPLIER_ROUNDOFF[j])
          MULTIPLIER_ROUNDOFF[i] = MULTIPLIER_ROUNDOFF[j] / fabs(row[j]);
    });
  }

  // ---- labels
  // what constraint i should be: active where violated, inactive where its multiplier has the wrong sign
  OSIK_FN int right_label(int i) const {
    const int label = LABEL[i];
    if (label == EQUALITY) return EQUALITY;
    if (label == INACTIVE) {
      if (lower[i] == upper[i]) return EQUALITY;
      if (VALUE[i] < lower[i] - VALUE_ROUNDOFF[i]) return AT_LOWER;
      return VALUE[i] > upper[i] + VALUE_ROUNDOFF[i] ? AT_UPPER : INACTIVE;
    }
    const Real multiplier = i < n ? GRADIENT[i] : Z[m + i - n];
    return -label * multiplier < -MULTIPLIER_ROUNDOFF[i] ? INACTIVE : label;
  }
  // whether an inactive constraint is violated that the active ones do not imply (NEXT: 1 for those that they do)
  OSIK_FN bool leaves_out() const {
    return t.count(0, N, [&](int i) { return LABEL[i] == INACTIVE && !NEXT[i] && right_label(i) != INACTIVE; }) > 0;
  }

  // ---- the search; returns whether there is a candidate
  OSIK_CALL bool search() {
    int fewest = N + 1, lives = MAX_EXCHANGES;
    while (true) {
      const bool regular = solve_on_active_set();
      if (regular) find_roundoff();
      const int wrong = t.count(0, N, [&](int i) {
        NEXT[i] = right_label(i);
        return NEXT[i] != LABEL[i];
      });
      if (regular && wrong == 0) return true;
      lives = wrong < fewest ? MAX_EXCHANGES : lives - 1;
      fewest = wrong < fewest ? wrong : fewest;
      if (!regular || lives < 0) return search_dual();
      t.each(0, N, [&](int i) { LABEL[i] = NEXT[i]; });
      changes += wrong;
    }
  }
  // The dual method from the pinned variables alone. Its end, solved anew, may miss a bound: then it goes on.
  OSIK_CALL bool search_dual() {
    t.each(0, N, [&](int i) { LABEL[i] = i < n && lower[i] == upper[i] ? EQUALITY : INACTIVE, NEXT[i] = 0; });
    for (int times = 0;; ++times) {
      if (!solve_on_active_set()) return false;
      find_roundoff();
      if (times > 0 && (times == MAX_DUAL_STARTS || !leaves_out())) break;
      if (times == 0) dual.factor(B, ld, DAMPING, lower, upper, m);
      const int steps = dual.run(
          {B + m * ld, COMPLIANCE + m, lower, upper, VALUE_ROUNDOFF, X, Z + m, ld, max_changes - changes}, LABEL, NEXT);
      if (steps < 0) return false;
      changes += steps;
    }
    t.each(0, N, [&](int i) { LABEL[i] = NEXT[i] ? Int(REDUNDANT) : LABEL[i]; });
    return true;
  }
  // the problem as begin() copied it, whose rows have their weights multiplied in and the stride ld
  struct Copied {
    typename Space::template Matrix<0> matrix;
    typename Space::template Numbers<0> target;
    typename Space::template Numbers<1> weight;  // the first compliances, which are ones
    typename Space::template Numbers<2> damping;
    typename Space::template Numbers<3> center;
    const Real *rows, *compliance, *lower, *upper;
    Real tolerance;
  };
  OSIK_FN Copied copied() const {
    return {B, TARGET, COMPLIANCE, DAMPING, CENTER, B + m * ld, COMPLIANCE + m, lower, upper, tolerance};
  }
  // Solve a problem; whether there is a candidate.
  OSIK_CALL bool solve(const Data& d, const Answer& to) {
    begin(d);
    return search_from(d.guess, to);
  }
  // After `solve`: the same with a little compliance for hard rows, a part of longest_row(). Where these contradict each other
  // or the box, they are then missed as little as possible, and the cost is minimal too. False without hard rows.
  OSIK_CALL bool search_softened(const Data& d, const Answer& to) {
    if (!t.count(0, p, [&](int i) { return !(d.compliance[i] > 0); })) return false;
    soften(d, LARGEST_COMPLIANCE);
    return search_from(d.guess, to);
  }
  // After that, on its active set, with another part, down to where the factors are regular.
  OSIK_CALL bool solve_softened(const Data& d, const Answer& to, Real part) {
    soften(d, part);
    t.each(0, N, [&](int i) { LABEL[i] = LABEL[i] == REDUNDANT ? Int(INACTIVE) : LABEL[i]; });
    const bool found = solve_on_active_set();
    put(to, found);
    return found;
  }
  // After that: bring x and the multipliers to where no compliance would have them, if rows do not contradict each other.
  // Both are linear in the compliance, but for its square.
  OSIK_CALL void extrapolate(const Data& d, const Answer& to, Real part) {
    soften(d, 2 * part);
    const Real by = solve_on_active_set() ? 1 : 0;
    t.each(0, n, [&](int j) { to.x[j] = X[j] = to.x[j] + by * (to.x[j] - X[j]); });
    t.each(0, p, [&](int i) {
      const Real before = to.multipliers[i];
      SMALL_PIVOT[i] = before;
      to.multipliers[i] = Z[m + i] = before + by * (before - (LABEL[n + i] == INACTIVE ? Real(0) : Z[m + i]));
    });
  }
  // The multipliers before that: those of rows that do contradict each other.
  OSIK_FN void put_back(const Answer& to) const {
    t.each(0, p, [&](int i) { to.multipliers[i] = SMALL_PIVOT[i]; });
  }
  static constexpr Real LARGEST_COMPLIANCE = IS_SINGLE ? SINGLE_INFEASIBLE_COMPLIANCE : SEARCHED_COMPLIANCE;
  static constexpr Real LEAST_COMPLIANCE = IS_SINGLE ? SINGLE_INFEASIBLE_COMPLIANCE : INFEASIBLE_COMPLIANCE;
  // the largest square of a row of C, over the curvatures of the cost
  OSIK_FN Real longest_row() const {
    return t.most(Real(0), m, k, [&](int i, Real) {
      Real square_length = 0;
      for (int j = 0; j < n; ++j) square_length += square(B[i * ld + j] * INVERSE_ROOT[j]);
      return square_length;
    });
  }

 private:
  OSIK_CALL bool search_from(const int* guess, const Answer& to) {
    first_labels(guess, LABEL);
    const bool found = search() && changes <= max_changes;
    if (!found) first_labels(guess, LABEL);
    put(to, found);
    return found;
  }
  OSIK_CALL void put(const Answer& to, bool found) const {
    t.each(0, N, [&](int i) {
      to.active[i] = LABEL[i];
      if (i < n) to.x[i] = X[i];
      else to.multipliers[i - n] = LABEL[i] == INACTIVE ? Real(0) : Z[m + i - n];
    });
    t.once([&] { to.report[0] = found, to.report[1] = changes, to.report[2] = factorizations; });
  }
  OSIK_FN void soften(const Data& d, Real part) {
    const Real least = part * longest_row();
    t.each(0, p, [&](int i) { COMPLIANCE[m + i] = larger(d.compliance[i], least); });
  }
};
}  // namespace osik
