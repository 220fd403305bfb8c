// Tasks that ask for angles or lengths of joints: what tasks/_posture.py defines.
#pragma once
#include "rows.hpp"

namespace osik {

struct PostureTask : CommonCard {
  static constexpr bool HAS_DOFS = true;
  enum { CONFIGURATION = OWN };  // leaf: the target
  template <class Task> static int dofs(const Task& task) {
    return task.m;
  }  // options: entry of q of each row, then its dof
  template <class File, class Task> static void check(const File& file, const Task& task) {
    file.require(task.count == 2 * task.m, "tasks");
    if (!task.bounded) file.check_leaf(task.leaves[CONFIGURATION], file.s.given);
    file.require_within(task.options, task.m, 0, file.s.given, "posture");
    file.require_within(task.options + task.m, task.m, 0, file.s.nv, "posture");
  }
  template <class Step, class Task> static bool is_valid(const Step& step, const Task& task) {
    return task.bounded || step.is_finite(task, CONFIGURATION);
  }
  // step: the rows of a robot (StepRows); given: its q
  template <class Step, class Task>
  static void add(Step& step, Task& task, const double* given, const double* velocity, double gain) {
    const int *options = task.options, *leaves = task.leaves;
    const double* target = task.bounded ? nullptr : step.leaf(leaves[CONFIGURATION]).at;
    Bounds<const double*> interval;
    if (task.bounded) interval = {step.leaf(leaves[LOWER]).at, step.leaf(leaves[UPPER]).at};
    *task.rows.curvature = 0;
    for (int j = 0; j < step.s.nv; ++j) task.rows.levers[j] = 0;
    for (int i = 0; i < task.m; ++i) {
      const double value = given[options[i]] - (target ? target[options[i]] : 0.0);
      task.weight[i] = step.leaf(leaves[WEIGHT])[i];
      ask(task.rows, interval, i, value, velocity[i], gain);
    }
    step.put_dofs(task);
  }
};
}  // namespace osik
