// Handlers of the null space on a CPU. Every argument and result has a leading axis of problems, except for the limit on
// changes of the active set.
#include <cstddef>
#include <vector>

#include "null_space.hpp"
#include "row_factors.hpp"
#include "saturation.hpp"
#include "xla.hpp"

using namespace osik;

namespace {
using Team = Serial<double>;

// Arguments: secondary [n], constant, unmet, demand [L], bends [L, n], rank tolerance, and of each level its matrix
// [rows, n], lower, upper and equality [rows]. Results: x [n], projector [n, n].
void project(const xla::Call& call) {
  const int batch = call.size(0, 0), n = call.size(0, 1), L = call.size(1, 1), first_level = 6;
  int m = 0;
  for (int k = 0; k < L; ++k) m = m < call.size(first_level + 4 * k, 1) ? call.size(first_level + 4 * k, 1) : m;
  using Method = ClassicalProjection<Team>;
  const NullSpaceSizes sizes{n, m};
  std::vector<double> space(Method::bytes(sizes) / sizeof(double));
  Method method(sizes, reinterpret_cast<char*>(space.data()));
  for (size_t b = 0; b < size_t(batch); ++b) {
    method.rank_tol = call.in<double>(5)[b];
    method.begin();
    for (int k = 0; k < L; ++k) {
      const int at = first_level + 4 * k, rows = call.size(at, 1);
      const size_t e = b * L + k, row = b * rows;
      method.solve_level({call.in<double>(at) + row * n, call.in<double>(at + 1) + row, call.in<double>(at + 2) + row,
                          call.in<double>(4) + e * n, call.in<int>(at + 3) + row, call.in<double>(1)[e],
                          call.in<double>(2)[e], call.in<double>(3)[e], rows, n, 1});
    }
    method.end(call.in<double>(0) + b * n, call.out<double>(0) + b * n, call.out<double>(1) + b * n * n);
  }
}

// Arguments: matrix [m, n], cutoff, damping. Results: basis [m, n], orthonormal [2 m, m], triangle [m, m].
void factor_rows(const xla::Call& call) {
  const int batch = call.size(0, 0), m = call.size(0, 1), n = call.size(0, 2);
  using Method = RowFactors<Team>;
  std::vector<double> space(Method::doubles(m, n));
  Method method(m, n, space.data());
  for (size_t b = 0; b < size_t(batch); ++b)
    method.solve(call.in<double>(0) + b * m * n, call.in<double>(1)[b], call.in<double>(2)[b],
                 call.out<double>(0) + b * m * n, call.out<double>(1) + b * 2 * m * m, call.out<double>(2) + b * m * m);
}

// Arguments: matrix [L, m, n], lower, upper, equality [L, m], constant, unmet, demand [L], bends, targets [L, n], low,
// high [n], rank tolerance, limit on changes. Results in the order of SaturationAnswer.
void saturate(const xla::Call& call) {
  const int batch = call.size(0, 0), L = call.size(0, 1), m = call.size(0, 2), n = call.size(0, 3);
  auto numbers = [&](int k) { return call.in<double>(k); };
  using Method = Saturation<Team>;
  const NullSpaceSizes sizes{n, m};
  std::vector<double> space(Method::bytes(sizes) / sizeof(double));
  Method method(sizes, reinterpret_cast<char*>(space.data()));
  for (size_t b = 0; b < size_t(batch); ++b) {
    const size_t l = b * L;
    SaturationProblem p{};
    p.matrix = numbers(0) + l * m * n, p.lower = numbers(1) + l * m, p.upper = numbers(2) + l * m;
    p.equality = call.in<int>(3) + l * m, p.constant = numbers(4) + l, p.unmet = numbers(5) + l, p.demand = numbers(6) + l;
    p.bends = numbers(7) + l * n, p.targets = numbers(8) + l * n, p.low = numbers(9) + b * n, p.high = numbers(10) + b * n;
    p.rank_tol = numbers(11)[b], p.max_changes = call.in<int>(12)[0], p.L = L, p.m = m, p.row = n, p.column = 1;
    const SaturationAnswer a{call.out<double>(0) + b * n, call.out<double>(1) + b * n * n, call.out<double>(2) + l,
                             call.out<int>(3) + l,        call.out<int>(4) + l * n,        call.out<int>(5) + l * n,
                             call.out<int>(6) + l,        call.out<int>(7) + b * n,        call.out<int>(8) + b * 2};
    method.solve(p, a);
  }
}
}  // namespace

extern "C" {
// Bytes of shared memory that a warp needs for one problem, a multiple of 16, and numbers beside it; m: rows of the longest
// level.
int osik_projection_bytes(int n, int m) { return NullSpace<WarpSizes<>>::bytes({n, m}); }
int osik_saturation_bytes(int n, int m) { return Saturation<WarpSizes<>>::bytes({n, m}); }
int osik_null_space_outside(int n, int m) { return NullSpace<WarpSizes<>>::numbers_outside({n, m}); }

void* osik_projection(xla::CallFrame* frame) { return xla::handle<project>(frame); }
void* osik_row_factors(xla::CallFrame* frame) { return xla::handle<factor_rows>(frame); }
void* osik_saturation(xla::CallFrame* frame) { return xla::handle<saturate>(frame); }
}
