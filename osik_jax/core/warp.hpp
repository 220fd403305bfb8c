// The team of a GPU: the 32 threads of a CUDA warp, with the workspace in shared memory.
#pragma once
#include "team.hpp"

namespace osik {

template <class R> struct Number {
  using Real = R;
  using Value = R;
  OSIK_FN static R all(R a) { return a; }
  OSIK_FN static R size(R a) { return fabs(a); }
};

// One column of a thread, or two that are 32 apart: of the second one only numbers before `end` count.
template <class Real, int SLOTS> struct ColumnsOf {
  int at, end;
  using P = Pack<Number<Real>, SLOTS>;
  OSIK_FN P load(const Real* row) const {
    P p;
    return P::each([&](int s) { p.v[s] = row[s && at + 32 * s >= end ? at : at + 32 * s]; }), p;
  }
  OSIK_FN void store(Real* row, const P& p) const {
    P::each([&](int s) {
      if (!s || at + 32 * s < end) row[at + 32 * s] = p.v[s];
    });
  }
};

template <int K> struct Constant {
  static constexpr int value = K;
};

extern __shared__ __align__(16) double shared_space[];  // of one problem: a block is one warp

// An array of a workspace in shared memory. Its address is a constant, so that no register and no member holds it.
template <class T, class At, class Sizes> struct SharedArray {
  OSIK_FN SharedArray(char*, const Sizes&) {}
  OSIK_FN operator T*() const {
    constexpr int at = At::of(Sizes{});
    return reinterpret_cast<T*>(reinterpret_cast<char*>(shared_space) + at);
  }
};

// A number that depends on a problem's sizes: a constant too, so that loops have constant ends.
template <class At, class Sizes> struct SizeConstant {
  OSIK_FN SizeConstant(char*, const Sizes&) {}
  OSIK_FN operator int() const {
    constexpr int value = At::of(Sizes{});
    return value;
  }
};

// Space is laid out for N variables, M rows of a level and H hard rows, which are constants of a compilation.
template <class R, int N, int M, int H> struct Warp : WarpSizes<R> {
  using Real = R;
  using typename WarpSizes<R>::Int;
  template <class T, class At, class Sizes> using Array = SharedArray<T, At, Sizes>;
  template <class At, class Sizes> using Fixed = SizeConstant<At, Sizes>;
  static constexpr unsigned ALL = 0xffffffffu;
  static constexpr int SLOTS = sizeof(R) == 4 && N > 32 ? 2 : 1;  // columns of a thread at once
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
  template <class... P> OSIK_FN static void are_global(P... p) { (__builtin_assume(__isGlobal(p)), ...); }
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
    for (int i = a + me(); i < b; i += 32 * SLOTS) f(ColumnsOf<R, SLOTS>{i, b});
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
  OSIK_FN static bool all(bool flag) { return __all_sync(ALL, flag); }
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
    Real most = 0;
#pragma unroll 1
    for (int j = me(); j < n; j += 32) {
      const Real v = fabs(a[j] * b[j]);
      most = v > most ? v : most;
    }
    if constexpr (sizeof(R) == 4)
      return __uint_as_float(__reduce_max_sync(ALL, __float_as_uint(most)));  // as they are not negative
    return all_most(most);
  }

  // ---- vectors
  OSIK_FN static Real own_dot(const Real* a, const Real* b, int start, int stop, int step = 1) {
    Real even = 0, odd = 0;
    int j = start;
#pragma unroll 1
    for (; j + 3 < stop; j += 4) {
      even += a[j * step] * b[j], odd += a[(j + 1) * step] * b[j + 1];
      even += a[(j + 2) * step] * b[j + 2], odd += a[(j + 3) * step] * b[j + 3];
    }
#pragma unroll 1
    for (; j < stop; ++j) even += a[j * step] * b[j];
    return even + odd;
  }
  // f of four numbers of each of two padded rows at a time
  template <class F> OSIK_FN static void own_fours(const Real* a, const Real* b, int n, F f) {
#pragma unroll 3
    for (int j = 0; j < n; j += 4) {
      const float4 u = *reinterpret_cast<const float4*>(a + j), v = *reinterpret_cast<const float4*>(b + j);
      f(u.x * v.x, u.y * v.y, u.z * v.z, u.w * v.w);
    }
  }
  // in single precision from the first number on
  OSIK_FN static Real own_dot_on(const Real* a, const Real* b, int start, int n, int step = 1) {
    if constexpr (sizeof(R) == 8) return own_dot(a, b, start, n, step);
    Real even = 0, odd = 0;
    own_fours(a, b, n, [&](Real x, Real y, Real z, Real w) { even += x, odd += y, even += z, odd += w; });
    return even + odd;
  }
  OSIK_FN static Real own_size_on(const Real* a, const Real* b, int n) {
    Real even = 0, odd = 0;
    if constexpr (sizeof(R) == 4)
      own_fours(a, b, n,
                [&](Real x, Real y, Real z, Real w) { even += fabs(x), odd += fabs(y), even += fabs(z), odd += fabs(w); });
    else
      for (int j = 0; j < n; ++j) even += fabs(a[j] * b[j]);
    return even + odd;
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
  // a[j step] = f(j, a[j step]); four are read before the first is written, so that reads need not wait for writes
  template <class F> OSIK_FN static void own_update(Real* a, int step, int start, int stop, F f) {
    int j = start;
#pragma unroll 1
    for (; j + 3 < stop; j += 4) {
      Real x[4];
#pragma unroll
      for (int b = 0; b < 4; ++b) x[b] = f(j + b, a[(j + b) * step]);
#pragma unroll
      for (int b = 0; b < 4; ++b) a[(j + b) * step] = x[b];
    }
#pragma unroll 1
    for (; j < stop; ++j) a[j * step] = f(j, a[j * step]);
  }
  OSIK_FN static void own_axpy(Real* a, Real by, const Real* b, int start, int stop) {
    own_update(a, 1, start, stop, [&](int j, Real x) { return x + by * b[j]; });
  }
  OSIK_FN static void own_axpy_on(Real* a, Real by, const Real* b, int start, int n) { own_axpy(a, by, b, start, n); }
  OSIK_FN static int own_end(const Real*, int n) { return n; }
  // Numbers that begin to arrive in shared memory while the threads go on; zeros where there are none.
  OSIK_FN static void fetch_one(Real* to, const Real* from, bool there = true) {
    are_global(from);
    asm volatile("cp.async.ca.shared.global [%0], [%1], %2, %3;" ::"r"(unsigned(__cvta_generic_to_shared(to))), "l"(from),
                 "n"(sizeof(R)), "r"(there ? int(sizeof(R)) : 0));
  }
  OSIK_FN void fetch(Real* to, const Real* from, int count) const {
    for (int i = me(); i < count; i += 32) fetch_one(to + i, from + i);
  }
  OSIK_FN void fetch_rows(Real* to, int ld, const Real* from, int rows) const {
    constexpr int PADDED = Warp::padded(N);
#pragma unroll 2
    for (int e = me(); e < rows * PADDED; e += 32) {
      const int a = e / PADDED, j = e - a * PADDED;
      fetch_one(to + a * ld + j, from + (j < N ? a * N + j : 0), j < N);
    }
  }
  OSIK_FN void arrive() const {
    asm volatile("cp.async.wait_all;" ::: "memory");
    __syncwarp();
  }
  OSIK_FN void scaled_rows(Real* to, int ld, const Real* factor, const Real*, int rows, int) const {
    if (factor)
      columns(0, N, [&](auto c) {
#pragma unroll 4
        for (int a = 0; a < rows; ++a) {
          auto row = c.load(to + a * ld);
          c.store(to + a * ld, row *= factor[a]);
        }
      });
  }
  template <class Row, class End> OSIK_FN void rows_times(Row row, End end, const Real* v, Real* out, int count) const {
    each(0, count, [&](int a) { out[a] = own_dot_on(row(a), v, 0, end(a)); });
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

  // B <- Z B in the place of B [N, ld_B], of which the first `columns` columns count, without the rows before `first`
  OSIK_FN void turn(const Real* Z, int ld, Real* B, int ld_B, int first, int columns) const {
    constexpr int HELD = (N + 31) / 32, SOME = 4;
#pragma unroll 1
    for (int a = 0; a < columns; a += SOME) {
      Real total[HELD][SOME];
#pragma unroll
      for (int h = 0; h < HELD; ++h) {
        const int j = first + me() + 32 * h;
        const Real* row = Z + (j < N ? j : N - 1) * ld;
#pragma unroll
        for (int b = 0; b < SOME; ++b) total[h][b] = 0;
#pragma unroll 2
        for (int i = 0; i < N; ++i)
#pragma unroll
          for (int b = 0; b < SOME; ++b) total[h][b] += row[i] * B[i * ld_B + a + b];
      }
      __syncwarp();
#pragma unroll
      for (int h = 0; h < HELD; ++h)
#pragma unroll
        for (int b = 0; b < SOME; ++b)
          if (first + me() + 32 * h < N && a + b < columns) B[(first + me() + 32 * h) * ld_B + a + b] = total[h][b];
      __syncwarp();
    }
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
        if (is_pivot) inverse[k] = by;
        own_update(S + j, ld, k + 1, count, [&](int i, Real x) { return (is_pivot ? Real(0) : x) - row[i] * factor; });
      });
    }
    each(0, Warp::padded(count), [&](int j) {
      for (int i = 0; i < j && i < count; ++i) S[i * ld + j] = 0;
      if (j < count) S[j * ld + j] = 1;
    });
    return regular;
  }
  // The inverse of the Cholesky factor of A = B'B + D, whose diagonal is made 1 + ridge times as large. Variables that are
  // not free have a row and a column of the identity. A stays in registers: thread i has column i, and of column i + 32 the
  // rows from 32 on; its other rows are in other threads, by symmetry. A is factored in units in which its diagonal is
  // 1: a pivot above 1 would multiply the roundoff of its column of the inverse.
  // B: [M, ld] the rows; unit: [ld] 1 / sqrt(A_jj) of free variables, else 0; inverse: [N, ld_inverse] with zeros in the
  // padding; work: [2, ld]. Returns whether every pivot is above `smallest` of the diagonal.
  static constexpr bool HOLDS_COLUMNS = sizeof(R) == 4 && N <= 64;
  OSIK_FN bool inverse_factor_of_gram(const R* B, const R* damping, const R* unit, R ridge, R smallest, R* inverse, R* work,
                                      int ld, int ld_inverse) const {
    constexpr int FIRST = N < 32 ? N : 32, REST = N - FIRST, SOME = 8, END = Warp::padded(N);
    R A[FIRST], low[REST + 1], other[REST + 1];  // the rows of the first column before 32 and from 32 on; of the second one
    const int own = me() < N ? me() : N - 1, second = me() < REST ? me() + 32 : N - 1;
    const R own_unit = unit[own], second_unit = unit[second];
    are_shared(B, damping, unit, inverse, work);
    auto fours = [&](const R* row, int first, int end,
                     auto f) {  // f(k, row[k]) for first <= k < end; first: a multiple of 4
#pragma unroll
      for (int g = first / 4; g < (end + 3) / 4; ++g) {
        const float4 v = reinterpret_cast<const float4*>(row)[g];
        const R part[4] = {v.x, v.y, v.z, v.w};
#pragma unroll
        for (int e = 0; e < 4; ++e)
          if (4 * g + e < end) f(4 * g + e, part[e]);
      }
    };
    __syncwarp();
#pragma unroll
    for (int k = 0; k < FIRST; ++k) A[k] = 0;
#pragma unroll
    for (int k = 0; k < REST; ++k) low[k] = other[k] = 0;
#pragma unroll 2
    for (int r = 0; r < M; ++r) {
      const R *row = B + r * ld, a = row[own] * own_unit, b = row[second] * second_unit;
      fours(row, 0, FIRST, [&](int k, R entry) { A[k] += a * entry; });
      fours(row, 32, N, [&](int k, R entry) { low[k - 32] += a * entry, other[k - 32] += b * entry; });
    }
    fours(unit, 0, FIRST, [&](int k, R factor) { A[k] *= factor; });
    fours(unit, 32, N, [&](int k, R factor) { low[k - 32] *= factor, other[k - 32] *= factor; });
    // what a pivot gets when its turn comes: nothing before depends on it
    const R added = own_unit > 0 ? damping[own] * own_unit * own_unit + ridge : R(1);
    const R second_added = second_unit > 0 ? damping[second] * second_unit * second_unit + ridge : R(1);
    const R scale = own_unit > 0 ? own_unit : R(1), second_scale = second_unit > 0 ? second_unit : R(1);
    // Before step j thread i >= j has column i of the Schur complement that is left of A, thread i < j column i of the
    // identity as far as the factor has been solved for. A[0] is row j: after each step the rows move up.
    bool regular = true;
    auto steps =
        [&](auto first) {  // from a row of the first columns on, SOME steps; the number of the rows left is a constant
      constexpr int FROM = decltype(first)::value, TO = FROM + SOME < FIRST ? FROM + SOME : FIRST;
      for (int j = FROM; j < TO; ++j) {
        const bool is_pivot = me() == j;
        A[0] += is_pivot ? added : R(0);
        const R pivot = __shfl_sync(ALL, A[0], j), by = rsqrt(pivot), c = A[0] * by;
        R* column = work + j % 2 * ld;
        regular = regular && (!is_pivot || pivot > smallest);
        if (me() > j && me() < FIRST) column[me() - j - 1] = c;
        if (is_pivot)
#pragma unroll
          for (int k = 0; k < REST; ++k) column[32 + k] = low[k] * by;
        if (me() < END) inverse[j * ld_inverse + me()] = is_pivot ? by * scale : me() < j ? c * scale : R(0);
        if (me() + 32 < END) inverse[j * ld_inverse + me() + 32] = 0;
        __syncwarp();
        // thread j: its column of the factor, and the first step of its column of the identity
        const R times = is_pivot ? c + by : c, second_times = REST ? column[second] : R(0);
        fours(column, 0, FIRST - FROM - 1, [&](int k, R entry) { A[k] = A[k + 1] - entry * times; });
        fours(column, 32, N, [&](int k, R entry) { low[k - 32] -= entry * times, other[k - 32] -= entry * second_times; });
      }
    };
    steps(Constant<0>());
    if constexpr (FIRST > SOME) steps(Constant<SOME>());
    if constexpr (FIRST > 2 * SOME) steps(Constant<2 * SOME>());
    if constexpr (FIRST > 3 * SOME) steps(Constant<3 * SOME>());
    for (int j = 32; j < N; ++j) {
      const bool is_pivot = me() + 32 == j;
      other[0] += is_pivot ? second_added : R(0);
      const R pivot = __shfl_sync(ALL, other[0], j - 32), by = rsqrt(pivot), b = low[0] * by, c = other[0] * by;
      R* column = work + j % 2 * ld;
      regular = regular && (!is_pivot || pivot > smallest);
      if (me() + 32 > j && me() < REST) column[me() + 31 - j] = c;
      inverse[j * ld_inverse + me()] = b * scale;
      if (me() + 32 < END)
        inverse[j * ld_inverse + me() + 32] = is_pivot ? by * second_scale : me() + 32 < j ? c * second_scale : R(0);
      __syncwarp();
      const R times = is_pivot ? c + by : c;
      fours(column, 0, REST - 1,
            [&](int k, R entry) { low[k] = low[k + 1] - entry * b, other[k] = other[k + 1] - entry * times; });
    }
    __syncwarp();
    return all(regular);
  }

  // ---- triangular systems of at most 64 equations; entry k of y stays in a register of thread k % 32
  OSIK_FN void forward(const Real* L, int ld, const Real* inverse, Real* y, int count) const {
    substitute(L, ld, 1, inverse, y, count, 1);
  }
  OSIK_FN void backward(const Real* L, int ld, const Real* inverse, Real* y, int count) const {
    substitute(L, 1, ld, inverse, y, count, -1);
  }
  OSIK_CALL void substitute(const Real* L, int row, int column, const Real* inverse, Real* y, int count, int way) const {
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

// The words of lanes.hpp: an entry of arrays, and the largest of what all threads have.
template <class Real> struct Entry {
  size_t first;
  OSIK_FN Real operator()(const Real* from) const { return from[first]; }
  OSIK_FN void put(Real a, Real* to) const { to[first] = a; }
  template <class Int> OSIK_FN bool are(const Int* labels, int label) const { return labels[first] == label; }
};
template <class Team> using EntryOf = Entry<typename Team::Real>;
template <class Team> struct GatheredBy {
  typename Team::Real own = 0;
  OSIK_FN void most(typename Team::Real a) { own = a > own ? a : own; }
  OSIK_FN typename Team::Real largest() const { return Team::all_most(own); }
};
template <class R, int N, int M, int H, class F> OSIK_FN void each_entry(const Warp<R, N, M, H>& t, int count, F f) {
  t.each(0, count, [&](int i) { f(Entry<R>{size_t(i)}); });
}
template <class R, int N, int M, int H>
OSIK_FN RowSums<R> row_sums(const Warp<R, N, M, H>& t, const R* row, const R* x, int n) {
  return {t.own_dot_on(row, x, 0, n), t.own_size_on(row, x, n)};
}

}  // namespace osik
