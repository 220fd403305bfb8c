// What control/_compiled_step.py lays out of a step.
#pragma once
#include <algorithm>
#include <stdexcept>
#include <vector>

namespace osik {

enum StepScheme { WEIGHTED = 0, HIERARCHICAL = 1, CLASSICAL = 2, SATURATED = 3 };  // the last two: NullSpace
enum StepLimit { SPEED = 0, RANGE = 1, HARD_ROWS = 2 };  // in the order in which they narrow the box; the last one does not

// Sizes of a step; m, p, L and h are those of QPSizes and Sizes.
struct StepSizes {
  int scheme, leaves, nq, given, bodies, joints, dofs, nv, tasks, limits, rows, m, p, L, h, max_iterations;

  int labels() const {  // for the next warm start
    return scheme == WEIGHTED ? nv + p : scheme == HIERARCHICAL ? L * (h + m) : 0;
  }
};

// The layout of a step.
struct StepLayout {
  struct Task {
    int kind, m, first, out, level, bounded, diagonal;  // out: of its slack and error; diagonal: equality of single dofs
    const int* leaves;  // TaskLeaf, then those of its kind (tasks/kinds.hpp)
    int count;  // of the options
    const int* options;
  };
  struct Place {  // of a leaf
    int array, offset, size;
  };
  // the leaves of the step and those of the robot, in the order of the layout; the last three are NullSpace's
  enum { Q, DT, DAMPING, CURVATURE_DAMPING, BOX, BOX_END, POTENTIAL_GAIN, MARGIN, RANK_TOLERANCE, STEP_LEAVES };
  enum { OFFSET, REFERENCE, POSITION, QUATERNION, ANCHOR, AXIS, MASS, CENTER_OF_MASS, FRAME_POSITION };
  enum { FRAME_ROTATION = FRAME_POSITION + 1, ROBOT_LEAVES };
  StepSizes s;
  std::vector<int> numbers;
  std::vector<Task> tasks;
  const Place* places;
  const int *of_step, *of_robot;  // leaves, those of the box -1 for none
  const int *source, *owner, *turning, *scalar;  // [nq] entry of the given q, [dofs] body, [nv], [nv] place in q or -1
  const int* limits;  // [limits, 5] kind and leaves of each
  const int *parents, *types, *owners, *column;  // those of Tree and DofColumns
  const int *row_counts, *level_of_hard, *row_of_hard;

  StepLayout(const int* given, int count) : numbers(given, given + count) {
    const int *at = numbers.data(), *end = at + count;
    auto take = [&](int n) {
      if (n < 0 || n > end - at) throw std::runtime_error("the layout of a step is too short");
      return (at += n) - n;
    };
    constexpr int SIZES = sizeof(StepSizes) / sizeof(int);
    s = *reinterpret_cast<const StepSizes*>(take(SIZES));
    for (int k = 0; k < SIZES - 1; ++k)  // all but the limit on iterations
      if (numbers[k] < 0 || numbers[k] > count) throw std::runtime_error("the layout of a step has wrong sizes");
    places = reinterpret_cast<const Place*>(take(3 * s.leaves));
    of_step = take(STEP_LEAVES), of_robot = take(ROBOT_LEAVES), limits = take(5 * s.limits);
    parents = take(s.bodies), types = take(s.joints), owners = take(s.joints), source = take(s.nq), column = take(s.dofs);
    owner = take(s.dofs), turning = take(s.nv), scalar = take(s.nv);
    row_counts = take(s.L), level_of_hard = take(s.h), row_of_hard = take(s.h > s.nv ? s.h - s.nv : 0);
    for (int k = 0; k < s.tasks; ++k) {
      const int *o = take(8), *leaves = take(9);
      tasks.push_back({o[0], o[1], o[2], o[3], o[4], o[5], o[6], leaves, o[7], take(o[7])});
    }
  }
  bool has(const int* given, int count) const {
    return size_t(count) == numbers.size() && std::equal(given, given + count, numbers.begin());
  }
};

// A leaf's numbers. A scalar is each entry of an array that it stands for.
template <class In> struct Leaf {
  In at;
  int size;
  auto operator[](int i) const { return at[size > 1 ? i : 0]; }
};

// The rows of all tasks, and what the solvers need beside them, one robot's after another's.
struct RowPlaces {
  size_t error, J, low, high, weight, pull, square, levers, curvature, end;
  explicit RowPlaces(const StepSizes& s) {
    const size_t rows = s.rows + 8;
    error = 0, low = rows, high = 2 * rows, weight = 3 * rows, pull = 4 * rows, square = 5 * rows, J = 6 * rows;
    levers = J + size_t(s.rows) * s.nv + 8, curvature = levers + size_t(s.tasks) * s.nv, end = curvature + s.tasks;
  }
};
}  // namespace osik
