// Checks whether the answer of a hierarchy solves its problem, by the data of this alone: the C++ version of
// certify_levels in solvers/hqp/_cascade.py. Of a weighted QP: qp_certificate.hpp.
#pragma once
#include "hierarchy.hpp"
#include "qp_certificate.hpp"

namespace osik {

// x is clipped into its box first
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
