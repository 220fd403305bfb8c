// One warp on a CPU: 32 fibers that take turns where threads of a warp wait for each other.
//
// A fiber runs from one meeting to the next before another one moves, forwards or backwards through the lanes, so that a
// read that races with a write of another lane shows in one of the two orders.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ucontext.h>

using std::fabs; using std::fmax; using std::fmin; using std::sqrt;

struct float4 { float x, y, z, w; };
template <class T> struct Matrix { T* data; };

static ucontext_t outside, fibers[32];
static char stacks[32][1 << 20];
static bool ended[32];
static int lane_now;
static struct { struct { operator unsigned() const { return lane_now; } } x; } threadIdx;

#define __shared__ alignas(16) static __attribute__((section("shared")))
static void __syncwarp() { swapcontext(&fibers[lane_now], &outside); }

template <class T> T exchanged(T mine, int from) {
  static T all[32];
  all[lane_now] = mine;
  __syncwarp();
  T theirs = all[from];
  __syncwarp();
  return theirs;
}
template <class T> T __shfl_xor_sync(unsigned, T a, int far) { return exchanged(a, lane_now ^ far); }
template <class T> T __shfl_sync(unsigned, T a, int from) { return exchanged(a, from); }
static unsigned __ballot_sync(unsigned, bool yes) {
  static bool all[32];
  all[lane_now] = yes;
  __syncwarp();
  unsigned bits = 0;
  for (int i = 0; i < 32; ++i) bits |= unsigned(all[i]) << i;
  __syncwarp();
  return bits;
}
static int __any_sync(unsigned mask, bool yes) { return __ballot_sync(mask, yes) != 0; }
static int __ffs(unsigned a) { return __builtin_ffs(a); }
static int __popc(unsigned a) { return __builtin_popcount(a); }
static float rsqrtf(float a) { return 1.f / std::sqrt(a); }
static double rsqrt(double a) { return 1. / std::sqrt(a); }

// what is __shared__ begins as numbers that are none; some text may have none
__attribute__((section("shared"), used)) static char at_least[16];
extern char __start_shared[], __stop_shared[];
#define __isShared(pointer) ((char*)(pointer) >= __start_shared && (char*)(pointer) < __stop_shared)
#define __builtin_assume(fact) if (!(fact)) fprintf(stderr, "not so: %s\n", #fact), abort()
#define __device__
#define __noinline__ __attribute__((noinline))
static void run_warp(void (*thread)(), bool backwards) {
  memset(__start_shared, 0xff, __stop_shared - __start_shared);
  for (int i = 0; i < 32; ++i) {
    getcontext(&fibers[i]);
    fibers[i].uc_stack.ss_sp = stacks[i];
    fibers[i].uc_stack.ss_size = sizeof stacks[i];
    fibers[i].uc_link = &outside;
    makecontext(&fibers[i], thread, 0);
    ended[i] = false;
  }
  for (int left = 32; left;) {
    left = 0;
    for (int k = 0; k < 32; ++k) {
      lane_now = backwards ? 31 - k : k;
      if (!ended[lane_now]) swapcontext(&outside, &fibers[lane_now]);
      left += !ended[lane_now];
    }
    if (left && left < 32) fprintf(stderr, "some lanes wait for others that have ended\n"), abort();
  }
}
static void end_thread() {
  ended[lane_now] = true;
  swapcontext(&fibers[lane_now], &outside);
}

// Warp has these two macros before a kernel's text: a declarator such as "float (&a)[2]" becomes a call
template <class T> static float cast_float(T a) { return static_cast<float>(a); }
template <class T> static int cast_int(T a) { return static_cast<int>(a); }
#define float(x) cast_float(x)
#define int(x) cast_int(x)
