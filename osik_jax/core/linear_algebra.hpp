// Factorisations of the core, each once, for any team.
//
// Matrices are rows of a stride: entry (i, j) of M is M[i ld + j]. Lengths of arrays are given in brackets.
#pragma once
#include "team.hpp"

namespace osik {

template <class Real> OSIK_FN Real clip(Real a, Real low, Real high) { return a < low ? low : a > high ? high : a; }
template <class Real> OSIK_FN Real larger(Real a, Real b) { return b > a ? b : a; }
template <class Real> OSIK_FN Real square(Real a) { return a * a; }

template <class Team> struct LinearAlgebra {
  using Real = typename Team::Real;
  using Int = typename Team::Int;

  template <class T> OSIK_CALL static void copy(Team t, const T* from, T* to, int count) {
    t.each(0, count, [&](int j) { to[j] = from[j]; });
  }

  // out[i] = sum_j M[i, j] v[j] over start <= j < stop, for the n rows of M
  OSIK_CALL static void times(Team t, const Real* M, const Real* v, Real* out, int ld, int start, int stop, int n) {
    t.are_shared(M, v, out);
    t.each(0, n, [&](int i) { out[i] = t.own_dot(M + i * ld, v, start, stop); });
  }

  // out[j] = sum_i M[i, j] v[i] over the n rows of M, for start <= j < n
  OSIK_CALL static void transposed_times(Team t, const Real* M, const Real* v, Real* out, int ld, int start, int n) {
    t.are_shared(M, v, out);
    t.columns(start, n, [&](auto c) {
      auto total = typename decltype(c)::P(0);
      OSIK_UNROLL_4
      for (int i = 0; i < n; ++i) total.fma(v[i], c.load(M + i * ld));
      c.store(out, total);
    });
  }

  // The Householder reflection I - scale v v' that moves the entries [at, n) of `row` into entry `at`.
  // v: [n], row + sign(row[at]) |row| e_at, so that nothing cancels (Golub and Van Loan, Matrix Computations, 5.1)
  OSIK_FN static Real reflection(const Team& t, const Real* row, int at, int n, Real* v) {
    const Real norm = sqrt(t.dot(row, row, at, n)), head = row[at];
    t.each(at, n, [&](int j) { v[j] = j > at ? row[j] : head + (head < 0 ? -norm : norm); });
    return Real(1) / (norm * (norm + fabs(head)));
  }

  // The Gram matrix of `count` rows over the columns [start, n): its diagonal goes to `diagonal`, the rest to the upper
  // triangle of S, or to the lower one.
  OSIK_CALL static void gram(Team t, const Real* rows, Real* S, Real* diagonal, int ld, int ld_gram, int count, int start,
                             int n, bool lower) {
    t.are_shared(rows, S, diagonal);
    const int of_a = lower ? 1 : ld_gram, of_b = lower ? ld_gram : 1;
    t.pairs(count, [&](int a, int b) {
      const Real product = t.own_dot_on(rows + a * ld, rows + b * ld, start, n);
      if (a == b) diagonal[a] = product;
      else S[a * of_a + b * of_b] = product;
    });
  }

  // The Cholesky factor L of that matrix + ridge I, below the diagonal of S; `inverse` gets 1 / diagonal of L.
  // Pivots are at least 1e-300, so that a singular matrix gives large numbers and no NaN.
  OSIK_CALL static void cholesky(Team t, Real* S, const Real* diagonal, Real* inverse, int ld, int count, Real ridge,
                                 bool lower) {
    t.are_shared(S, diagonal, inverse);
    const int of_k = lower ? 1 : ld, of_a = lower ? ld : 1;
    for (int k = 0; k < count; ++k) {
      const Real* row_k = S + k * ld;
      t.each(k, count, [&](int a) {
        const Real entry = a == k ? diagonal[k] + ridge : S[k * of_k + a * of_a];
        const Real rest = entry - t.own_dot(S + a * ld, row_k, 0, k);
        if (a == k) inverse[k] = rest;
        else S[a * ld + k] = rest;
      });
      const Real inverse_pivot = t.inverse_root(larger(Team::SMALLEST_PIVOT, inverse[k]));
      t.each(k, count, [&](int a) {
        if (a == k) inverse[k] = inverse_pivot;
        else S[a * ld + k] *= inverse_pivot;
      });
    }
  }

  // S = L D L': the inverse M of L, with its ones and zeros, and inverse[k] = 1 / D_k. S has its upper triangle, which is
  // used up, or has M in the end if the team spares space. diagonal: [count] space. Returns whether every pivot D_k is at least `smallest` of the diagonal's S_kk.
  OSIK_CALL static bool inverse_factor(Team t, Real* S, Real* M, Real* inverse, Real* diagonal, int ld, int count,
                                       Real smallest) {
    t.are_shared(S, M, inverse, diagonal);
    if constexpr (Team::SPARES_SPACE) return t.inverse_factor(S, inverse, diagonal, ld, count, smallest);
    const int end = Team::padded(count);
    t.each(0, count, [&](int i) {
      diagonal[i] = S[i * ld + i];
      for (int j = 0; j < end; ++j) M[i * ld + j] = 0;
      M[i * ld + i] = 1;
    });
    bool regular = true;
    for (int k = 0; k < count && regular; ++k) {
      const Real* row = S + k * ld;
      const Real pivot = row[k], by = Real(1) / pivot;
      regular = pivot > 0 && pivot >= smallest * diagonal[k];
      t.once([&] { inverse[k] = by; });
      t.each(k + 1, count, [&](int i) {
        const Real factor = -row[i] * by;
        t.own_axpy_on(S + i * ld, factor, row, i, end);
        t.own_axpy_on(M + i * ld, factor, M + k * ld, 0, k + 1);
      });
    }
    return regular;
  }

  // b = S^-1 b = M' D^-1 M b with what inverse_factor gave; b has padded(count) places. work: [padded(count)]
  OSIK_CALL static void apply_inverse(Team t, const Real* M, const Real* inverse, Real* b, Real* work, int ld, int count) {
    t.are_shared(M, inverse, b, work);
    const int end = Team::padded(count);
    t.each(count, end, [&](int j) { b[j] = 0; });
    t.rows_times([&](int i) { return M + i * ld; }, [](int i) { return i + 1; }, b, work, count);
    t.each(0, count, [&](int i) { work[i] *= inverse[i]; });
    t.columns(0, count, [&](auto c) {
      auto total = typename decltype(c)::P(0);
      OSIK_UNROLL_4
      for (int i = c.at; i < count; ++i) total.fma(work[i], c.load(M + i * ld));
      c.store(b, total);
    });
  }

  // Householder QR with column pivoting of R [rows, n] over the columns [first, n): Q' R replaces R. A column is a pivot
  // while it is longer than `least`; the longest remaining column is taken first.
  // V: [rank, ld_V] reflections, scale: [rank], pivot: [rank] columns, squares: [n] squared lengths of the columns.
  // Returns the rank. OUTSIDE: V is in global memory, and the reflection at work in `near` [rows] too.
  template <bool OUTSIDE = false> OSIK_CALL static int pivoted_qr(Team t, Real* R, Real* V, Real* near, Real* squares,
                                                                  Real* scales, Int* pivot, int ld, int ld_V, int rows,
                                                                  int first, int n, Real least) {
    t.are_shared(R, squares, scales, pivot);
    int rank = 0;
    if (rows > 0)
      t.columns(first, n, [&](auto c) {
        auto total = typename decltype(c)::P(0);
        for (int a = 0; a < rows; ++a) total.square(c.load(R + a * ld));
        c.store(squares, total);
      });
    const int most = n - first < rows ? n - first : rows;
    while (rank < most) {
      const Best<Real> b = t.best(-1, first, n, [&](int j) { return squares[j]; });
      const Real norm = sqrt(larger(b.value, Real(0)));
      if (!(norm > least)) break;
      const int k = rank, which = b.which;
      Real* v = V + k * ld_V;
      if constexpr (OUTSIDE) v = near;
      t.are_shared(v);
      const Real head = R[k * ld + which], scale = Real(1) / (norm * (norm + fabs(head)));
      t.each(k, rows, [&](int a) {
        v[a] = a > k ? R[a * ld + which] : head + (head < 0 ? -norm : norm);
        if constexpr (OUTSIDE) V[k * ld_V + a] = v[a];
      });
      t.columns(first, n, [&](auto c) {  // R <- R - scale v (v' R), and the squares of the columns below row k
        using P = typename decltype(c)::P;
        const P total = weighted_sum(c, v, R, ld, k, rows);
        P rest(0);
        for (int a = k; a < rows; ++a) {
          P x = c.load(R + a * ld);
          x.fma(-scale * v[a], total);
          c.store(R + a * ld, x);
          if (a > k) rest.square(x);
        }
        c.store(squares, rest);
      });
      t.each(k, rows, [&](int a) {
        if (a > k) R[a * ld + which] = 0;
        else squares[which] = 0, scales[k] = scale, pivot[k] = which;
      });
      ++rank;
    }
    return rank;
  }

  // sum_a v[a] M[a, c] over start <= a < stop, as two sums that do not wait for each other
  template <class C> OSIK_FN static auto weighted_sum(C c, const Real* v, const Real* M, int ld, int start, int stop) {
    typename C::P even(0), odd(0);
    int a = start;
    OSIK_UNROLL_4
    for (; a + 1 < stop; a += 2) even.fma(v[a], c.load(M + a * ld)), odd.fma(v[a + 1], c.load(M + (a + 1) * ld));
    if (a < stop) even.fma(v[a], c.load(M + a * ld));
    return even += odd;
  }

  // out[j] = sum_k v[k] M[k, j] over the first `rows` rows of M, for start <= j < stop; `add`: added to what out has
  OSIK_CALL static void combine(Team t, const Real* M, const Real* v, Real* out, int ld, int rows, int start, int stop,
                                bool add) {
    t.are_shared(M, v, out);
    t.columns(start, stop, [&](auto c) {
      auto total = weighted_sum(c, v, M, ld, 0, rows);
      c.store(out, add ? total += c.load(out) : total);
    });
  }

  // out[i, a] = A[a row + i column] for `rows` rows and n columns of A
  OSIK_CALL static void transpose(Team t, const Real* A, int row, int column, Real* out, int ld, int rows, int n) {
    t.are_shared(out);
    if constexpr (Team::SPARES_SPACE) {
      t.each(0, rows, [&](int a) {
        OSIK_UNROLL_4
        for (int i = 0; i < n; ++i) t.fetch_one(out + i * ld + a, A + a * row + i * column);
      });
      t.arrive();
    } else {
      for (int first = 0; first < rows; first += 4) {
        const Real* r[4];
        for (int b = 0; b < 4; ++b) r[b] = A + (first + b < rows ? first + b : first) * row;
        t.each(0, n, [&](int i) {
          OSIK_UNROLL
          for (int b = 0; b < 4; ++b)
            if (first + b < rows) out[i * ld + first + b] = r[b][i * column];
        });
      }
    }
  }

  // M <- Q'M of the first `count` rows and n columns of M, with the reflections of pivoted_qr, two at a time.
  // OUTSIDE: V is in global memory, and the reflections at work in `near` [2, ld_near] too.
  template <bool OUTSIDE = false> OSIK_CALL static void apply_reflections(Team t, const Real* V, Real* near,
                                                                          const Real* scales, Real* M, int ld_V, int ld_near,
                                                                          int ld, int rank, int count, int n) {
    t.are_shared(scales, M);
    for (int k = 0; k < rank; k += 2) {
      const bool two = k + 1 < rank;
      const Real *v = V + k * ld_V, *w = two ? v + ld_V : v, scale_v = scales[k], scale_w = two ? scales[k + 1] : 0;
      if constexpr (OUTSIDE) {
        t.each(k, count, [&](int a) { near[a] = v[a], near[ld_near + a] = w[a]; });
        v = near, w = near + ld_near;
      }
      t.are_shared(v, w);
      const Real cross = two ? scale_v * t.dot(v, w, k + 1, count) : Real(0);
      t.columns(0, n, [&](auto c) {
        using P = typename decltype(c)::P;
        P along_v(0), along_w(0), head = c.load(M + k * ld);
        along_v.fma(v[k], head);
        OSIK_UNROLL_4
        for (int a = k + 1; a < count; ++a) {
          const P x = c.load(M + a * ld);
          along_v.fma(v[a], x), along_w.fma(w[a], x);
        }
        along_w.fma(-cross, along_v);
        c.store(M + k * ld, head.fma(-scale_v * v[k], along_v));
        for (int a = k + 1; a < count; ++a) {
          P x = c.load(M + a * ld);
          c.store(M + a * ld, x.fma(-scale_v * v[a], along_v).fma(-scale_w * w[a], along_w));
        }
      });
    }
  }

  // The y of least |M'y - b|^2, for the first `rows` rows of M [rows + 1, columns], which are independent, and its last
  // row b, in whose first places y is. Reflections from the right make M lower triangular.
  // v: [ld] zeros from `columns` on, as M has; inverse: [rows]
  OSIK_CALL static void least_squares_of_rows(Team t, Real* M, Real* v, Real* inverse, int ld, int rows, int columns) {
    t.are_shared(M, v, inverse);
    for (int k = 0; k < rows; ++k) {
      const Real scale = reflection(t, M + k * ld, k, columns, v);
      t.reflect(M + (k + 1) * ld, ld, rows - k, v, scale, k, columns);
      t.once([&] { inverse[k] = Real(1) / (M[k * ld + k] - v[k]); });
    }
    t.backward(M, ld, inverse, M + rows * ld, rows);
  }

  // out[b, j] = factor_b sum_i A[b row + i column] Z[i, j] over from <= i < to, for start <= j < n and the first `rows` of
  // four rows, so that each entry of Z is read once for four. `add`: added to what out has; `lower`: Z is lower
  // triangular, and the sums begin at the first column of a pack.
  OSIK_FN static void four_rows(const Team& t, const Real* A, int row, int column, const Real (&factor)[4], const Real* Z,
                                Real* out, int ld, int ld_out, int rows, int from, int to, int start, int n,
                                bool add = false, bool lower = false) {
    const Real* r[4];
    for (int b = 0; b < 4; ++b) r[b] = A + (b < rows ? b : 0) * row;
    t.narrow_columns(start, n, [&](auto c) {
      using P = typename decltype(c)::P;
      P total[4] = {P(0), P(0), P(0), P(0)};
      OSIK_UNROLL_4
      for (int i = lower && c.at > from ? c.at : from; i < to; ++i) {
        const P z = c.load(Z + i * ld);
        OSIK_UNROLL
        for (int b = 0; b < 4; ++b) total[b].fma(r[b][i * column], z);
      }
      OSIK_UNROLL
      for (int b = 0; b < 4; ++b)
        if (b < rows) {
          P out_b = add ? c.load(out + b * ld_out) : P(0);
          c.store(out + b * ld_out, out_b.fma(factor[b], total[b]));
        }
    });
  }

  // out = A M for `rows` rows of A, whose entry (a, i) is A[a row + i column], and `inner` rows and n columns of M;
  // `upper`: of a symmetric product, on and above the diagonal
  OSIK_CALL static void product(Team t, const Real* A, int row, int column, const Real* M, int ld, Real* out, int ld_out,
                                int rows, int inner, int n, bool upper = false) {
    const Real factor[4] = {1, 1, 1, 1};
    for (int first = 0; first < rows; first += 4)
      four_rows(t, A + first * row, row, column, factor, M, out + first * ld_out, ld, ld_out, rows - first, 0, inner,
                upper ? first : 0, n);
  }

  // S <- S - A'M in `rows` rows and the columns [from, to) of S, over `inner` rows of A and M; all strides are ld.
  // lower: M is lower triangular; upper: S is symmetric, and its packs of 8 columns on and above the diagonal are done
  OSIK_CALL static void subtract_product(Team t, const Real* A, const Real* M, Real* S, int ld, int rows, int inner,
                                         int from, int to, bool lower = false, bool upper = false) {
    const Real factor[4] = {-1, -1, -1, -1};
    for (int first = 0; first < rows; first += 4)
      four_rows(t, A + first, 1, ld, factor, M, S + first * ld, ld, ld, rows - first, 0, inner, upper ? first / 8 * 8 : from,
                to, true, lower);
  }

  // The product of a level's rows with the basis Z: R[a, j] = sum_i A[a, i] Z[i, j] for start <= j < n, or 0 where
  // in_cost[a] is 0. Entry i of row a is A[a row + i column]; it is 0 outside of [nonzero[a], nonzero_end[a]).
  OSIK_CALL static void rows_times_basis(Team t, const Real* A, int row, int column, const Real* Z, Real* R, int ld,
                                         const Int* in_cost, const Int* nonzero, const Int* nonzero_end, int rows, int start,
                                         int n) {
    t.are_shared(Z, R, in_cost, nonzero, nonzero_end);
    for (int first = 0; first < rows; first += 4) {
      Real factor[4];
      int from = n, to = 0;
      for (int b = 0; b < 4; ++b) {
        const int a = first + b;
        const bool in = a < rows && in_cost[a];
        factor[b] = in ? 1 : 0;
        if (in) from = nonzero[a] < from ? nonzero[a] : from, to = nonzero_end[a] > to ? nonzero_end[a] : to;
      }
      four_rows(t, A + first * row, row, column, factor, Z, R + first * ld, ld, ld, rows - first, from, to, start, n);
    }
  }
};

}  // namespace osik
