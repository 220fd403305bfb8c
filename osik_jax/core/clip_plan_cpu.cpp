// Handler of the plans of clips on a CPU.
#include <cstddef>
#include <vector>

#include "clip_plan.hpp"
#include "xla.hpp"

using namespace osik;

namespace {
// Arguments, flat, with an axis of clips, or of length 1 where all clips share them: q [F, nq], the goals in the order of
// ClipGoals, free [F], the numbers of ClipRobot, ClipMethod; and the integers of ClipRobot, which all clips share.
// Results: q [F, nq], cost [2], iterations.
void plan(const xla::Call& call) {
  const int clips = call.result_size(0, 0), frames = call.result_size(0, 1), nq = call.result_size(0, 2);
  auto numbers = [&](int k, int clip) {
    return call.in<double>(k) + (call.size(k, 0) == 1 ? 0 : size_t(clip) * call.size(k, 1));
  };
  ClipRobot robot;
  robot.read(call.in<int>(12));
  const size_t size = size_t(frames) * nq;
  std::vector<double> space(ClipPlan::doubles(robot, frames)), other(size);
  for (int b = 0; b < clips; ++b) {
    robot.read(numbers(10, b));
    ClipMethod method;
    __builtin_memcpy(&method, numbers(11, b), sizeof method);
    const ClipGoals goals{numbers(1, b), numbers(2, b), numbers(3, b), numbers(4, b),
                          numbers(5, b), numbers(6, b), numbers(7, b), numbers(8, b)};
    double* q = call.out<double>(0) + b * size;
    for (size_t e = 0; e < size; ++e) q[e] = numbers(0, b)[e];
    ClipPlan clip(robot, goals, method, frames, nq, space.data());
    call.out<double>(2)[b] = clip.descend(numbers(9, b), q, other.data(), call.out<double>(1) + 2 * b);
  }
}
}  // namespace

extern "C" {
void* osik_clip_plan(xla::CallFrame* frame) { return xla::handle<plan>(frame); }
}
