// Checks whether candidates solve their problems, by the data of these alone. The C++ version of the certificates in
// solvers/qp/_dispatch.py (_is_certified, _is_stationary, kkt_residual) and solvers/hqp/_cascade.py (certify_levels).
#pragma once
#include <vector>

#include "hierarchy.hpp"
#include "weighted_qp.hpp"

namespace osik {

struct Certificate {
  bool holds;
  double residual;       // of the optimality conditions, without units
  bool is_exact = true;  // whether the gradient is roundoff where it has to be 0, which no search needs to reach
};

// Of a weighted QP in double precision.
class QPCertificate {
  using Team = Serial<double>;
  QPSizes s;
  std::vector<double> space;
  double *SIZE, *GRADIENT, *SCALE, *ROOT, *INVERSE_ROOT, *ROW_TERMS, *ROW;  // [n]; the sizes of terms of the gradient

 public:
  explicit QPCertificate(const QPSizes& sizes) : s(sizes), space(7 * (sizes.n + 8)) {
    double* at = space.data();
    for (double** v : {&SIZE, &GRADIENT, &SCALE, &ROOT, &INVERSE_ROOT, &ROW_TERMS, &ROW}) *v = at, at += s.n + 8;
  }

  // x: [n], y: [p] multipliers of the rows, active: [n + p] labels; residuals up to kkt_tol are certified
  Certificate judge(const QPData<double>& d, const double* x, const double* y, const int* active, double kkt_tol) {
    const int n = s.n, p = s.p;
    double scaled = 0, plain = 0, scaled_newton = 0, plain_newton = 0;
    add_terms(d, x);
    for (int j = 0; j < n; ++j) {
      const double newton = fabs(GRADIENT[j]) / square(ROOT[j]);
      scaled = larger(scaled, SIZE[j] * ROOT[j]), plain = larger(plain, SIZE[j]);
      scaled_newton = larger(scaled_newton, newton * ROOT[j]), plain_newton = larger(plain_newton, newton);
      ROW_TERMS[j] = 0;
    }
    if (scaled <= ZERO_TOL * EPSILON * scaled_newton) scaled = scaled_newton, plain = plain_newton;
    for (int q = 0; q < p; ++q)
      for (int j = 0; j < n; ++j) GRADIENT[j] -= d.rows[q * n + j] * y[q], ROW_TERMS[j] += fabs(d.rows[q * n + j] * y[q]);
    bool holds = true, exact = true;
    double dual = 0, primal = 0, terms = 0;
    for (int i = 0; i < n + p; ++i) {
      const int label = active[i], q = i - n;
      double per_curvature = 0, per_unit = 1, value = 0, compliant = 0, longest = 1;
      if (i < n) per_curvature = INVERSE_ROOT[i], value = compliant = x[i];
      else {
        const double* row = d.rows + q * n;
        per_unit = longest = 0;
        for (int j = 0; j < n; ++j)
          per_curvature += fabs(row[j]) * INVERSE_ROOT[j], per_unit += fabs(row[j]), longest = larger(longest, fabs(row[j]));
        value = Team::own_dot(row, x, 0, n), compliant = value + d.compliance[q] * y[q];
      }
      const double low = d.lower[i], high = d.upper[i], nearest = fabs(low) < fabs(high) ? fabs(low) : fabs(high);
      const double reach = scaled * per_curvature < plain * per_unit ? scaled * per_curvature : plain * per_unit;
      const double scale = reach + fabs(value) + (nearest < INFINITE ? nearest : 0.0);
      const double force = scale / square(larger(per_curvature, 2.2250738585072014e-308)) +
                           (i < n ? ROW_MULTIPLIER * ROW_TERMS[i] : 0.0);
      const double multiplier = i < n ? GRADIENT[i] : y[q], sign = label == AT_LOWER ? -multiplier : multiplier;
      const bool one_side = label == AT_LOWER || label == AT_UPPER, is_active = label != INACTIVE;
      const double off = is_active ? fabs(compliant - (label == AT_UPPER ? high : low)) : 0.0;
      const double gap = larger(low - compliant, compliant - high);
      holds = holds && (one_side || (label == EQUALITY ? low == high : label == INACTIVE && low != high));
      holds = holds && off <= VALUE_TOL * d.tolerance * scale && !(gap > VALUE_TOL * d.tolerance * scale);
      holds = holds && (!one_side || sign <= SIGN_TOL * d.tolerance * force);
      if (i < n) {
        const double size = SCALE[i] + ROW_TERMS[i], roundoff = GRADIENT_TOL * EPSILON * size;
        holds = holds && (is_active || fabs(multiplier) <= VALUE_TOL * d.tolerance * force);
        exact = exact && (label == EQUALITY || (is_active ? sign : fabs(multiplier)) <= roundoff);
        terms = larger(terms, size), dual = larger(dual, one_side ? sign : is_active ? 0.0 : fabs(multiplier));
      } else {
        const double missed = larger(gap > 0 ? gap : 0.0, y[q] != 0 ? off : 0.0);
        holds = holds && (is_active || y[q] == 0) && is_finite(y[q]);
        dual = larger(dual, one_side ? sign * longest : 0.0), primal = larger(primal, missed / (scale > 0 ? scale : 1.0));
      }
    }
    const double residual = larger(dual / (terms > 0 ? terms : 1.0), primal);
    return {holds && residual <= kkt_tol, residual, exact};
  }

 private:
  // the cost's gradient at x, the sizes of its terms, and roots of its curvatures
  void add_terms(const QPData<double>& d, const double* x) {
    const int n = s.n;
    for (int j = 0; j < n; ++j) {
      SIZE[j] = fabs(x[j]), ROOT[j] = d.damping[j];
      GRADIENT[j] = d.damping[j] * (x[j] - d.center[j]), SCALE[j] = d.damping[j] * (SIZE[j] + fabs(d.center[j]));
    }
    for (int i = 0; i < s.m; ++i) {
      const double *row = d.matrix + i * n, weight = d.weight[i];
      for (int j = 0; j < n; ++j) ROW[j] = fabs(row[j]);
      const double force = weight * (Team::own_dot(row, x, 0, n) - d.target[i]);
      const double size = weight * (Team::own_dot(ROW, SIZE, 0, n) + fabs(d.target[i]));
      for (int j = 0; j < n; ++j) {
        GRADIENT[j] += row[j] * force, SCALE[j] += ROW[j] * size, ROOT[j] += weight * row[j] * row[j];
      }
    }
    for (int j = 0; j < n; ++j) ROOT[j] = sqrt(ROOT[j] > 0 ? ROOT[j] : 1.0), INVERSE_ROOT[j] = 1 / ROOT[j];
  }
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
