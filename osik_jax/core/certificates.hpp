// Checks whether candidates solve their problems, by the data of these alone. The C++ version of the certificates in
// solvers/qp/_dispatch.py (_is_certified, _is_stationary, kkt_residual) and solvers/hqp/_cascade.py (certify_levels).
#pragma once
#include <vector>

#include "hierarchy.hpp"
#include "lanes.hpp"
#include "weighted_qp.hpp"

namespace osik {

struct Certificate {
  bool holds;
  double residual;       // of the optimality conditions, without units
  bool is_exact = true;  // whether the gradient is roundoff where it has to be 0, which no search needs to reach
};

// Of a weighted QP in double precision.
class QPCertificate {
  QPSizes s;
  std::vector<double> space;
  double *SIZE, *GRADIENT, *SCALE, *ROOT, *INVERSE_ROOT, *ROW_TERMS;  // [n]; the sizes of terms of the gradient
  double *FORCE, *TERMS;                                              // [m] pulls of the rows, and the sizes of their terms
  double scaled, plain, tolerance;                                    // sizes of x: per root of a curvature, and per unit

 public:
  explicit QPCertificate(const QPSizes& sizes) : s(sizes), space(6 * sizes.n + 2 * sizes.m) {
    double* at = space.data();
    for (double** v : {&SIZE, &GRADIENT, &SCALE, &ROOT, &INVERSE_ROOT, &ROW_TERMS}) *v = at, at += s.n;
    FORCE = at, TERMS = at + s.m;
  }

  // x: [n], y: [p] multipliers of the rows, active: [n + p] labels; residuals up to kkt_tol are certified
  Certificate judge(const QPData<double>& d, const double* x, const double* y, const int* active, double kkt_tol) {
    const int n = s.n, p = s.p;
    tolerance = d.tolerance;
    add_terms(d, x);
    measure();
    for (int q = 0; q < p; ++q)
      each_entry(n, [&](auto e) {
        const auto force = e(d.rows + q * n) * y[q];
        e.put(e(GRADIENT) - force, GRADIENT), e.put(e(ROW_TERMS) + fabs(force), ROW_TERMS);
      });
    bool holds = true, exact = true;
    Gathered dual, primal, terms;
    each_entry(n, [&](auto e) {
      const auto multiplier = e(GRADIENT), at = e(x), free = fabs(multiplier);
      const auto found = check(e, d.lower, d.upper, active, at, at, e(INVERSE_ROOT), decltype(at)(1), multiplier,
                               ROW_MULTIPLIER * e(ROW_TERMS));
      const auto size = e(SCALE) + e(ROW_TERMS), beyond = select(found.inactive, free, found.sign);
      holds &= !any(!(found.holds & ((free <= VALUE_TOL * d.tolerance * found.force) | !found.inactive)));
      exact &= !any(!(e.are(active, EQUALITY) | (beyond <= GRADIENT_TOL * EPSILON * size)));
      terms.most(size), dual.most(select(found.one_side | found.inactive, beyond, decltype(at)(0)));
    });
    for (int q = 0; q < p; ++q) {
      const double* row = d.rows + q * n;
      Gathered curved, length, longest, product;
      each_entry(n, [&](auto e) {
        const auto entry = e(row), size = fabs(entry);
        curved.add(size * e(INVERSE_ROOT)), length.add(size), longest.most(size), product.add(entry * e(x));
      });
      const double value = product.sum();
      const double compliant = value + d.compliance[q] * y[q];
      const auto found = check(Entries<double>{size_t(n + q)}, d.lower, d.upper, active, value, compliant, curved.sum(),
                               length.sum(), y[q], 0.0);
      holds = holds && found.holds && (!found.inactive || y[q] == 0) && is_finite(y[q]);
      const double missed = larger(found.gap > 0 ? found.gap : 0.0, y[q] != 0 ? found.off : 0.0);
      dual.most(found.one_side ? found.sign * longest.largest() : 0.0), primal.most(missed / (found.scale > 0 ? found.scale : 1.0));
    }
    const double total = terms.largest(), residual = larger(dual.largest() / (total > 0 ? total : 1.0), primal.largest());
    return {holds && residual <= kkt_tol, residual, exact};
  }

 private:
  // the cost's gradient at x, the sizes of its terms, and roots of its curvatures
  void add_terms(const QPData<double>& d, const double* x) {
    const int n = s.n;
    each_entry(n, [&](auto e) { e.put(fabs(e(x)), SIZE); });
    for (int i = 0; i < s.m; ++i) {
      const double* row = d.matrix + i * n;
      Gathered value, size;
      each_entry(n, [&](auto e) { value.add(e(row) * e(x)), size.add(fabs(e(row)) * e(SIZE)); });
      FORCE[i] = d.weight[i] * (value.sum() - d.target[i]), TERMS[i] = d.weight[i] * (size.sum() + fabs(d.target[i]));
    }
    each_entry(n, [&](auto e) {
      const auto damping = e(d.damping), center = e(d.center);
      auto gradient = damping * (e(x) - center), scale = damping * (e(SIZE) + fabs(center)), curvature = damping;
      for (int i = 0; i < s.m; ++i) {
        const auto entry = e(d.matrix + i * n);
        gradient += entry * FORCE[i], scale += fabs(entry) * TERMS[i], curvature += d.weight[i] * (entry * entry);
      }
      const auto root = sqrt(select(curvature > 0.0, curvature, decltype(damping)(1)));
      e.put(gradient, GRADIENT), e.put(scale, SCALE), e.put(root, ROOT), e.put(1.0 / root, INVERSE_ROOT), e.put(0.0, ROW_TERMS);
    });
  }
  // the sizes of x, or those of its Newton step by the curvatures alone where x is roundoff beside it
  void measure() {
    Gathered rooted, size, rooted_newton, newton;
    each_entry(s.n, [&](auto e) {
      const auto step = fabs(e(GRADIENT)) * e(INVERSE_ROOT) * e(INVERSE_ROOT);
      rooted.most(e(SIZE) * e(ROOT)), size.most(e(SIZE)), rooted_newton.most(step * e(ROOT)), newton.most(step);
    });
    const bool is_roundoff = rooted.largest() <= ZERO_TOL * EPSILON * rooted_newton.largest();
    scaled = (is_roundoff ? rooted_newton : rooted).largest(), plain = (is_roundoff ? newton : size).largest();
  }
  template <class Real> struct Checked {
    using Which = decltype(Real() < Real());
    Which holds, one_side, inactive;
    Real force, sign, off, gap, scale;  // sign: the multiplier, if positive in the wrong direction; off: from its bound
  };
  // What all constraints have to be, and what is asked of their multipliers.
  template <class E, class Real>
  Checked<Real> check(E e, const double* lower, const double* upper, const int* active, Real value, Real compliant,
                      Real per_curvature, Real per_unit, Real multiplier, Real force_of_rows) const {
    using Which = typename Checked<Real>::Which;
    const Which at_lower = e.are(active, AT_LOWER), at_upper = e.are(active, AT_UPPER), inactive = e.are(active, INACTIVE);
    const Which equality = e.are(active, EQUALITY), one_side = at_lower | at_upper;
    const Real low = e(lower), high = e(upper), from = fabs(low), to = fabs(high), nearest = select(from < to, from, to), zero = 0;
    const Real scaled_reach = scaled * per_curvature, reach = plain * per_unit;
    const Real scale = select(scaled_reach < reach, scaled_reach, reach) + fabs(value) + select(nearest < Real(INFINITE), nearest, zero);
    const Real curved = select(per_curvature < Real(SMALLEST), Real(SMALLEST), per_curvature);
    const Real force = scale / (curved * curved) + force_of_rows, sign = select(at_lower, -multiplier, multiplier);
    const Real off = select(inactive, zero, fabs(compliant - select(at_upper, high, low)));
    const Real below = low - compliant, above = compliant - high, gap = select(above > below, above, below);
    const Real near = VALUE_TOL * tolerance * scale;
    const Which labelled = one_side | (equality & (low == high)) | (inactive & (low != high));
    const Which holds = labelled & (off <= near) & !(gap > near) & ((sign <= SIGN_TOL * tolerance * force) | !one_side);
    return {holds, one_side, inactive, force, sign, off, gap, scale};
  }
  static constexpr double SMALLEST = 2.2250738585072014e-308;
};

// Of a hierarchy, whose x is clipped into its box first.
inline Certificate judge(const Sizes& s, const Problem& p, const Answer& a) {
  const int n = s.n;
  double size = 0, moved = 0, residual = *a.residual;
  bool holds = a.report[0] && is_finite(residual);
  for (int i = 0; i < s.L * s.h; ++i) holds = holds && is_finite(a.multipliers[i]);
  for (int j = 0; j < n; ++j) {
    const double x = a.x[j];
    a.x[j] = clip(x, p.hard_lower[j], p.hard_upper[j]);
    holds = holds && is_finite(x), moved = larger(moved, fabs(x - a.x[j])), size = larger(size, fabs(x));
  }
  holds = holds && moved <= BOX_TOLERANCE * p.tolerances[0] * size;
  size = 0;
  for (int j = 0; j < n; ++j) size = larger(size, fabs(a.x[j]));
  for (int k = 0; k < s.L; ++k) {  // what the levels below have changed of each level's norm
    double squares = 0, longest = 0;
    for (int i = k * s.m; i < k * s.m + s.row_counts[k]; ++i) {
      const double *row = p.matrix + i * n, value = Serial<double>::own_dot(row, a.x, 0, n);
      squares += square(value - clip(value, p.lower[i], p.upper[i]));
      longest = larger(longest, Serial<double>::own_dot(row, row, 0, n));
    }
    const double now = sqrt(squares), terms = larger(sqrt(longest) * size, now);
    if (a.slack_norms[k] < INFINITE) residual = larger(residual, fabs(now - a.slack_norms[k]) / (terms > 0 ? terms : 1.0));
  }
  for (int j = 0; j < n; ++j) {
    const double bound = a.active_bounds[j] < 0 ? p.hard_lower[j] : p.hard_upper[j];
    if (a.active_bounds[j]) residual = larger(residual, fabs(a.x[j] - bound) / (size > 0 ? size : 1.0));
  }
  return {holds && residual <= MAX_RESIDUAL * p.tolerances[0], residual};
}
}  // namespace osik
