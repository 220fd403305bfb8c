// The dual active-set method with factors that are updated.
//
// D. Goldfarb, A. Idnani, "A numerically stable dual method for solving strictly convex quadratic programs", Mathematical
// Programming 27, 1983. Rows of C may be soft, so the unknowns are v = (x, s) with t = sqrt(E) s and E their
// compliances. The cost is 1/2 |s|^2 more. Constraint i has the normal n_i = e_i for a bound, (C_q, sqrt(E_q) e_q) for a
// row. With N the normals of the active constraints, each in the direction in which it pushes,
//
//   Hessian = U'U,   J = U^-1 Q,   J'N = [T; 0]   with Q orthogonal and T upper triangular,
//
// and for a constraint n that enters, with d = J'n = [d1; d2]: J2 d2 is the direction of v, and the multipliers of the
// active constraints fall at the rates r = T^-1 d1. The dual objective rises with every step, so that no active set
// comes back.
#pragma once
#include "constants.hpp"
#include "linear_algebra.hpp"

namespace osik {

template <class Team> struct DualActiveSet {
  using Real = typename Team::Real;
  using Int = typename Team::Int;
  static constexpr int VECTORS = 6;
  static constexpr Real REDUNDANT_BELOW = sizeof(Real) == 8 ? REDUNDANCY_TOL : 10;  // in units of roundoff
  struct Constraints {
    const Real *rows, *compliance;                    // C: [p, ld], [p]
    const Real *lower, *upper, *roundoff;             // [N] bounds, and the roundoff of values
    const Real *x, *multipliers;                      // [n], [p] of the start: the minimiser on its active set
    int ld, most_changes;
  };
  Team t;
  int n, p, N, lN, count;  // count: active constraints
  Real *R, *J;             // [N, lN] T; rows are the columns of J
  Real *POINT, *ALONG, *REFLECTED, *MULTIPLIER, *RATE, *ROOT;
  Int* ORDER;  // the active constraints in the order of the columns of T
  Constraints c;

  static constexpr OSIK_HOST int doubles(int n, int p) { return (2 * (n + p) + VECTORS) * Team::stride(n + p); }
  OSIK_FN void begin(int variables, int rows, Real* F, Int* order) {
    n = variables, p = rows, N = n + p, lN = Team::stride(N), ORDER = order;
    R = F, J = R + N * lN, F = J + N * lN;
    for (Real** v : {&POINT, &ALONG, &REFLECTED, &MULTIPLIER, &RATE, &ROOT}) *v = F, F += lN;
  }

  // Rotate rows a and b, from `start` to `stop`: to cosine a + sine b and cosine b - sine a.
  OSIK_FN void rotate(Real* a, Real* b, Real cosine, Real sine, int start, int stop) {
    t.each(start, stop, [&](int i) {
      const Real first = a[i];
      a[i] = cosine * first + sine * b[i], b[i] = cosine * b[i] - sine * first;
    });
  }
  // J = U^-1 with U'U the Hessian of the m rows of B, by Givens rotations, which square nothing. A pinned variable has a
  // 1 in U and nothing in J, so that no step moves it.
  OSIK_CALL void factor(const Real* B, int ld, const Real* damping, const Real* lower, const Real* upper, int m) {
    count = 0;
    t.each(0, N * lN, [&](int e) { R[e] = J[e] = 0; });
    t.each(0, n, [&](int j) { R[j * lN + j] = lower[j] < upper[j] ? sqrt(damping[j]) : Real(1); });
    Real* v = ALONG;
    for (int i = 0; i < m; ++i) {
      t.each(0, n, [&](int j) { v[j] = lower[j] < upper[j] ? B[i * ld + j] : Real(0); });
      for (int k = 0; k < n; ++k) {
        const Real a = R[k * lN + k], b = v[k];
        if (b == Real(0)) continue;
        const Real length = hypot(a, b);
        rotate(R + k * lN, v, a / length, b / length, k, n);
      }
    }
    t.each(0, N, [&](int j) {  // column j of U^-1
      Real* column = J + j * lN;
      column[j] = j < n ? Real(1) / R[j * lN + j] : Real(1);
      for (int i = j - 1; i >= 0 && j < n; --i) column[i] = -t.own_dot(R + i * lN, column, i + 1, j + 1) / R[i * lN + i];
      if (j < n && lower[j] == upper[j]) column[j] = 0;
    });
  }
  OSIK_FN Real own_along_normal(int i, int k) const {  // entry k of J' n_i
    const Real* column = J + k * lN;
    if (i < n) return column[i];
    return t.own_dot(c.rows + (i - n) * c.ld, column, 0, n) + column[i] * ROOT[i];
  }
  OSIK_FN Real value(int i) const {  // n_i' v: a variable, or C_q x + t_q
    return i < n ? POINT[i] : t.own_dot(c.rows + (i - n) * c.ld, POINT, 0, n) + ROOT[i] * POINT[i];
  }
  OSIK_FN Real gap(int i) const {
    const Real v = value(i);
    return larger(c.lower[i] - v, v - c.upper[i]);
  }
  // The constraint whose activation raises the dual objective most, -1 for none. A full step raises it by half of
  // gap^2 / |J2'n|^2. Equalities come first; those that the active constraints imply are passed over.
  OSIK_CALL int most_violated(const Int* label, const Int* implied) {
    return t
        .best(Real(0), 0, N, [&](int i) {
      if (label[i] != INACTIVE || implied[i]) return Real(0);
      if (c.lower[i] == c.upper[i]) return Real(INFINITE);
      const Real off = gap(i);
      if (!(off > c.roundoff[i])) return Real(0);
      Real outside = 0;
      for (int k = count; k < N; ++k) outside += square(own_along_normal(i, k));
      return off * off / larger(outside, Team::SMALLEST_PIVOT);
    }).which;
  }
  OSIK_CALL void add(Real* d) {  // a Householder reflection of the columns of J2 turns d2 into one number
    Real* w = REFLECTED;
    const Real length = sqrt(t.dot(d, d, count, N)), head = d[count], turned = head > 0 ? -length : length;
    t.each(0, count + 1, [&](int k) {
      R[k * lN + count] = k < count ? d[k] : turned;
      if (k == count) d[k] = head - turned;
    });
    const Real half = Real(0.5) * t.dot(d, d, count, N);
    t.each(0, N, [&](int j) {
      Real total = 0;
      for (int k = count; k < N; ++k) total += d[k] * J[k * lN + j];
      w[j] = total / half;
    });
    for (int k = count; k < N; ++k) t.axpy(J + k * lN, -d[k], w, 0, N);
  }
  OSIK_CALL void drop(int place) {  // a column of T goes; Givens rotations make T triangular again
    for (int k = place; k < count - 1; ++k) {
      t.each(0, k + 2, [&](int i) { R[i * lN + k] = R[i * lN + k + 1]; });
      const Real a = R[k * lN + k], b = R[(k + 1) * lN + k], length = hypot(a, b);
      if (!(length > 0)) continue;
      t.once([&] { R[k * lN + k] = length, R[(k + 1) * lN + k] = 0; });
      rotate(R + k * lN, R + (k + 1) * lN, a / length, b / length, k + 2, count);
      rotate(J + k * lN, J + (k + 1) * lN, a / length, b / length, 0, N);
    }
  }

  // Find the active constraints from where it ended before, or from the pinned variables alone.
  // label: [N]; implied: [N] becomes 1 for constraints that the active ones imply.
  // Returns the changes of the active set, -1 where rows cannot hold together or the limit is met.
  OSIK_CALL int run(const Constraints& given, Int* label, Int* implied) {
    c = given;
    t.each(0, N, [&](int i) {
      ROOT[i] = i < n ? Real(0) : sqrt(c.compliance[i - n]);
      POINT[i] = i < n ? c.x[i] : label[i] != INACTIVE ? ROOT[i] * c.multipliers[i - n] : Real(0);
    });
    int changes = 0;
    while (true) {
      const int entering = most_violated(label, implied);
      if (entering < 0) return changes;
      const Real v = value(entering);
      const Real side = c.lower[entering] - v >= v - c.upper[entering] ? 1 : -1;
      if (!enter(entering, side, label, implied, changes)) return -1;
    }
  }
  // Make a constraint active; active inequalities whose multiplier reaches 0 on the way leave.
  OSIK_CALL bool enter(int entering, Real side, Int* label, Int* implied, int& changes) {
    Real* d = ALONG;
    Real pushed = 0;
    while (true) {
      if (++changes > c.most_changes) return false;
      t.each(0, N, [&](int k) { d[k] = side * own_along_normal(entering, k); });
      for (int k = count - 1; k >= 0; --k) {
        const Real rate = (d[k] - t.dot(R + k * lN, RATE, k + 1, count)) / R[k * lN + k];
        t.once([&] { RATE[k] = rate; });
      }
      const Real whole = t.dot(d, d, 0, N), outside = t.dot(d, d, count, N), v = value(entering);
      const Real off = larger(side > 0 ? c.lower[entering] - v : v - c.upper[entering], Real(0));
      const Real full = outside > Real(KERNEL_DEPENDENCE) * whole ? off / outside : Real(INFINITE);
      const Best<Real> b = t.best(-Real(INFINITE), 0, count, [&](int i) {  // the multiplier that is 0 first
        const bool falls = label[ORDER[i]] != EQUALITY && RATE[i] > 0;
        return falls ? -MULTIPLIER[i] / RATE[i] : -Real(INFINITE);
      });
      const Real length = full < -b.value ? full : -b.value;
      if (!(length < Real(INFINITE))) {
        if (!(off <= REDUNDANT_BELOW * c.roundoff[entering])) return false;
        t.once([&] { implied[entering] = 1; });
        return true;
      }
      t.each(0, count, [&](int i) {
        const Real u = MULTIPLIER[i] - length * RATE[i];
        MULTIPLIER[i] = label[ORDER[i]] == EQUALITY ? u : larger(u, Real(0));
      });
      pushed += length;
      if (full < Real(INFINITE))
        for (int k = count; k < N; ++k) t.axpy(POINT, length * d[k], J + k * lN, 0, N);
      if (length == full) {
        add(d);
        t.once([&] {
          label[entering] = c.lower[entering] == c.upper[entering] ? EQUALITY : side > 0 ? AT_LOWER : AT_UPPER;
          ORDER[count] = entering, MULTIPLIER[count] = pushed;
        });
        ++count;
        return true;
      }
      drop(b.which);
      t.once([&] {
        label[ORDER[b.which]] = INACTIVE;
        for (int i = b.which; i < count - 1; ++i) ORDER[i] = ORDER[i + 1], MULTIPLIER[i] = MULTIPLIER[i + 1];
      });
      --count;
    }
  }
};
}  // namespace osik
