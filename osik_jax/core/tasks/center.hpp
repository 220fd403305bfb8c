// Tasks that ask for a place of the centre of mass: what tasks/_com.py defines.
#pragma once
#include "../kinematics.hpp"
#include "rows.hpp"

namespace osik {

// Where a task asks the centre of mass to be, along `m` of the world's axes or normals of edges on the ground.
template <class In, class Own = In> struct CenterGoal {
  int m;
  const int *axes, *turning;            // [m] 0 for x, 1 for y, 2 for z; [nv] whether a dof turns something
  In target, velocity;                  // [m] each, or null for 0
  Own weight, gain;                     // [m], [1]
  In normals{};                         // [m, 2] in place of axes
  Bounds<In> bounds = {};
};

// Rows of a task on the centre of mass `point` [3], whose Jacobian has these columns.
template <class In, class Own, class From, class Columns, class Out>
void center_rows(const CenterGoal<In, Own>& goal, From point, const Columns& columns, int nv, const Rows<Out>& to) {
  using Real = NumberAt<Out>;
  auto along = [&](int i, Real x, Real y, Real z) {
    if (goal.normals) return goal.normals[2 * i] * x + goal.normals[2 * i + 1] * y;
    return goal.axes[i] == 0 ? x : goal.axes[i] == 1 ? y : z;
  };
  Real turning = 0, xx = 0, xy = 0, yy = 0, zz = 0;
  OSIK_UNROLL_4
  for (int j = 0; j < nv; ++j) {
    const auto [x, y, z] = columns[j];
    Real lever = 0;
    OSIK_UNROLL_4
    for (int i = 0; i < goal.m; ++i) {
      const Real entry = along(i, x, y, z);
      to.jacobian[i * nv + j] = entry, lever += goal.weight[i] * entry * entry;
    }
    to.levers[j] = sqrt(lever), turning += goal.turning[j] ? x * x + y * y + z * z : Real(0);
    xx += x * x, xy += x * y, yy += y * y, zz += z * z;
  }
  for (int i = 0; i < goal.m; ++i) {
    const Real value = along(i, point[0], point[1], point[2]);
    ask(to, goal.bounds, i, goal.target ? value - goal.target[i] : value, goal.velocity ? goal.velocity[i] : Real(0),
        goal.gain[0]);
    if (!to.squares) continue;
    const Real length = goal.normals ? along(i, along(i, xx, xy, Real(0)), along(i, xy, yy, Real(0)), Real(0))
                                     : along(i, xx, yy, zz);
    to.squares[i] = select(length < Real(0), Real(0), length);  // which roundoff may make it
  }
  // the length of the weighted pulls times the Frobenius norm of the columns of dofs that turn something
  to.curvature[0] = pull_length(goal.weight, to.pull, goal.m) * sqrt(turning);
}

struct CenterTask : CommonCard {
  static constexpr bool MOVES = true;
  enum { PLACE = OWN };  // leaf: normals of a polygon's edges [m, 2], or the target [m]
  enum { POLYGON, AXES };  // options: whether there is a polygon, the axes, and whether each body counts
  template <class File, class Task> static void check(const File& file, const Task& task) {
    file.require(task.count == AXES + task.m + file.s.bodies, "centre of mass");
    if (task.options[POLYGON] || !task.bounded)
      file.check_leaf(task.leaves[PLACE], task.m * (task.options[POLYGON] ? 2 : 1));
    file.require_within(task.options + AXES, task.m, 0, 3, "axes");
  }
  template <class Step, class Task> static bool is_valid(const Step& step, const Task& task) {
    return task.options[POLYGON] || task.bounded || step.is_finite(task, PLACE);
  }
  template <class Step, class Task> static bool takes(const Step& step, const Task& task) {
    return !task.options[POLYGON] || step.is_finite(task, PLACE);
  }
  template <class Own, class Task, class Interval, class Real, class To>
  static void add(Own& own, const Task& task, const Interval& interval, const Real* gain, const To& to) {
    using In = typename Own::In;
    const auto& layout = own.layout;
    const int *options = task.options, m = task.m, bodies = own.s.bodies;
    CenterGoal<In, const Real*> goal{m,  options + AXES, layout.turning, {}, own.velocity(task), own.weights.data(), gain,
                                     {}, interval};
    if (options[POLYGON]) goal.normals = own.leaf(task.leaves[PLACE]).at;
    else if (!task.bounded) goal.target = own.leaf(task.leaves[PLACE]).at;
    for (int i = 0; i < m; ++i) own.weights[i] = own.leaf(task.leaves[WEIGHT])[i];
    const In mass = own.robot(layout.MASS);
    for (int b = 0; b < bodies; ++b) own.masses[b] = options[AXES + m + b] ? Real(mass[b]) : Real(0);
    Real* point = own.frames.data();
    const auto found = find_center(own.columns, own.placed, bodies, layout.parents, layout.owner, own.masses.data(),
                                   own.robot(layout.CENTER_OF_MASS), own.below.data(), point);
    with_columns(found, point + 3, [&](auto columns) { center_rows(goal, point, columns, own.s.nv, to); });
  }
};
}  // namespace osik
