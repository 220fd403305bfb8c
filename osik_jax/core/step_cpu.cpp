// XLA's call of a control step on a CPU. Arguments: the layout of control/_compiled_step.py, labels of the warm start (two
// arrays, empty for none), the arrays with all numbers, the constants. Results: those of StepResult.
#include <memory>

#include "step.hpp"
#include "xla.hpp"

using namespace osik;

namespace {
void take_steps(const xla::Call& call) {
  constexpr int GUESS = 1, FIRST = 3;
  thread_local std::unique_ptr<Step> step;  // of the last call: its workspace is ready
  const int *layout = call.in<int>(0), count = call.size(0, 0);
  if (!step || !step->has(layout, count)) step = std::make_unique<Step>(layout, count);
  const int lanes = call.result_size(0, 0), numbers = call.result_size(0, 1);
  const int integers = call.result_size(1, 1), given = int(call.frame->arguments.size) - FIRST - 1;
  std::vector<const double*> arrays(given);
  std::vector<size_t> sizes(given), strides(given);
  bool shared_clean = true;
  for (int k = 0; k < given; ++k) {
    arrays[k] = call.in<double>(FIRST + k), sizes[k] = xla::Call::numbers_of_lane(call.argument(FIRST + k));
    strides[k] = call.size(FIRST + k, 0) > 1 ? sizes[k] : 0;
    if (!strides[k]) shared_clean = shared_clean && !has_nan(arrays[k], sizes[k]);
  }
  auto guess = [&](int k, int lane) -> const int* {
    const size_t labels = xla::Call::numbers_of_lane(call.argument(k));
    return labels ? call.in<int>(k) + (call.size(k, 0) > 1 ? labels * lane : 0) : nullptr;
  };
  auto begin_at = [&](int lane) {
    for (int k = 0; k < given; ++k) arrays[k] = call.in<double>(FIRST + k) + strides[k] * lane;
    return StepData{call.in<double>(FIRST + given), arrays.data(), strides.data(), given, guess(GUESS, lane),
                    guess(GUESS + 1, lane)};
  };
  // The last pack of a batch has robots of the one before it. A robot alone, and batches of fewer robots, need no pack.
  constexpr int PACK = Lanes<double>::COUNT;
  int pack = -1;
  for (int lane = 0; lane < lanes; ++lane) {
    if (lanes >= PACK && (pack < 0 || lane == pack + PACK)) {
      pack = lane + PACK <= lanes ? lane : lanes - PACK;
      step->find_pack(begin_at(pack));
    }
    const StepData data = begin_at(lane);
    bool clean = shared_clean;
    for (int k = 0; k < given; ++k)
      if (strides[k]) clean = clean && !has_nan(arrays[k], sizes[k]);
    step->take(data, {call.out<double>(0) + size_t(numbers) * lane, call.out<int>(1) + size_t(integers) * lane}, clean,
               pack < 0 ? -1 : lane - pack);
  }
}
}  // namespace

extern "C" void* osik_step(xla::CallFrame* frame) { return xla::handle<take_steps>(frame); }
