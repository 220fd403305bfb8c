// What the CUDA text of the core takes from CUDA, on a CPU: 32 threads that take turns at each collective function.
#include <ucontext.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <initializer_list>
#define __CUDACC__ 1
#define __device__
#define __host__
#define __global__
#define __forceinline__ inline
#define __noinline__
#define __shared__
#define __align__(bytes)
#define __launch_bounds__(threads, blocks)
#define __isShared(p) is_in_shared_memory(p)
#define __isGlobal(p) (!is_in_shared_memory(p))
#define __builtin_assume(fact) ((fact) ? void() : stop_at(#fact))

using std::fabs, std::hypot, std::sqrt;

struct Index {
  int x;
};
struct float4 {
  float x, y, z, w;
};
static Index threadIdx, blockIdx, blockDim{1};
static ucontext_t threads[32], host;
static char stacks[32][1 << 18];
static uint64_t slots[2][32];
static int turn[32], kinds[2][32];

// What the text says of an address is checked. An empty array may begin where shared memory ends.
static const char *shared_from, *shared_to;
inline bool is_in_shared_memory(const void* p) { return shared_from <= p && p <= shared_to; }
inline void stop_at(const char* fact) { fprintf(stderr, "not so: %s\n", fact), abort(); }

inline void run_thread(int which) {
  threadIdx.x = which;
  setcontext(&threads[which]);
}
// f of what all threads pass; a thread that meets another function than the others is an error of the text
template <class T, class F> auto of_all(int kind, T own, F f) {
  const int me = threadIdx.x, at = turn[me] ^= 1;
  memcpy(&slots[at][me], &own, sizeof own), kinds[at][me] = kind;
  swapcontext(&threads[me], &threads[threadIdx.x = (me + 1) % 32]);
  threadIdx.x = me;
  for (int k = 0; k < 32; ++k)
    if (kinds[at][k] != kind) fprintf(stderr, "threads diverge: %d, %d\n", kind, kinds[at][k]), abort();
  return f([at](int k) {
    T there;
    memcpy(&there, &slots[at][k & 31], sizeof there);
    return there;
  });
}
template <class T, class F> T reduced(int kind, T own, T start, F f) {
  return of_all(kind, own, [&](auto of) {
    T total = start;
    for (int k = 0; k < 32; ++k) total = f(total, of(k));
    return total;
  });
}
inline void __syncwarp() {
  reduced(1, 0, 0, [](int, int) { return 0; });
}
template <class T> T __shfl_sync(unsigned, T own, int from) {
  return of_all(2, own, [&](auto of) { return of(from); });
}
template <class T> T __shfl_xor_sync(unsigned, T own, int distance) {
  return of_all(3, own, [&, me = threadIdx.x](auto of) { return of(me ^ distance); });
}
inline bool __all_sync(unsigned, bool own) {
  return reduced(4, int(own), 1, [](int a, int b) { return a && b; });
}
inline int __reduce_add_sync(unsigned, int own) {
  return reduced(5, own, 0, [](int a, int b) { return a + b; });
}
inline unsigned __reduce_max_sync(unsigned, unsigned own) {
  return reduced(6, own, 0u, [](unsigned a, unsigned b) { return a > b ? a : b; });
}
inline unsigned __ballot_sync(unsigned, bool own) {
  return of_all(7, own, [](auto of) {
    unsigned bits = 0;
    for (int k = 0; k < 32; ++k) bits |= unsigned(of(k)) << k;
    return bits;
  });
}
inline bool __any_sync(unsigned, bool own) {
  return reduced(8, int(own), 0, [](int a, int b) { return a || b; });
}
inline int __reduce_min_sync(unsigned members, int own) {
  return of_all(9, own, [&](auto of) {
    int least = own;
    for (int k = 0; k < 32; ++k) least = members >> k & 1 && of(k) < least ? of(k) : least;
    return least;
  });
}
template <class T> T __shfl_sync(unsigned, T own, int from, int width) {
  return of_all(10, own, [&, me = threadIdx.x](auto of) { return of(me / width * width + from); });
}
inline void __syncthreads() {
  if (blockDim.x > 1) __syncwarp();
}
inline int __popc(unsigned a) { return __builtin_popcount(a); }
template <class T> T __ldg(const T* at) { return *at; }
inline int __ffs(unsigned a) { return __builtin_ffs(int(a)); }
inline int __clz(unsigned a) { return a ? __builtin_clz(a) : 32; }
inline unsigned __float_as_uint(float a) { return __builtin_bit_cast(unsigned, a); }
inline float __uint_as_float(unsigned a) { return __builtin_bit_cast(float, a); }
inline float rsqrt(float a) { return 1 / std::sqrt(a); }
inline double rsqrt(double a) { return 1 / std::sqrt(a); }

// Run `kernel` for each block. Shared memory holds NaN at first; what is written beyond `bytes` of it is an error.
template <class F> void run_blocks(int blocks, char* shared, size_t bytes, size_t size, F kernel) {
  static F* now;
  now = &kernel, shared_from = shared, shared_to = shared + size;
  auto entry = +[](int me) {
    threadIdx.x = me;
    (*now)();
    me == 31 ? void(setcontext(&host)) : run_thread(me + 1);
  };
  for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x) {
    memset(shared, 0xff, size);
    for (int k = 0; k < 32; ++k) {
      turn[k] = 0;
      getcontext(&threads[k]);
      threads[k].uc_stack.ss_sp = stacks[k], threads[k].uc_stack.ss_size = sizeof stacks[k];
      makecontext(&threads[k], reinterpret_cast<void (*)()>(entry), 1, k);
    }
    volatile bool begun = false;
    getcontext(&host);
    if (!begun) begun = true, run_thread(0);
    for (size_t i = bytes; i < size; ++i)
      if (shared[i] != char(0xff)) fprintf(stderr, "byte %zu written, of %zu\n", i, bytes), abort();
  }
}
