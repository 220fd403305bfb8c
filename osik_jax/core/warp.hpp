// The team of a GPU: the 32 threads of a CUDA warp, with the workspace in shared memory.
#pragma once
#include "team.hpp"

namespace osik {

struct Column {
  int at;
  template <class Real> struct Number {
    Real v;
    OSIK_FN Number() {}
    OSIK_FN Number(Real a) : v(a) {}
    OSIK_FN Number& operator+=(const Number& o) { return v += o.v, *this; }
    OSIK_FN Number& operator-=(const Number& o) { return v -= o.v, *this; }
    OSIK_FN Number& operator*=(const Number& o) { return v *= o.v, *this; }
    OSIK_FN Number inverse() const { return Real(1) / v; }
    OSIK_FN Number& fma(Real a, const Number& o) { return v += a * o.v, *this; }
    OSIK_FN Number& square(const Number& o) { return v += o.v * o.v, *this; }
  };
};

template <class Real> struct ColumnOf : Column {
  using P = Number<Real>;
  OSIK_FN P load(const Real* row) const { return row[at]; }
  OSIK_FN void store(Real* row, const P& p) const { row[at] = p.v; }
};

extern __shared__ double shared_space[];  // of one problem: a block is one warp

// An array of a workspace in shared memory. Its address is a constant, so that no register and no member holds it.
template <class T, class At, class Sizes> struct SharedArray {
  OSIK_FN void place(char*, const Sizes&) {}
  OSIK_FN operator T*() const {
    constexpr int at = At::of(Sizes{});
    return reinterpret_cast<T*>(reinterpret_cast<char*>(shared_space) + at);
  }
};

// Space is laid out for N variables, M rows of a level and H hard rows, which are constants of a compilation.
template <class R, int N, int M, int H> struct Warp : WarpSizes<R> {
  using Real = R;
  using typename WarpSizes<R>::Int;
  template <class T, class At, class Sizes> using Array = SharedArray<T, At, Sizes>;
  static constexpr Real SMALLEST_PIVOT = sizeof(R) == 8 ? 1e-300 : 1e-37;
  static constexpr Real SMALLEST_ROOT = sizeof(R) == 8 ? 1e-150 : 1e-18;
  static constexpr unsigned ALL = 0xffffffffu;
  static constexpr OSIK_HOST int variables(int) { return N; }
  static constexpr OSIK_HOST int level_rows(int) { return M; }
  static constexpr OSIK_HOST int hard_rows(int) { return H; }
  OSIK_FN static int me() { return threadIdx.x & 31; }

  template <class F> OSIK_FN void each(int a, int b, F f) const {
    __syncwarp();
#pragma unroll 1
    for (int i = a + me(); i < b; i += 32) f(i);
    __syncwarp();
  }
  template <class F> OSIK_FN void once(F f) const {
    __syncwarp();
    if (me() == 0) f();
    __syncwarp();
  }
  template <class F> OSIK_FN void pairs(int count, F f) const {  // row a and row count - 1 - a have count + 1 pairs
    __syncwarp();
#pragma unroll 1
    for (int e = me(); e < (count + 1) / 2 * (count + 1); e += 32) {
      const int r = e / (count + 1), k = e % (count + 1);
      const int a = k < count - r ? r : count - 1 - r, b = k < count - r ? r + k : k - 1;
      if (k < count - r || a != r) f(a, b);
    }
    __syncwarp();
  }
  OSIK_FN static Real inverse_root(Real a) { return rsqrt(a); }
  // tells the compiler that these arrays are in shared memory, whose instructions are shorter
  template <class... P> OSIK_FN static void are_shared(P... p) { (__builtin_assume(__isShared(p)), ...); }
  OSIK_FN void nonzero(const Real* A, int row, int column, int rows, int n, Int* from, Int* to) const {
    __syncwarp();
#pragma unroll 4
    for (int a = 0; a < rows; ++a) {
      int first = n, last = 0;
      for (int i = me(); i - me() < n; i += 32) {
        const unsigned some = __ballot_sync(ALL, i < n && A[a * row + i * column] != Real(0));
        if (some) first = first < n ? first : i - me() + __ffs(some) - 1, last = i - me() + 32 - __clz(some);
      }
      if (me() == a % 32) from[a] = first, to[a] = last;
    }
    __syncwarp();
  }
  template <class F> OSIK_FN void columns(int a, int b, F f) const {
    __syncwarp();
#pragma unroll 1
    for (int i = a + me(); i < b; i += 32) f(ColumnOf<R>{{i}});
    __syncwarp();
  }
  template <class F> OSIK_FN void narrow_columns(int a, int b, F f) const { columns(a, b, f); }

  // ---- reductions
  OSIK_CALL static Real all_sum(Real t) {
#pragma unroll
    for (int d = 16; d; d /= 2) t += __shfl_xor_sync(ALL, t, d);
    return t;
  }
  OSIK_CALL static Real all_most(Real t) {
#pragma unroll
    for (int d = 16; d; d /= 2) {
      const Real v = __shfl_xor_sync(ALL, t, d);
      t = v > t || v != v ? v : t;
    }
    return t;
  }
  OSIK_CALL static Best<R> all_best(Best<R> r) {
#pragma unroll
    for (int d = 16; d; d /= 2) {
      const Real v = __shfl_xor_sync(ALL, r.value, d);
      const int w = __shfl_xor_sync(ALL, r.which, d);
      if (v > r.value || (v == r.value && w < r.which)) r = {v, w};
    }
    return r;
  }
  template <class F> OSIK_FN Real sum(int a, int b, F f) const {
    Real t = 0;
#pragma unroll 1
    for (int i = a + me(); i < b; i += 32) t += f(i);
    return all_sum(t);
  }
  template <class F> OSIK_FN int count(int a, int b, F f) const {
    int t = 0;
    __syncwarp();
#pragma unroll 1
    for (int i = a + me(); i < b; i += 32) t += f(i);
    __syncwarp();  // f may write what its thread owns
    return __reduce_add_sync(ALL, t);
  }
  template <class F> OSIK_FN Real most(Real t, int a, int b, F f) const {
#pragma unroll 1
    for (int i = a + me(); i < b; i += 32) {
      const Real v = f(i, t);
      t = v > t || v != v ? v : t;
    }
    return all_most(t);
  }
  template <class F> OSIK_FN Best<R> best(Real t, int a, int b, F f) const {
    constexpr int NONE = 1 << 20;
    Best<R> r{t, NONE};
#pragma unroll 1
    for (int i = a + me(); i < b; i += 32) {
      const Real v = f(i);
      if (v > r.value) r = {v, i};
    }
    r = all_best(r);
    if (r.which == NONE) r.which = -1;
    return r;
  }

  // the largest |a_j b_j|; NaN counts as none
  OSIK_FN Real largest(const Real* a, const Real* b, int n) const {
    return best(Real(0), 0, n, [&](int j) { return fabs(a[j] * b[j]); }).value;
  }

  // ---- vectors
  OSIK_FN static Real own_dot(const Real* a, const Real* b, int start, int stop, int step = 1) {
    Real even = 0, odd = 0;
    int j = start;
#pragma unroll 1
    for (; j + 1 < stop; j += 2) even += a[j * step] * b[j], odd += a[(j + 1) * step] * b[j + 1];
    if (j < stop) even += a[j * step] * b[j];
    return even + odd;
  }
  OSIK_FN static Real own_dot_on(const Real* a, const Real* b, int start, int n, int step = 1) {
    return own_dot(a, b, start, n, step);
  }
  OSIK_FN static Real own_row(const Real* a, const Real* b, int from, int to, int, int step) {
    return own_dot(a, b, from, to, step);
  }
  OSIK_FN static Real own_square(const Real* a, int start, int stop, int step) {
    Real even = 0, odd = 0;
    int j = start;
#pragma unroll 4
    for (; j + 1 < stop; j += 2) even += a[j * step] * a[j * step], odd += a[(j + 1) * step] * a[(j + 1) * step];
    return j < stop ? even + odd + a[j * step] * a[j * step] : even + odd;
  }
  OSIK_FN static void own_axpy(Real* a, Real by, const Real* b, int start, int stop) {
#pragma unroll 2
    for (int j = start; j < stop; ++j) a[j] += by * b[j];
  }
  OSIK_FN static void own_axpy_on(Real* a, Real by, const Real* b, int start, int n) { own_axpy(a, by, b, start, n); }
  OSIK_FN static int own_end(const Real*, int n) { return n; }
  OSIK_FN void scaled_copy(Real* to, Real by, const Real* from, int n) const {
    each(0, n, [&](int j) { to[j] = by * from[j]; });
  }
  OSIK_FN void scaled_rows(Real* to, int ld, const Real* factor, const Real* from, int rows, int n) const {
    constexpr int AHEAD = 8;  // loads from global memory that wait together
    __syncwarp();
    for (int first = me(); first < rows * N; first += 32 * AHEAD) {
      Real entry[AHEAD];
OSIK_UNROLL
      for (int u = 0; u < AHEAD; ++u) entry[u] = first + 32 * u < rows * N ? from[first + 32 * u] : Real(0);
OSIK_UNROLL
      for (int u = 0; u < AHEAD; ++u) {
        const int e = first + 32 * u, a = e / N;
        if (e < rows * N) to[a * ld + e - a * N] = factor[a] * entry[u];
      }
    }
    __syncwarp();
  }
  template <class Row, class End> OSIK_FN void rows_times(Row row, End end, const Real* v, Real* out, int count) const {
    each(0, count, [&](int a) { out[a] = own_dot(row(a), v, 0, end(a)); });
  }
  // S[a, b] = sum_j row(a)_j weight_j row(b)_j for a <= b < count
  template <class Row, class End>
  OSIK_FN void weighted_gram(Row row, End, const Real* weight, Real* S, Real*, int ld_S, int, int count) const {
    pairs(count, [&](int a, int b) {
      const Real *first = row(a), *second = row(b);
      Real even = 0, odd = 0;
#pragma unroll 4
      for (int j = 0; j + 1 < N; j += 2)
        even += first[j] * weight[j] * second[j], odd += first[j + 1] * weight[j + 1] * second[j + 1];
      if (N % 2) even += first[N - 1] * weight[N - 1] * second[N - 1];
      S[a * ld_S + b] = even + odd;
    });
  }
  OSIK_CALL Real dot(const Real* a, const Real* b, int start, int stop) const {
    __syncwarp();
    return sum(start, stop, [&](int j) { return a[j] * b[j]; });
  }
  OSIK_CALL void axpy(Real* a, Real by, const Real* b, int start, int stop) const {
    each(start, stop, [&](int j) { a[j] += by * b[j]; });
  }
  OSIK_CALL void reflect(Real* rows, int ld, int count, const Real* v, Real scale, int at, int n) const {
    are_shared(rows, v);
    each(0, count, [&](int q) {
      Real* r = rows + q * ld;
      const Real by = -scale * own_dot(r, v, at, n);
      if (by != Real(0)) own_axpy(r, by, v, at, n);
    });
  }

  // LinearAlgebra::inverse_factor, in the place of S. Thread j has column j: of what is left of S from row k on, of the
  // inverse M in the columns before k.
  OSIK_FN bool inverse_factor(Real* S, Real* inverse, Real* diagonal, int ld, int count, Real smallest) const {
    each(0, count, [&](int j) {
      diagonal[j] = S[j * ld + j];
#pragma unroll 4
      for (int i = j + 1; i < count; ++i) S[i * ld + j] = S[j * ld + i];
    });
    bool regular = true;
#pragma unroll 1
    for (int k = 0; k < count && regular; ++k) {
      const Real* row = S + k * ld;
      const Real pivot = row[k], by = Real(1) / pivot;
      regular = pivot > 0 && pivot >= smallest * diagonal[k];
      each(0, count, [&](int j) {
        const bool is_pivot = j == k;  // whose column of S is done, so that that of M begins
        const Real factor = is_pivot ? by : by * row[j];
        Real* column = S + j;
        if (is_pivot) inverse[k] = by;
#pragma unroll 4
        for (int i = k + 1; i < count; ++i)
          column[i * ld] = (is_pivot ? Real(0) : column[i * ld]) - row[i] * factor;
      });
    }
    each(0, count, [&](int j) {
      for (int i = 0; i < j; ++i) S[i * ld + j] = 0;
      S[j * ld + j] = 1;
    });
    return regular;
  }

  // ---- triangular systems of at most 64 equations; entry k of y stays in a register of thread k % 32
  OSIK_FN void forward(const Real* L, int ld, const Real* inverse, Real* y, int count) const {
    substitute(L, ld, 1, inverse, y, count, 1);
  }
  OSIK_FN void backward(const Real* L, int ld, const Real* inverse, Real* y, int count) const {
    substitute(L, 1, ld, inverse, y, count, -1);
  }
  OSIK_CALL void substitute(const Real* L, int row, int column, const Real* inverse, Real* y, int count,
                            int way) const {
    are_shared(L, inverse, y);
    __syncwarp();
    Real low = me() < count ? y[me()] : Real(0), high = me() + 32 < count ? y[me() + 32] : Real(0);
#pragma unroll 1
    for (int s = 0, k = way > 0 ? 0 : count - 1; s < count; ++s, k += way) {
      const Real z = __shfl_sync(ALL, k < 32 ? low : high, k & 31) * inverse[k];
      if (me() == k) low = z;
      else if (me() < count && (me() - k) * way > 0) low -= L[me() * row + k * column] * z;
      if (me() + 32 == k) high = z;
      else if (me() + 32 < count && (me() + 32 - k) * way > 0) high -= L[(me() + 32) * row + k * column] * z;
    }
    if (me() < count) y[me()] = low;
    if (me() + 32 < count) y[me() + 32] = high;
    __syncwarp();
  }
};

}  // namespace osik
