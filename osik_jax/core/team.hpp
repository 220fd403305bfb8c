// Who computes one problem: a CPU thread (Serial) or the 32 threads of a CUDA warp (Warp).
//
// A method is a template over its team and is written once, as steps of the whole team:
//   each(a, b, f)        f(i) for all a <= i < b; afterwards all threads see what f wrote
//   once(f)              f() by one thread
//   pairs(n, f)          f(a, b) for all a <= b < n
//   columns(a, b, f)     f(c) for packs of columns: c.load(row), c.store(row, pack)
//   narrow_columns(a, b, f)  the same with smaller packs, for an f that works on several at once
//   sum, count, all      of f(i), or of each thread's flag; every thread gets the result, as of the next two
//   most, best           the largest f(i); the largest f(i) with its index i
//   dot, axpy, forward, backward, reflect   vector operations of the whole team
//   fetch, fetch_rows    copies of numbers, which may take until arrive(), and then
//   scaled_rows          of rows times factors, with zeros in the padding
//   rows_times, weighted_gram, largest   products of all rows with a vector, and with each other; the largest product
// The functions own_... are those of one thread, for use inside f.
//
// Rows are padded: a row of n numbers has Team::stride(n) places, and the places after the n-th hold zeros. own_dot_on,
// own_size_on, own_axpy_on, rows_times and largest may read these zeros, up to Team::padded(n). Real is the type of the
// numbers: double, or float on a GPU.
#pragma once

#ifdef __CUDACC__
#define OSIK_FN __device__ __forceinline__
#define OSIK_HOST __host__ __device__
#define OSIK_UNROLL _Pragma("unroll")
#define OSIK_UNROLL_4 _Pragma("unroll 4")
// Calls keep the text short: it has to fit into the instruction cache.
#define OSIK_CALL __device__ __noinline__
// A method of the hierarchy or the null space, which few places use: a call on a CPU, in line on a GPU, so that members
// stay in registers and not in the memory of each thread.
#define OSIK_METHOD OSIK_FN
#else
#define OSIK_FN inline __attribute__((always_inline))
#define OSIK_CALL inline __attribute__((noinline))
#define OSIK_METHOD OSIK_CALL
#define OSIK_HOST
#define OSIK_UNROLL _Pragma("GCC unroll 8")
#define OSIK_UNROLL_4
#endif

namespace osik {

// The type of the numbers that a pointer, or what stands for one, leads to.
template <class At> struct NumberOf {
  using Type = typename At::Number;
};
template <class T> struct NumberOf<T*> {
  using Type = T;
};
template <class T> struct NumberOf<const T*> {
  using Type = T;
};
template <class At> using NumberAt = typename NumberOf<At>::Type;

// Numbers of a thread from B columns, or from B vectors of them (Of::Value).
template <class Of, int B> struct Pack {
  using Real = typename Of::Real;
  typename Of::Value v[B];
  template <class F> OSIK_FN static void each(F f) {
    OSIK_UNROLL
    for (int b = 0; b < B; ++b) f(b);
  }
  OSIK_FN Pack() {}
  OSIK_FN Pack(Real a) {
    each([&](int b) { v[b] = Of::all(a); });
  }
  OSIK_FN Pack& operator+=(const Pack& o) {
    return each([&](int b) { v[b] += o.v[b]; }), *this;
  }
  OSIK_FN Pack& operator-=(const Pack& o) {
    return each([&](int b) { v[b] -= o.v[b]; }), *this;
  }
  OSIK_FN Pack& operator*=(const Pack& o) {
    return each([&](int b) { v[b] *= o.v[b]; }), *this;
  }
  OSIK_FN Pack& fma(Real a, const Pack& o) {
    return each([&](int b) { v[b] += a * o.v[b]; }), *this;
  }
  OSIK_FN Pack& square(const Pack& o) {
    return each([&](int b) { v[b] += o.v[b] * o.v[b]; }), *this;
  }
  OSIK_FN Pack inverse() const {
    Pack p;
    return each([&](int b) { p.v[b] = Real(1) / v[b]; }), p;
  }
  OSIK_FN Pack size() const {
    Pack p;
    return each([&](int b) { p.v[b] = Of::size(v[b]); }), p;
  }
};

template <class Real> struct Best {
  Real value;
  int which;  // -1 where no value is larger than the start
};

// The product of a row with a vector, and the sum of the sizes of its terms.
template <class Real> struct RowSums {
  Real value, size;
};

// How a warp lays out its workspace. The host uses it to compute the size of one.
template <class T, class At, class Sizes> struct NoArray {};
template <class At, class Sizes> struct NoSize {};

// What teams share.
template <class R> struct CommonTeam {
  using Real = R;
  static constexpr Real SMALLEST_PIVOT = sizeof(R) == 8 ? 1e-300 : 1e-37;
  static constexpr Real SMALLEST_ROOT = sizeof(R) == 8 ? 1e-150 : 1e-18;
  // the numbers of variables, rows and hard rows that space is laid out for
  static constexpr OSIK_HOST int variables(int n) { return n; }
  static constexpr OSIK_HOST int level_rows(int m) { return m; }
  static constexpr OSIK_HOST int hard_rows(int h) { return h; }
};

template <class R = double> struct WarpSizes : CommonTeam<R> {
  using Int = short;
  template <class T, class At, class Sizes> using Array = NoArray<T, At, Sizes>;
  template <class At, class Sizes> using Fixed = NoSize<At, Sizes>;
  static constexpr bool COPIES = false;        // rows are read from global memory
  static constexpr bool SPARES_SPACE = true;   // inverse_factor is in place; what does not fit well is in global memory
  static constexpr int WIDE = sizeof(R) == 4 ? 4 : 1;  // numbers that a thread reads at once
  static constexpr OSIK_HOST int padded(int n) { return (n + WIDE - 1) / WIDE * WIDE; }
  // an odd number of wide ones, so that threads read different banks of memory
  static constexpr OSIK_HOST int stride(int n) { return WIDE * ((n + WIDE - 1) / WIDE | 1); }
};

constexpr double LARGEST_DOUBLE = 1.7976931348623157e308, INFINITE = __builtin_bit_cast(double, 0x7ff0000000000000ull);

// Decisions by a number, in words that packs of robots have too (lanes.hpp).
template <class Real> OSIK_FN Real select(bool which, Real a, Real b) { return which ? a : b; }
OSIK_FN bool any(bool which) { return which; }

OSIK_FN bool is_finite(double a) { return a >= -LARGEST_DOUBLE && a <= LARGEST_DOUBLE; }  // false for NaN

}  // namespace osik

#ifdef __CUDACC__
#include "warp.hpp"
#else
#include "serial.hpp"
#endif
