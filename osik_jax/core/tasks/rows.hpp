// What the rows of all kinds of tasks share.
#pragma once
#include "../rigid.hpp"

namespace osik {

// The rows of one task with m rows; fields of TaskRows (tasks/_task.py). An equality has no upper bounds (null).
template <class Out> struct Rows {
  Out error, jacobian, lower, curvature, pull, levers;  // [m], [m, nv], [m], [1], [m], [nv]
  Out upper{}, squares{};  // [m] and, unless null, the squared length of each row [m]
};

// An interval of the error, [m] each; null for an equality.
template <class In> struct Bounds {
  In lower{}, upper{};
};

// The bounds on the rate of row i, and its pull: tasks/_task.py, TaskRows.of.
template <class Real, class In, class Out>
OSIK_FN void ask(const Rows<Out>& to, const Bounds<In>& bounds, int i, Real error, Real forward, Real gain) {
  to.error[i] = error;
  if (!bounds.lower) {
    to.pull[i] = gain * error, to.lower[i] = forward - to.pull[i];
    return;
  }
  const Real low = bounds.lower[i], high = bounds.upper[i];
  auto approach = [&](Real bound) { return select(fabs(bound) < Real(INFINITE), gain * (bound - error) + forward, bound); };
  to.pull[i] = gain * select(error > high, error - high, select(error < low, error - low, Real(0)));
  to.lower[i] = approach(low), to.upper[i] = approach(high);
}

// The length of the weighted pulls of m rows, without overflow of squares.
template <class Own, class Out> OSIK_FN auto pull_length(const Own& weight, const Out& pull, int m) {
  using Real = NumberAt<Out>;
  Real largest = 0, square = 0;
  for (int i = 0; i < m; ++i) {
    const Real size = fabs(weight[i] * pull[i]);
    largest = select((size > largest) | (size != size), size, largest);
  }
  const Real unit = select(largest > Real(0), Real(1) / largest, Real(0));
  for (int i = 0; i < m; ++i) {
    const Real part = weight[i] * pull[i] * unit;
    square += part * part;
  }
  return largest * sqrt(square);
}

// Leaves of a task: those that all kinds have, then its own. A task may have no target velocity (0), and no lower bounds.
enum TaskLeaf { GAIN, WEIGHT, TARGET_VELOCITY, LOWER, UPPER, OWN };

// What most cards of kinds of tasks say (kinds.hpp).
struct CommonCard {
  static constexpr bool MOVES = false, HAS_DOFS = false, IS_COMPUTED = false;
  static int velocities(int m) { return m; }
  template <class Task> static int dofs(const Task& task) { return task.count; }
  template <class Task> static bool closes_loop(const Task&) { return false; }
  template <class Step, class Task> static bool is_spoiled(const Step& step, const Task& task, int arrays) {
    for (int i = 0; i < 9; ++i)
      if (task.leaves[i] >= 0 && step.spoiled(task.leaves[i], task.leaves[i] + 1, arrays)) return true;
    return false;
  }
  template <class Step, class Task> static bool takes(const Step&, const Task&) { return true; }
};
}  // namespace osik
