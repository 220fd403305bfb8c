// The kinds of a step's tasks: one list, over which the step and the check of its file go. A kind is a card:
//
//   velocities(m)            numbers of the target velocity of m rows
//   dofs(task)               where its options have the dof of each row; their number where rows are not those of dofs
//   closes_loop(task)        whether its rows keep a loop closed
//   check(file, task)        what a file may say of it (c/layout_check.hpp)
//   is_spoiled(step, task)   whether a number of its arrays is NaN
//   is_valid, takes          whether its numbers are valid, and whether a solver takes them
//   add(...)                 its rows. MOVES: from where the bodies are (moving_rows.hpp); HAS_DOFS: from q;
//                            IS_COMPUTED: they are given (both step_rows.hpp)
#pragma once
#include "center.hpp"
#include "given.hpp"
#include "pointing.hpp"
#include "posture.hpp"

namespace osik {

// Kinds by their numbers: their places in the list.
template <class... Cards> struct KindsOf {
  static constexpr int COUNT = sizeof...(Cards);
  // f(card) of a kind
  template <class F> static void with(int kind, F f) {
    int k = 0;
    ((k++ == kind ? f(Cards()) : void()), ...);
  }
};
using TaskKinds = KindsOf<PoseTask, CenterTask, PostureTask, GivenTask, PointingTask>;  // the order of tasks/_task.py
}  // namespace osik
