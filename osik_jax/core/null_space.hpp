// The motion of a level in the null space of the levels above it, and the classical projection, which is the sequence of
// these motions. The JAX functions that this file equals are level_motion and solve_forward
// (solvers/null_space/_projection.py), level_damping and narrow_box (solvers/_damping.py).
//
//   motion_k = P A_k' (A_k P A_k' + damping_k I)^-1 (b_k - A_k x),   P = projector onto the null space of the levels above
//
// P = Z'Z for the free rows of an orthonormal basis Z [n, n]. The rows [0, first) of Z span the levels above and the
// rows [first, n) are free. A level is factored in its coordinates B = Z A_k' of the free rows: Q'B has its row space in
// front, and so has Q'Z.
#pragma once
#include "constants.hpp"
#include "workspace.hpp"

namespace osik {

// The data of a level, weights multiplied in. Entry i of row a is at matrix[a row + i column]; row is 1 for a team that
// spares space.
struct NullSpaceLevel {
  const double *matrix, *lower, *upper, *bends;  // [rows, n], [rows], [rows], [n]
  const int* equality;                           // [rows] flags
  double constant, unmet, demand;                // its damping
  int rows, row, column;
};

struct NullSpaceSizes {
  int n, m;  // variables, rows of the longest level
};

template <class Team> struct NullSpace {
  using Int = typename Team::Int;
  using Sizes = NullSpaceSizes;
  using Algebra = LinearAlgebra<Team>;
  Team t;
  NullSpaceLevel level;
  int first, rows, rank;     // rows of Z that are not free; rows of the level; rank of the level
  bool identity;             // whether Z is the identity
  bool by_rows;              // whether S is the Gram matrix of the level's rows, or that of the coordinates
  bool gram_in_cost;         // whether S is that of the rows in the cost at X
  double longest_square, frobenius, damping;  // of the level's longest row, of its matrix, of the level
  double rank_tol;

  // ---- the workspace
  using Space = Workspace<NullSpace, Team, Sizes>;
  static constexpr int VECTORS = 17, MATRICES = 7, INTEGERS = 3;
  static constexpr OSIK_HOST int smaller(int a, int b) { return a < b ? a : b; }
  static constexpr OSIK_HOST int greater(int a, int b) { return a < b ? b : a; }
  static constexpr OSIK_HOST int size_of(int k, const Sizes& s) {
    const int n = Team::variables(s.n), m = Team::level_rows(s.m), least = smaller(n, m), most = greater(n, m);
    const int of_b = Team::stride(greater(n, m + least)), of_s = Team::stride(least);
    const int size[] = {
        n, m, Team::stride(n), Team::stride(m), of_b, of_s, Team::SPARES_SPACE ? of_b : of_s, Team::stride(most)};
    return size[k];
  }
  static constexpr OSIK_HOST int width(const Sizes& s) { return size_of(7, s); }
  static constexpr OSIK_HOST int numbers_of(int matrix, const Sizes& s) {
    const int n = Team::variables(s.n), of_b = size_of(4, s), apart = Team::SPARES_SPACE ? 0 : 1;
    const int of_f = apart * smaller(n, Team::level_rows(s.m)) * size_of(5, s);
    const int numbers[] = {of_b, n * size_of(2, s),         (n + 1) * of_b, apart * n * size_of(3, s), of_f,
                           of_f, apart * numbers_outside(s)};
    return numbers[matrix];
  }
  // the numbers of V and S, which are in global memory if the team spares space
  static constexpr OSIK_HOST int numbers_outside(const Sizes& s) {
    const int n = Team::variables(s.n), m = Team::level_rows(s.m);
    return greater(m, n) * size_of(2, s) + smaller(n, m) * size_of(5, s);
  }
  static constexpr OSIK_HOST int bytes(const Sizes& s, int integers = INTEGERS) {
    return Space::bytes(s, integers * width(s));
  }
  template <int K> struct InPlaceAt {
    static constexpr OSIK_HOST int of(const Sizes& s) {
      return int(sizeof(double)) *
             (Space::numbers_before(Team::SPARES_SPACE ? 2 : K, s) + (Team::SPARES_SPACE ? Team::level_rows(s.m) : 0));
    }
  };
  char* space;
  Sizes size;
  OSIK_PLACED(Size, 0, n, m, ld, lm, lb, ls, lf);  // strides of Z and V, of AT, of B, of S, of F
  OSIK_PLACED(Matrix, 0, WORK);                    // as long as a row of B
  OSIK_PLACED(Matrix, 1, Z);                       // [n, ld] the basis
  OSIK_PLACED(Matrix, 2, B);  // [n + 1, lb] the level's rows in the basis, B[j, a] = Z_j . A_a; below them a right-hand side
  OSIK_PLACED(Matrix, 3, AT);  // [n, lm] the level's matrix, transposed; not for a team that spares space
  // [min(m, n), lf] space to factor a Gram matrix, and the inverse of the factor: if the team spares space, both are in the
  // columns of B from m on, until the level is solved in its row space
  typename Space::template ArrayAt<InPlaceAt<4>> F{space, size};
  typename Space::template ArrayAt<InPlaceAt<5>> M{space, size};
  double* V;  // [max(m, n), ld] reflections; before these, on a CPU, rows in the cost in the free coordinates
  double* S;  // [min(m, n), ls] a Gram matrix
  // vectors, as long as the longer of m and n
  OSIK_PLACED(Numbers, 0, X, LOW, HIGH, CURVATURE, MOTION, COORDINATES, WANTED, MISSING, VALUE, BASE_VALUE, BASE_WANTED,
              SQUARE, RIGHT, DIAGONAL, INVERSE, SCALE, SQUARES);
  OSIK_PLACED(Labels, 0, IN_COST, IN_COST_AT_BASE, PIVOT);

  // outside: space of V and S, if the team spares space
  OSIK_FN NullSpace(const Sizes& s, char* space, double* outside = nullptr) : space(space), size(s) {
    V = Team::SPARES_SPACE ? outside : reinterpret_cast<double*>(space) + Space::numbers_before(6, s);
    S = V + greater(m, n) * ld;
  }

  OSIK_FN int free() const { return n - first; }
  OSIK_FN double* free_basis() const { return Z + first * ld; }
  OSIK_FN double* free_rows() const { return B + first * lb; }
  // what a row's value misses to the nearest point of its interval
  OSIK_FN double distance(int a, double value) const {
    return (level.equality[a] ? level.lower[a] : clip(value, level.lower[a], level.upper[a])) - value;
  }
  OSIK_FN void evaluate(const double* x, double* value) {
    if constexpr (Team::SPARES_SPACE)
      t.each(0, rows, [&](int a) { value[a] = t.own_dot(level.matrix + a * level.row, x, 0, n, level.column); });
    else Algebra::combine(t, AT, x, value, lm, n, 0, rows, false);
  }
  // the norm of what the rows miss where their values are value + MISSING
  OSIK_FN double missed(const double* value) {
    return sqrt(t.sum(0, rows, [&](int a) {
      const double off = distance(a, value[a] + MISSING[a]);
      return off * off;
    }));
  }

  // ---- the level's rows
  OSIK_METHOD void begin_level(const NullSpaceLevel& given) {
    level = given;
    double* turned = Team::SPARES_SPACE ? B : AT;
    const int apart = Team::SPARES_SPACE ? lb : lm;
    Algebra::transpose(t, level.matrix, level.row, level.column, turned, apart, level.rows, n);
    t.columns(0, level.rows, [&](auto c) {
      auto total = typename decltype(c)::P(0.0);
      OSIK_UNROLL_4
      for (int i = 0; i < n; ++i) total.square(c.load(turned + i * apart));
      c.store(SQUARE, total);
    });
    rows = int(t.most(0.0, 0, level.rows, [&](int a, double so_far) {  // without those that only fill up the level
      const bool bounded = level.equality[a] || level.lower[a] > -INFINITE || level.upper[a] < INFINITE;
      return bounded || SQUARE[a] != 0.0 ? a + 1.0 : so_far;
    }));
    longest_square = t.most(0.0, 0, rows, [&](int a, double) { return SQUARE[a]; });
    frobenius = sqrt(t.sum(0, rows, [&](int a) { return SQUARE[a]; }));
    Algebra::combine(t, turned, X, VALUE, apart, n, 0, rows, false);
    t.each(0, rows, [&](int a) {
      WANTED[a] = distance(a, VALUE[a]);
      IN_COST[a] = level.equality[a] || WANTED[a] != 0.0;
    });
    if constexpr (Team::SPARES_SPACE) {
      if (!identity) t.turn(Z, ld, B, lb, first, rows);
    } else if (identity) {
      t.each(0, n, [&](int i) {
        for (int a = 0; a < rows; ++a) B[i * lb + a] = AT[i * lm + a];
      });
    } else {
      Algebra::product(t, free_basis(), ld, 1, AT, lm, free_rows(), lb, free(), n, rows);
    }
    gram_in_cost = false;
  }

  // ---- the smaller of the two Gram matrices
  // S = B'B of the rows in the cost, or B B' of their part in the free coordinates. Returns the trace.
  OSIK_METHOD double gram(const Int* in_cost) {
    by_rows = rows < free();
    if (by_rows) {
      Algebra::product(t, free_rows(), 1, lb, free_rows(), lb, S, ls, rows, free(), rows, true);
      t.each(0, rows, [&](int a) {
        DIAGONAL[a] = in_cost[a] ? S[a * ls + a] : 0.0;
        if (!in_cost[a])
          for (int b = 0; b < rows; ++b) S[a * ls + b] = S[b * ls + a] = 0.0;
      });
    } else if constexpr (Team::SPARES_SPACE) {
      t.pairs(free(), [&](int j, int k) {
        double total = 0.0;
        OSIK_UNROLL_4
        for (int a = 0; a < rows; ++a) total += in_cost[a] ? free_rows()[j * lb + a] * free_rows()[k * lb + a] : 0.0;
        S[j * ls + k] = total;
        if (j == k) DIAGONAL[j] = total;
      });
    } else {
      t.each(0, rows, [&](int a) {
        for (int j = 0; j < free(); ++j) V[a * ld + j] = in_cost[a] ? B[(first + j) * lb + a] : 0.0;
      });
      Algebra::product(t, V, 1, ld, V, ld, S, ls, free(), rows, free(), true);
      t.each(0, free(), [&](int j) { DIAGONAL[j] = S[j * ls + j]; });
    }
    return t.sum(0, by_rows ? rows : free(), [&](int k) { return DIAGONAL[k]; });
  }
  OSIK_FN bool factor(double ridge) {  // false where a pivot is not positive
    const int count = by_rows ? rows : free();
    t.columns(0, count, [&](auto c) {
      OSIK_UNROLL_4
      for (int k = 0; k < count; ++k) c.store(F + k * lf, c.load(S + k * ls));
    });
    t.each(0, count, [&](int k) { F[k * lf + k] = DIAGONAL[k] + ridge; });
    return Algebra::inverse_factor(t, F, M, INVERSE, SCALE, lf, count, 0.0);
  }
  // out = B v for the free coordinates; v: [rows], 0 for rows that are not in the cost
  OSIK_FN void rows_along(const double* v, double* out) {
    if constexpr (!Team::SPARES_SPACE)
      if (!by_rows) return Algebra::combine(t, V, v, out, ld, rows, 0, free(), false);
    t.each(0, free(), [&](int j) { out[j] = t.own_dot(free_rows() + j * lb, v, 0, rows); });
  }
  OSIK_FN void solve_factored(double* y) { Algebra::apply_inverse(t, M, INVERSE, y, SCALE, lf, by_rows ? rows : free()); }

  // ---- damping
  // MISSING = the rows' change along the damped step B (B'B + ridge)^-1 wanted = (B B' + ridge)^-1 B wanted; false where
  // the matrix is not positive, by rounding
  OSIK_METHOD bool damped_change(const double* wanted, const Int* in_cost, double ridge) {
    if (!factor(ridge)) return false;
    if (by_rows) {
      t.each(0, rows, [&](int a) { RIGHT[a] = wanted[a]; });
      solve_factored(RIGHT);
      if (0 == t.count(0, rows, [&](int a) { return !in_cost[a]; })) {
        t.each(0, rows, [&](int a) { MISSING[a] = wanted[a] - ridge * RIGHT[a]; });
        return true;
      }
      rows_along(RIGHT, COORDINATES);
    } else {
      rows_along(wanted, COORDINATES);
      solve_factored(COORDINATES);
    }
    Algebra::combine(t, free_rows(), COORDINATES, MISSING, lb, free(), 0, rows, false);
    return true;
  }
  // constant + unmet ratio, with the ratio of the demand that the step with this damping misses. It begins at the base,
  // what of x the null space does not change; `at_base` where that may be another point than x.
  OSIK_METHOD void compute_damping(bool at_base) {
    const double *value = VALUE, *wanted = WANTED;
    const Int* in_cost = IN_COST;
    damping = level.constant;
    if (level.unmet != 0.0) {
      gram_in_cost = true;
      if (at_base) {
        t.each(0, free(), [&](int j) { COORDINATES[j] = t.own_dot(Z + (first + j) * ld, X, 0, n); });
        Algebra::combine(t, free_rows(), COORDINATES, MISSING, lb, free(), 0, rows, false);
        const int other = t.count(0, rows, [&](int a) {
          BASE_VALUE[a] = VALUE[a] - MISSING[a];
          BASE_WANTED[a] = distance(a, BASE_VALUE[a]);
          IN_COST_AT_BASE[a] = level.equality[a] || BASE_WANTED[a] != 0.0;
          return IN_COST_AT_BASE[a] != IN_COST[a];
        });
        value = BASE_VALUE, wanted = BASE_WANTED, in_cost = IN_COST_AT_BASE, gram_in_cost = other == 0;
      }
      const double trace = gram(in_cost), demand = level.demand > 0.0 ? level.demand : 1.0;
      double ratio = 1.0, before = 0.0;
      for (int again = 0; again < DAMPING_ITERATIONS && ratio != before; ++again) {
        before = ratio;
        const double ridge = level.constant + level.unmet * ratio + DAMPING_RIDGE * trace;
        ratio = damped_change(wanted, in_cost, ridge > 0.0 ? ridge : 1.0) ? missed(value) / demand : 0.0;
        ratio = ratio < 1.0 ? ratio : 1.0;
      }
      damping += level.unmet * ratio;
    }
    if (!(damping > NEGLIGIBLE_DAMPING * longest_square)) damping = 0.0;
  }

  // ---- the motion
  // COORDINATES = (B B' + damping)^-1 B wanted in all free coordinates, from their Gram matrix, corrected once; false
  // where the matrix may be too near to a singular one. The product of all but the least of its eigenvalues is at most
  // their mean to that power, which bounds the least one by the determinant.
  OSIK_METHOD bool solve_in_all_coordinates(double cutoff) {
    const int count = free();
    if (!gram_in_cost) gram(IN_COST);
    if (!factor(damping)) return false;
    const double trace = count * damping + t.sum(0, count, [&](int j) { return DIAGONAL[j]; });
    const double mean = trace / (count > 1 ? count - 1 : 1);
    double least = mean;
    for (int j = 0; j < count; ++j) least /= INVERSE[j] * mean;
    if (!(least >= INDEPENDENT_ROWS * trace && least - damping > 2.0 * rows * cutoff * cutoff)) return false;
    rows_along(WANTED, COORDINATES);
    solve_factored(COORDINATES);
    Algebra::combine(t, free_rows(), COORDINATES, MISSING, lb, count, 0, rows, false);
    t.each(0, rows, [&](int a) { MISSING[a] = IN_COST[a] ? WANTED[a] - MISSING[a] : 0.0; });
    rows_along(MISSING, RIGHT);
    t.axpy(RIGHT, -damping, COORDINATES, 0, count);
    solve_factored(RIGHT);
    t.axpy(COORDINATES, 1.0, RIGHT, 0, count);
    return true;
  }
  // COORDINATES = least |B'y - wanted|^2 + damping |y|^2 in the first `rank` free coordinates, which span the rows
  OSIK_METHOD void solve_in_row_space() {
    double* C = free_rows();
    const int columns = rows + (damping > 0.0 ? rank : 0);
    t.each(0, rank + 1, [&](int k) {
      for (int c = k < rank ? rows : 0; c < lb; ++c) C[k * lb + c] = k == rank && c < rows ? WANTED[c] : 0.0;
      if (k < rank && damping > 0.0) C[k * lb + rows + k] = sqrt(damping);
    });
    t.each(0, lb, [&](int c) { WORK[c] = 0.0; });
    Algebra::least_squares_of_rows(t, C, WORK, INVERSE, lb, rank, columns);
    t.each(0, rank, [&](int k) { COORDINATES[k] = C[rank * lb + k]; });
  }
  // the reflections of B's first columns, whose rank is returned, and those of Z by them. Where V is in global memory,
  // RIGHT and DIAGONAL have those at work.
  OSIK_METHOD int reflect_rows(int columns, double cutoff) {
    return Algebra::template pivoted_qr<Team::SPARES_SPACE>(t, free_rows(), V, RIGHT, SQUARES, SCALE, PIVOT, lb, ld, free(),
                                                            0, columns, cutoff);
  }
  OSIK_METHOD void reflect_basis() {
    Algebra::template apply_reflections<Team::SPARES_SPACE>(t, V, RIGHT, SCALE, free_basis(), ld, DIAGONAL - RIGHT, ld, rank,
                                                            free(), n);
  }
  // MOTION = the motion that the level asks for; the rows of Z that it determines follow those before `first`
  OSIK_METHOD void find_motion() {
    const double cutoff = rank_tol * sqrt(t.sum(0, rows, [&](int a) { return IN_COST[a] ? SQUARE[a] : 0.0; }));
    const int in_cost = t.count(0, rows, [&](int a) { return IN_COST[a] != 0; }), count = free();
    if (in_cost >= count && solve_in_all_coordinates(cutoff)) {
      rank = count;
    } else {
      t.each(0, rows, [&](int a) {
        if (!IN_COST[a])
          for (int j = first; j < n; ++j) B[j * lb + a] = 0.0;
      });
      rank = reflect_rows(rows, cutoff);
      solve_in_row_space();
      if (rank < count) {
        reflect_basis();
        identity = identity && rank == 0;
      } else {  // no coordinate is left for the levels below, and Z may stay as it is
        for (int k = rank - 1; k >= 0; --k) {
          const double by = -SCALE[k] * t.dot(V + k * ld, COORDINATES, k, count);
          t.axpy(COORDINATES, by, V + k * ld, k, count);
        }
      }
    }
    Algebra::combine(t, free_basis(), COORDINATES, MOTION, ld, rank, 0, n, false);
  }

  // ---- what a level leaves to those below
  // the box of the levels below: what they may spend of what a level out of reach has gained
  OSIK_METHOD void narrow_box() {
    const double least = NEGLIGIBLE_DAMPING * longest_square, demand = level.demand > 0.0 ? level.demand : 1.0;
    t.each(0, n, [&](int i) { CURVATURE[i] = larger(CURVATURE[i], level.bends[i] / (frobenius > 0.0 ? frobenius : 1.0)); });
    if (!(level.unmet > least)) return;
    evaluate(X, VALUE);
    t.each(0, rows, [&](int a) { MISSING[a] = 0.0; });
    double miss = missed(VALUE);
    miss = miss < level.demand ? miss : level.demand;
    if (!(level.unmet * (miss / demand) > least)) return;
    const double by = miss * frobenius;
    const double negligible = NEGLIGIBLE_CURVATURE * t.most(0.0, 0, n, [&](int i, double) { return by * CURVATURE[i]; });
    const int count = t.count(0, n, [&](int i) { return by * CURVATURE[i] > negligible; });
    const double gain = COST_FRACTION * (level.demand - miss) * (level.demand + miss);
    t.each(0, n, [&](int i) {
      const double cost = by * CURVATURE[i];
      if (!(cost > negligible)) return;
      const double room = sqrt(larger(0.0, gain / (count * cost))) + MIN_RADIUS;
      LOW[i] = larger(LOW[i], X[i] - room), HIGH[i] = -larger(-HIGH[i], -X[i] - room);
    });
  }
  // the projector onto what the levels leave, [n, n]
  OSIK_METHOD void write_projector(double* out) {
    Algebra::product(t, free_basis(), 1, ld, free_basis(), ld, B, lb, n, free(), n, true);
    t.each(0, n, [&](int i) {
      for (int j = 0; j < n; ++j) out[i * n + j] = i < j ? B[i * lb + j] : B[j * lb + i];
    });
  }
};

// All levels of one problem, and a secondary motion in what they leave.
template <class Team> struct ClassicalProjection : NullSpace<Team> {
  using Base = NullSpace<Team>;
  using Base::Base, Base::t, Base::n, Base::ld, Base::first, Base::X, Base::MOTION, Base::Z;

  OSIK_METHOD void begin() {
    first = 0, this->identity = true;
    t.each(0, n, [&](int i) {
      X[i] = this->CURVATURE[i] = 0.0, this->LOW[i] = -INFINITE, this->HIGH[i] = INFINITE;
      for (int j = 0; j < n; ++j) Z[i * ld + j] = i == j;
    });
  }
  // add as much of MOTION to X as stays in the box that levels out of reach leave to those below
  OSIK_METHOD void move() {
    const double part = -t.most(-1.0, 0, n, [&](int i, double) {
      const double step = MOTION[i], room = step > 0.0 ? this->HIGH[i] - X[i] : X[i] - this->LOW[i];
      return step != 0.0 && room < INFINITE ? -room / fabs(step) : -1.0;
    });
    t.axpy(X, part, MOTION, 0, n);
  }
  OSIK_METHOD void solve_level(const NullSpaceLevel& level) {
    if (first == n) return;
    this->begin_level(level);
    this->compute_damping(false);
    this->find_motion();
    first += this->rank;
    move();
    this->narrow_box();
  }
  // the secondary motion in what the levels leave, the projector onto that (null: it is not needed), and the answer
  OSIK_METHOD void end(const double* given, double* x, double* projector) {
    double *secondary = this->WORK, *coordinates = this->COORDINATES;
    t.each(0, n, [&](int i) { secondary[i] = given[i]; });
    t.each(0, n - first, [&](int j) { coordinates[j] = t.own_dot(Z + (first + j) * ld, secondary, 0, n); });
    Base::Algebra::combine(t, this->free_basis(), coordinates, MOTION, ld, n - first, 0, n, false);
    move();
    if (projector) this->write_projector(projector);
    t.each(0, n, [&](int i) { x[i] = X[i]; });
  }
};

}  // namespace osik
