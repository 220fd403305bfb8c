// Rank-revealing factors of a matrix: an orthonormal basis of its row space, and QR factors of its rows on the basis.
// The JAX function that this file equals is row_factors (solvers/_row_factors.py).
//
//   [A basis'; sqrt(damping) I] = orthonormal triangle
//
// Modified Gram-Schmidt with the longest remaining row as the pivot. Each new direction and each new column is
// orthogonalised twice, after which it is orthogonal to roundoff.
#pragma once
#include "linear_algebra.hpp"

namespace osik {

template <class Team> struct RowFactors {
  using Algebra = LinearAlgebra<Team>;
  Team t;
  int m, n, lm, ln, lc;  // rows and columns of A; strides of REST, of BASIS, of COLUMNS
  double* REST;          // [n, lm] what is left of A, transposed
  double* BASIS;         // [m, ln] orthonormal rows
  double* COLUMNS;       // [m, lc] columns of `orthonormal`, 2 m long
  double *ROW, *COEFFICIENTS, *SQUARES;  // [ln], [lm], [lm]

  static constexpr OSIK_HOST int doubles(int m, int n) {
    return n * Team::stride(m) + m * (Team::stride(n) + Team::stride(2 * m)) + Team::stride(n) + 2 * Team::stride(m);
  }
  OSIK_FN RowFactors(int m, int n, double* next)
      : m(m), n(n), lm(Team::stride(m)), ln(Team::stride(n)), lc(Team::stride(2 * m)), REST(next), BASIS(REST + n * lm),
        COLUMNS(BASIS + m * ln), ROW(COLUMNS + m * lc), COEFFICIENTS(ROW + ln), SQUARES(COEFFICIENTS + lm) {}

  // v <- v - sum_a (rows_a . given) rows_a over the first k rows, of which `length` numbers count. COEFFICIENTS gets
  // minus the products.
  OSIK_FN void subtract_span(const double* rows, int ld, int k, const double* given, double* v, int length) {
    t.each(0, k, [&](int a) { COEFFICIENTS[a] = -t.own_dot_on(rows + a * ld, given, 0, length); });
    Algebra::combine(t, rows, COEFFICIENTS, v, ld, k, 0, length, true);
  }
  // the k-th direction from the longest remaining row; false where that is no longer than the cutoff
  OSIK_CALL bool next_direction(int k, double cutoff) {
    const Best<double> b = t.best(-1.0, 0, m, [&](int a) { return SQUARES[a]; });
    if (b.which < 0) return false;  // NaN
    double* direction = BASIS + k * ln;
    t.each(0, n, [&](int j) { ROW[j] = direction[j] = REST[j * lm + b.which]; });
    subtract_span(BASIS, ln, k, ROW, direction, n);
    const double length = sqrt(t.dot(direction, direction, 0, n)), by = length > cutoff ? 1.0 / length : 0.0;
    t.each(0, n, [&](int j) { direction[j] = length > cutoff ? direction[j] * by : 0.0; });
    return length > cutoff;
  }
  // the rows' coefficients on the k-th direction, which is removed from them
  OSIK_CALL void project_rows(int k) {
    const double* direction = BASIS + k * ln;
    t.columns(0, m, [&](auto c) {
      using P = typename decltype(c)::P;
      const P along = Algebra::weighted_sum(c, direction, REST, lm, 0, n);
      P square(0.0);
      for (int j = 0; j < n; ++j) {
        P x = c.load(REST + j * lm);
        c.store(REST + j * lm, x.fma(-direction[j], along));
        square.square(x);
      }
      c.store(COLUMNS + k * lc, along);
      c.store(SQUARES, square);
    });
  }
  // the k-th column, of these coefficients and the root of the damping, orthogonal to those before it
  OSIK_CALL void next_column(int k, double root, double* triangle) {
    double* column = COLUMNS + k * lc;
    const int length = m + k + 1;
    t.once([&] { column[m + k] = root; });
    for (int again = 0; again < 2; ++again) {
      subtract_span(COLUMNS, lc, k, column, column, length);
      t.each(0, k, [&](int a) { triangle[a * m + k] -= COEFFICIENTS[a]; });
    }
    const double norm = sqrt(t.dot(column, column, 0, length)), by = 1.0 / norm;
    t.each(0, length, [&](int i) { column[i] *= by; });
    t.once([&] { triangle[k * m + k] = norm; });
  }
  // matrix: [m, n]; basis: [m, n]; orthonormal: [2 m, m]; triangle: [m, m], the identity from the rank on
  OSIK_CALL void solve(const double* matrix, double cutoff, double damping, double* basis, double* orthonormal,
                       double* triangle) {
    const double root = sqrt(damping);
    t.each(0, n * lm + m * ln + m * lc, [&](int e) { REST[e] = 0.0; });  // the next two as well
    t.each(0, m * m, [&](int e) { triangle[e] = e % (m + 1) == 0; });
    t.each(0, m, [&](int a) {
      SQUARES[a] = 0.0;
      for (int j = 0; j < n; ++j) {
        const double entry = matrix[a * n + j];
        REST[j * lm + a] = entry, SQUARES[a] += entry * entry;
      }
    });
    for (int k = 0; k < m && next_direction(k, cutoff); ++k) {
      project_rows(k);
      next_column(k, root, triangle);
    }
    t.each(0, m, [&](int k) {
      for (int j = 0; j < n; ++j) basis[k * n + j] = BASIS[k * ln + j];
      for (int i = 0; i < 2 * m; ++i) orthonormal[i * m + k] = COLUMNS[k * lc + i];
    });
  }
};

}  // namespace osik
