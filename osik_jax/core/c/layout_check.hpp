// Checks of what a file says of a step, before a step uses it: each size, index and length of control/_compiled_step.py.
//
// A checksum tells that a file is as it was written, not that what was written is right.
#pragma once
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include "../step_layout.hpp"
#include "../tasks/kinds.hpp"

namespace osik {

class LayoutCheck {
  using Task = StepLayout::Task;
  const StepLayout& layout;
  const bool by_weight, projects;

 public:
  const StepSizes& s;
  // numbers, constants: lengths of the file's arrays of these names
  LayoutCheck(const StepLayout& layout, size_t numbers, size_t constants)
      : layout(layout), by_weight(layout.s.scheme == WEIGHTED),
        projects(layout.s.scheme == CLASSICAL || layout.s.scheme == SATURATED), s(layout.s) {
    check_sizes();
    const int tolerances[] = {2, 4, 1, 1};  // of each scheme
    require(constants == size_t(s.nq) + s.dofs + 1 + tolerances[s.scheme], "constants");
    for (int k = 0; k < s.leaves; ++k) {
      const auto [array, offset, size] = layout.places[k];
      require(array == 0 && offset >= 0 && size >= 0 && size_t(offset) + size <= numbers, "places of leaves");
    }
    check_leaves();
    check_tree();
    int rows = 0, dense = 0, intervals = 0;
    std::vector<int> of_level(s.tasks + 1);
    for (const Task& task : layout.tasks) {
      check(task);
      rows += task.m, of_level[task.level] += task.m;
      if (!task.diagonal) (task.bounded ? intervals : dense) += task.m;
    }
    require(rows == s.rows, "rows");
    if (by_weight) require(s.m == dense && s.p == intervals && s.L == 0 && s.h == 0, "rows of the weighted scheme");
    else check_levels(of_level);
  }

  static void require(bool holds, const char* part) {
    if (!holds) throw std::runtime_error(std::string("its section \"core\" is wrong (") + part + "): save it again");
  }
  static void require_within(const int* from, int count, int low, int end, const char* part) {
    for (int i = 0; i < count; ++i) require(from[i] >= low && from[i] < end, part);
  }
  void check_leaf(int k, int size, int other = -1) const {
    require(k >= 0 && k < s.leaves && (layout.places[k].size == size || layout.places[k].size == other), "leaves");
  }
  void check_optional_leaf(int k, int size) const {
    if (k != -1) check_leaf(k, size);
  }
  int frames() const {
    const int k = layout.of_robot[StepLayout::FRAME_POSITION];
    require(k >= 0 && k < s.leaves && layout.places[k].size % 3 == 0 && layout.places[k].size < 1 << 24, "frames");
    return layout.places[k].size / 3;
  }

 private:
  void check_sizes() const {
    require(s.scheme >= WEIGHTED && s.scheme <= SATURATED && s.bodies > 0 && s.nv > 0 && s.given > 0 && s.tasks > 0,
            "sizes");
    require(s.max_iterations > 0 && s.max_iterations <= 20 * (s.nv + s.rows + 1), "limit on iterations");
    // workspaces have some thousand columns at most, so that their sizes in bytes are integers
    require(s.nv + s.dofs + s.m + s.p + s.h + s.rows <= 8192 && int64_t(s.L) * s.m * s.nv <= 1 << 24, "sizes");
  }
  // the leaves of the step, of the robot, and of limits
  void check_leaves() const {
    using L = StepLayout;
    const int *step = layout.of_step, *robot = layout.of_robot;
    check_leaf(step[L::Q], s.given);
    for (int k : {L::DT, L::DAMPING, L::CURVATURE_DAMPING}) check_leaf(step[k], 1);
    require(step[L::BOX] == -1, "box");
    for (int k : {L::POTENTIAL_GAIN, L::MARGIN, L::RANK_TOLERANCE})
      projects ? check_leaf(step[k], 1) : check_optional_leaf(step[k], 1);
    check_leaf(robot[L::OFFSET], s.nq), check_leaf(robot[L::REFERENCE], s.nq);
    check_leaf(robot[L::POSITION], 3 * s.bodies), check_leaf(robot[L::QUATERNION], 4 * s.bodies);
    check_leaf(robot[L::ANCHOR], 3 * s.joints), check_leaf(robot[L::AXIS], 3 * s.joints);
    check_leaf(robot[L::MASS], s.bodies), check_leaf(robot[L::CENTER_OF_MASS], 3 * s.bodies);
    check_leaf(robot[L::FRAME_ROTATION], 9 * frames());
    for (const int* limit = layout.limits; limit < layout.limits + 5 * s.limits; limit += 5) {
      require(limit[0] == SPEED || limit[0] == RANGE, "limits");
      for (int i = 1; i < 5; ++i) check_leaf(limit[i], 1, s.nv);
    }
  }
  void check_tree() const {
    for (int b = 1; b < s.bodies; ++b) require_within(layout.parents + b, 1, 0, b, "parents");
    require_within(layout.types, s.joints, FREE_JOINT, HINGE_JOINT + 1, "joints");
    require_within(layout.owners, s.joints, 0, s.bodies, "joints");
    int nq = 0, dofs = 0;
    for (int j = 0; j < s.joints; ++j) {
      const int type = layout.types[j];
      nq += type == FREE_JOINT ? 7 : type == BALL_JOINT ? 4 : 1, dofs += type == FREE_JOINT ? 6 : type == BALL_JOINT ? 3 : 1;
    }
    require(nq == s.nq && dofs == s.dofs, "joints");
    require_within(layout.source, s.nq, 0, s.given, "entries of q");
    require_within(layout.column, s.dofs, -1, s.nv, "columns"), require_within(layout.owner, s.dofs, 0, s.bodies, "columns");
    require_within(layout.scalar, s.nv, -1, s.given, "entries of q");
  }
  void check(const Task& task) const {
    const int *leaves = task.leaves, m = task.m, bounded = task.bounded != 0;
    require(m >= 0 && m <= s.rows && task.first >= 0 && task.first <= s.rows - m && task.out >= 0 && task.out <= s.rows - m,
            "rows");
    require(task.level >= 0 && task.level < s.tasks, "levels");
    require(task.kind >= 0 && task.kind < TaskKinds::COUNT, "tasks");
    TaskKinds::with(task.kind, [&](auto card) {
      require(task.diagonal == (by_weight && card.HAS_DOFS && !bounded), "tasks");
      check_leaf(leaves[GAIN], 1), check_leaf(leaves[WEIGHT], 1, m);
      check_optional_leaf(leaves[TARGET_VELOCITY], card.velocities(m));
      if (bounded && (leaves[LOWER] != -1 || card.HAS_DOFS)) check_leaf(leaves[LOWER], m);
      if (bounded) check_leaf(leaves[UPPER], m);
      card.check(*this, task);
    });
  }
  // of_level: rows of the tasks of each level; the last level of a hierarchy has none
  void check_levels(const std::vector<int>& of_level) const {
    require(s.p == 0 && s.L >= 2 && s.L <= s.tasks + 1 && s.h >= s.nv, "levels");
    int longest = 0, hard = s.nv;
    for (int k = 0; k < int(of_level.size()); ++k) {
      require(of_level[k] == (k < s.L ? layout.row_counts[k] : 0), "rows of levels");
      longest = larger(longest, of_level[k]);
    }
    require(longest == s.m && of_level[s.L - 1] == 0, "rows of levels");
    require_within(layout.level_of_hard, s.nv, -1, 0, "hard rows");
    for (int level = 0; level < s.L && hard < s.h; ++level)  // all rows of a level are hard, or none
      for (int row = 0; row < of_level[level] && hard < s.h && (row || layout.level_of_hard[hard] == level); ++row, ++hard)
        require(layout.level_of_hard[hard] == level && layout.row_of_hard[hard - s.nv] == row &&
                    s.h - hard >= of_level[level] - row,
                "hard rows");
    require(hard == s.h, "hard rows");
  }
};
}  // namespace osik
