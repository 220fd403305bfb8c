// Handlers of XLA's calls on a CPU: each hands the buffers of a batch to its method, one problem after another.
//
// Numbers are double, integers int32. Every argument and result has a leading axis of problems, except for the sizes.
#include <cstddef>
#include <vector>

#include "hierarchy.hpp"
#include "xla.hpp"

using namespace osik;

namespace {
using Team = Serial<double>;

// Arguments and results in the order of the fields of Problem and Answer (solvers/hqp/_core.py).
void solve_hierarchies(const xla::Call& call) {
  const int batch = call.size(0, 0), L = call.size(0, 1), m = call.size(0, 2), n = call.size(0, 3), h = call.size(4, 1);
  const Sizes s{L, m, n, h, call.in<int>(16)[0], call.in<int>(13), call.in<int>(14), call.in<int>(15)};
  auto numbers = [&](int k) { return call.in<double>(k); };
  auto integers = [&](int k) { return call.in<int>(k); };
  Problem p{numbers(0), numbers(1),  numbers(2),   numbers(3),   numbers(4),   numbers(5), numbers(6), numbers(7),
            numbers(8), integers(9), integers(10), integers(11), integers(12), n,          1,          false};
  Answer a{call.out<double>(0), call.out<double>(1), call.out<double>(2), call.out<double>(3),
           call.out<double>(4), call.out<int>(5),    call.out<int>(6),    call.out<int>(7),
           call.out<int>(8),    call.out<int>(9),    call.out<int>(10),   call.out<int>(11)};
  using Method = Hierarchy<Team>;
  std::vector<char> space(Method::bytes(s));
  Method method(s, space.data());
  for (int k = 0; k < batch; ++k) {
    method.solve(p, a);
    advance(p, s);
    advance(a, s);
  }
}

}  // namespace

extern "C" {
void* osik_hierarchy(xla::CallFrame* frame) { return xla::handle<solve_hierarchies>(frame); }

// Bytes of shared memory that a warp needs for one problem, a multiple of 16.
int osik_hierarchy_bytes(int L, int m, int n, int h) {
  const Sizes s{L, m, n, h, 0, nullptr, nullptr, nullptr};
  using Method = Hierarchy<WarpSizes<>>;
  return Method::bytes(s);
}

// The sources that this library was built from (_build.py), so that another state of them is noticed.
const char* osik_sources() { return OSIK_SOURCES; }

// Whether this processor has the instructions of x86-64-v3, for which the second library is built.
int osik_has_x86_64_v3() {
#if defined(__x86_64__)
  __builtin_cpu_init();
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
         __builtin_cpu_supports("bmi2");
#else
  return 0;
#endif
}
}
