// XLA's call of a control step on a CPU. Arguments: the layout of control/_compiled_step.py, labels of the warm start (two
// arrays, empty for none), the arrays with all numbers, the constants. Results: those of StepResult.
#include <memory>

#include "step.hpp"
#include "xla.hpp"

using namespace osik;

namespace {
bool has_no_nan(const double* at, size_t count) {
  bool valid = true;
  for (size_t i = 0; i < count; ++i) valid &= at[i] == at[i];
  return valid;
}

void take_steps(const xla::Call& call) {
  constexpr int GUESS = 1, FIRST = 3;
  thread_local std::unique_ptr<Step> step;  // of the last call: its workspace is ready
  const int *layout = call.in<int>(0), count = call.size(0, 0);
  if (!step || !step->has(layout, count)) step = std::make_unique<Step>(layout, count);
  const int lanes = int(call.result(0).dimensions[0]), numbers = int(call.result(0).dimensions[1]);
  const int integers = int(call.result(1).dimensions[1]), given = int(call.frame->arguments.size) - FIRST - 1;
  std::vector<const double*> arrays(given);
  std::vector<size_t> sizes(given), strides(given);
  bool shared_clean = true;
  for (int k = 0; k < given; ++k) {
    arrays[k] = call.in<double>(FIRST + k), sizes[k] = xla::numbers_of_lane(call.argument(FIRST + k));
    strides[k] = call.size(FIRST + k, 0) > 1 ? sizes[k] : 0;
    if (!strides[k]) shared_clean = shared_clean && has_no_nan(arrays[k], sizes[k]);
  }
  auto guess = [&](int k, int lane) -> const int* {
    const xla::Buffer& buffer = call.argument(k);
    const size_t labels = xla::numbers_of_lane(buffer);
    return labels ? call.in<int>(k) + (buffer.dimensions[0] > 1 ? labels * lane : 0) : nullptr;
  };
  for (int lane = 0; lane < lanes; ++lane) {
    bool clean = shared_clean;
    for (int k = 0; k < given; ++k)
      if (strides[k]) clean = clean && has_no_nan(arrays[k], sizes[k]);
    step->take({call.in<double>(FIRST + given), arrays.data(), given, guess(GUESS, lane), guess(GUESS + 1, lane)},
               {call.out<double>(0) + size_t(numbers) * lane, call.out<int>(1) + size_t(integers) * lane}, clean);
    for (int k = 0; k < given; ++k) arrays[k] += strides[k];
  }
}
}  // namespace

extern "C" void* osik_step(xla::CallFrame* frame) { return xla::handle<take_steps>(frame); }
