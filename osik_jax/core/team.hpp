// Who computes one problem: a CPU thread (Serial) or the 32 threads of a CUDA warp (Warp).
//
// A method is a template over its team and is written once, as steps of the whole team:
//   each(a, b, f)        f(i) for all a <= i < b; afterwards all threads see what f wrote
//   once(f)              f() by one thread
//   pairs(n, f)          f(a, b) for all a <= b < n
//   columns(a, b, f)     f(c) for packs of columns: c.load(row), c.store(row, pack)
//   narrow_columns(a, b, f)  the same with smaller packs, for an f that works on several at once
//   sum, count           of f(i); every thread gets the result, as of the next two
//   most, best           the largest f(i); the largest f(i) with its index i
//   dot, axpy, forward, backward, reflect   vector operations of the whole team
//   scaled_copy, scaled_rows   copies of a row, or of rows, times factors, with zeros in the padding
//   rows_times, weighted_gram, largest   products of all rows with a vector, and with each other; the largest product
// The functions own_... are those of one thread, for use inside f.
//
// Rows are padded: a row of n numbers has Team::stride(n) places, and the places after the n-th hold zeros.
// own_dot_on, own_axpy_on, rows_times and largest may read these zeros, up to Team::padded(n). Real is the type of the numbers: double, or float on a GPU.
#pragma once

#ifdef __CUDACC__
#define OSIK_FN __device__ __forceinline__
#define OSIK_HOST __host__ __device__
#define OSIK_UNROLL _Pragma("unroll")
// Calls keep the text short: it has to fit into the instruction cache.
#define OSIK_CALL __device__ __noinline__
#define OSIK_METHOD __device__ __noinline__
#else
#define OSIK_FN inline __attribute__((always_inline))
#define OSIK_CALL inline __attribute__((noinline))
#define OSIK_METHOD OSIK_CALL
#define OSIK_HOST
#define OSIK_UNROLL _Pragma("GCC unroll 8")
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

template <class Real> struct Best {
  Real value;
  int which;  // -1 where no value is larger than the start
};

// How a warp lays out its workspace. The host uses it to compute the size of one.
template <class T, class At, class Sizes> struct NoArray {};

template <class R = double> struct WarpSizes {
  using Int = short;
  using Real = R;
  template <class T, class At, class Sizes> using Array = NoArray<T, At, Sizes>;
  static constexpr bool COPIES = false;        // rows are read from global memory
  static constexpr bool SPARES_SPACE = true;   // inverse_factor is in place; what is seldom used is in global memory
  static constexpr OSIK_HOST int stride(int n) { return n | 1; }  // odd: threads read different banks of memory
  static constexpr OSIK_HOST int padded(int n) { return n; }
  static constexpr OSIK_HOST int variables(int n) { return n; }
  static constexpr OSIK_HOST int level_rows(int m) { return m; }
  static constexpr OSIK_HOST int hard_rows(int h) { return h; }
};

constexpr double LARGEST_DOUBLE = 1.7976931348623157e308, INFINITE = __builtin_bit_cast(double, 0x7ff0000000000000ull);

OSIK_FN bool is_finite(double a) { return a >= -LARGEST_DOUBLE && a <= LARGEST_DOUBLE; }  // false for NaN

}  // namespace osik

#ifdef __CUDACC__
#include "warp.hpp"
#else
#include "serial.hpp"
#endif
