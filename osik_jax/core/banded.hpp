// The banded system of a clip: block Cholesky from the first frame to the last, and back.
//
// Frame t has a block on the diagonal, a block B_t one frame back, and a diagonal block diag(s_t) two frames back. With
// U' = L the blocks of the factor are kept transposed, so that all products are of the kind A'B: U_t on the diagonal,
// N_t = L[t-1]^-1 B_t' one frame back, G_t = L[t-2]^-1 diag(s_t) two frames back, lower triangular. The right-hand side
// is column n of each block: factoring the matrix solves for y meanwhile. Diagonals of U hold inverses.
#pragma once
#include "linear_algebra.hpp"

namespace osik {

// Gauss-Newton's system of a clip of F frames.
struct ClipSystem {
  static constexpr int POINTS = 8;  // rows of standing points in a frame
  double* blocks;    // [F, N, N] upper triangles of J'J, with -J'residual in column n
  double* moving;    // [F, POINTS, N] Jacobians of the standing points
  double* weight;    // [F, POINTS] of what standing points move from the last frame to this one
  double* gradient;  // [F, n]
  double *alone, *first, *second;  // [F, n] diagonals: of the frame, one frame back, two frames back
  static size_t doubles(int frames, int n, int N) { return size_t(frames) * (N * N + POINTS * N + POINTS + 4 * n); }
  double* place(double* next, int frames, int n, int N) {
    blocks = next, moving = blocks + size_t(frames) * N * N, weight = moving + frames * POINTS * N;
    gradient = weight + frames * POINTS, alone = gradient + frames * n, first = alone + frames * n;
    return (second = first + frames * n) + frames * n;
  }
};

struct Banded {
  using Team = Serial<double>;
  using Algebra = LinearAlgebra<Team>;
  static constexpr int TILE = 8, POINTS = ClipSystem::POINTS;  // rows of a block of the dense factorisations
  Team t;
  int n, N;              // dofs, stride of rows: a multiple of TILE above n
  double *upper, *near;  // [F, N, N] U_t and N_t
  double* G;             // [N, N]
  double *scaled, *plain;  // [POINTS, N]
  double *v, *z;         // [N]

  static int stride(int n) { return (n + 1 + TILE - 1) / TILE * TILE; }
  static size_t doubles(int frames, int N) { return 2 * size_t(frames) * N * N + N * N + 2 * POINTS * N + 2 * N + TILE; }
  Banded(int n, int frames, double* next) : n(n), N(stride(n)) {
    const size_t block = size_t(N) * N;
    upper = next, near = upper + frames * block, G = near + frames * block, scaled = G + block;
    plain = scaled + POINTS * N, v = plain + POINTS * N, z = v + N;
  }

  static bool any(const double* a, int count) {
    bool some = false;
    for (int i = 0; i < count; ++i) some |= a[i] != 0.0;
    return some;
  }
  // whether frame t has a block one frame back; frames after a clip's end have none
  bool is_coupled(const ClipSystem& s, int k) const {
    return any(s.weight + k * POINTS, POINTS) || any(s.first + k * n, n) || any(s.second + k * n, n);
  }
  // S <- S - A'M for `rows` columns of A and the columns [from, N) of M, over `inner` rows; `lower`: M is lower
  // triangular, so that row i of M begins nothing after column i
  OSIK_FN void subtract(const double* A, const double* M, double* S, int rows, int inner, int from, bool lower) const {
    Algebra::subtract_product(t, A, M, S, N, rows, inner, from, N, lower);
  }
  // S = U'U of the upper triangle of S [n, N], and U'^-1 for the columns from n on; false where it is not positive
  OSIK_CALL bool factor(double* S) const {
    for (int p = 0; p < n; p += TILE) {
      const int end = p + TILE < n ? p + TILE : n;
      subtract(S + p, S, S + p * N, end - p, p, p, false);
      for (int k = p; k < end; ++k) {
        double* row = S + k * N;
        if (!(row[k] > 0.0)) return false;
        const double inverse = 1.0 / std::sqrt(row[k]);
        for (int j = k / TILE * TILE; j < N; ++j) row[j] *= inverse;
        for (int i = k + 1; i < end; ++i) t.own_axpy(S + i * N, -row[i], row, k / TILE * TILE, N);
        row[k] = inverse;
      }
    }
    return true;
  }
  // X <- U'^-1 X, X [n, N]; `lower`: X is lower triangular before and after
  OSIK_CALL void solve_transposed(const double* U, double* X, bool lower) const {
    for (int p = 0; p < n; p += TILE) {
      const int end = p + TILE < n ? p + TILE : n, columns = lower ? p + TILE : N;
      Algebra::subtract_product(t, U + p, X, X + p * N, N, end - p, p, 0, columns, lower);
      for (int k = p; k < end; ++k) {
        for (int j = 0; j < columns; ++j) X[k * N + j] *= U[k * N + k];
        for (int i = k + 1; i < end; ++i) t.own_axpy(X + i * N, -U[k * N + i], X + k * N, 0, columns);
      }
    }
  }
  // S = the frame's own block, with its right-hand side in column n
  void start(double* S, const double* block, const double* alone, double damping, const double* right) const {
    for (int i = 0; i < n; ++i) {
      for (int j = i / TILE * TILE; j < N; ++j) S[i * N + j] = block[i * N + j];
      S[i * N + i] += alone[i] + damping, S[i * N + n] = right[i];
    }
  }
  // X = diag(first) - before' diag(weight) rows: the block one frame back
  void couple(double* X, const double* rows, const double* before, const double* weight, const double* first) const {
    for (int e = 0; e < n * N; ++e) X[e] = 0.0;
    for (int i = 0; i < n; ++i) X[i * N + i] = first[i];
    int count = 0;
    for (int k = 0; k < POINTS; ++k) {
      if (weight[k] == 0.0) continue;
      for (int j = 0; j < N; ++j) {
        scaled[count * N + j] = j < n ? weight[k] * rows[k * N + j] : 0.0;
        plain[count * N + j] = j < n ? before[k * N + j] : 0.0;
      }
      ++count;
    }
    if (count) subtract(plain, scaled, X, n, count, 0, false);
  }
  // Solve one system with more on its diagonal; x is NaN where it is not positive definite.
  // damping: [F]; right, x: [F, n]
  void solve(const ClipSystem& s, const double* damping, const double* right, double* x, int frames) const {
    const size_t block = size_t(N) * N;
    for (; frames > 1 && !is_coupled(s, frames - 1) && !any(right + (frames - 1) * n, n); --frames)
      for (int i = 0; i < n; ++i) x[(frames - 1) * n + i] = 0.0;  // after the clip's end
    for (int k = 0; k < frames; ++k) {
      double *S = upper + k * block, *X = near + k * block;
      start(S, s.blocks + k * block, s.alone + k * n, damping[k], right + k * n);
      const bool far = any(s.second + k * n, n);
      if (far) {
        for (int e = 0; e < n * N; ++e) G[e] = 0.0;
        for (int i = 0; i < n; ++i) G[i * N + i] = s.second[k * n + i];
        solve_transposed(S - 2 * block, G, true);
      }
      if (is_coupled(s, k)) {
        couple(X, s.moving + k * POINTS * N, s.moving + (k - 1) * POINTS * N, s.weight + k * POINTS, s.first + k * n);
        if (far) subtract(X - block, G, X, n, n, 0, true);
        solve_transposed(S - block, X, false);
        for (int i = 0; i < n; ++i) X[i * N + n] = (S - block)[i * N + n];
        Algebra::subtract_product(t, X, X, S, N, n, n, 0, N, false, true);
      }
      if (far) {
        Algebra::subtract_product(t, G, G, S, N, n, n, 0, N, true, true);
        for (int j = 0; j < n; ++j) v[j] = 0.0;
        for (int i = 0; i < n; ++i) t.own_axpy(v, (S - 2 * block)[i * N + n], G + i * N, 0, i + 1);
        for (int i = 0; i < n; ++i) S[i * N + n] -= v[i];
      }
      if (!factor(S)) {
        for (int e = 0; e < frames * n; ++e) x[e] = __builtin_nan("");
        return;
      }
    }
    for (int k = frames - 1; k >= 0; --k) {
      const double *U = upper + k * block, *X = U + block - upper + near;
      for (int i = 0; i < n; ++i) v[i] = U[i * N + n];
      if (k + 1 < frames && is_coupled(s, k + 1))
        for (int i = 0; i < n; ++i) v[i] -= t.own_dot(X + i * N, x + (k + 1) * n, 0, n);
      if (k + 2 < frames && any(s.second + (k + 2) * n, n)) {
        for (int i = 0; i < n; ++i) z[i] = s.second[(k + 2) * n + i] * x[(k + 2) * n + i];
        for (int i = 0; i < n; ++i) {
          z[i] *= U[i * N + i];
          t.own_axpy(z, -z[i], U + i * N, i + 1, n);
        }
        for (int i = 0; i < n; ++i) v[i] -= z[i];
      }
      for (int i = n - 1; i >= 0; --i) v[i] = (v[i] - t.own_dot(U + i * N, v, i + 1, n)) * U[i * N + i];
      for (int i = 0; i < n; ++i) x[k * n + i] = v[i];
    }
  }
};

}  // namespace osik
