// Rows that JAX has computed, of any task.
#pragma once
#include "../lanes.hpp"
#include "../step_layout.hpp"
#include "rows.hpp"

namespace osik {

struct GivenTask : CommonCard {
  static constexpr bool IS_COMPUTED = true;
  // options: whether the rows close a loop, the task's own leaves, how many of them are never infinite, these, then dofs
  enum { CLOSES_LOOP, LEAVES, LEAVES_END, FINITE, FIRST_FINITE };
  template <class Task> static int dofs(const Task& task) { return FIRST_FINITE + task.options[FINITE]; }
  template <class Task> static bool closes_loop(const Task& task) { return task.options[CLOSES_LOOP]; }
  template <class Step, class Task> static bool is_spoiled(const Step& step, const Task& task, int arrays) {
    return step.spoiled(task.options[LEAVES], task.options[LEAVES_END], arrays);
  }
  template <class File, class Task> static void check(const File& file, const Task&) { file.require(false, "tasks"); }
  // Put the rows in place; returns whether a solver takes them. Leaves: error, bounds (or none above), weight, pull, levers,
  // curvature, Jacobian (none for rows of dofs).
  template <class Step, class Task> static bool add(Step& step, Task& task) {
    const int m = task.m, nv = step.s.nv, *options = task.options, *leaves = task.leaves;
    for (int i = 0; i < options[FINITE]; ++i) {
      const auto own = step.leaf(options[FIRST_FINITE + i]);
      task.valid = task.valid && all_finite(own.at, own.size);
    }
    const auto& to = task.rows;
    double* const places[] = {to.error, to.lower, to.upper, task.weight, to.pull, to.levers, to.curvature, to.jacobian};
    const int sizes[] = {m, m, m, m, m, nv, 1, m * nv};
    for (int k = 0; k < 8; ++k)
      for (int i = 0; i < sizes[k] && leaves[k] >= 0; ++i) places[k][i] = step.leaf(leaves[k]).at[i];
    if (task.dofs) step.put_dofs(task);
    bool takes = all_finite(task.weight, m) && all_finite(to.error, m) && all_finite(to.pull, m) &&
                 all_finite(to.levers, nv) && all_finite(to.curvature, 1);
    for (int i = 0; i < m; ++i) {
      const double* row = &to.jacobian[i * nv];
      if (!task.dofs) to.squares[i] = Step::Team::own_dot(row, row, 0, nv);
      takes &= !task.bounded || (step.s.scheme == WEIGHTED && task.weight[i] == 0) ||
               (to.lower[i] < INFINITE && to.upper[i] > -INFINITE);
    }
    return takes && step.are_taken(task);
  }
};
}  // namespace osik
