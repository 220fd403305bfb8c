// What control/_compiled_step.py lays out of a step, and the rows that follow from where the bodies are: for one robot, or
// for a pack of them (lanes.hpp).
#pragma once
#include <algorithm>
#include <stdexcept>
#include <type_traits>
#include <vector>

#include "lanes.hpp"
#include "task_rows.hpp"

namespace osik {

enum StepScheme { WEIGHTED = 0, HIERARCHICAL = 1, CLASSICAL = 2, SATURATED = 3 };  // the last two: NullSpace
enum StepTask { POSE = 0, CENTER = 1, POSTURE = 2, GIVEN = 3 };  // the last one: rows that JAX has computed
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
    const int* leaves;  // gain, weight, target velocity, bounds, then those of its kind
    int count;  // of the options
    const int* options;
  };
  struct Place {  // of a leaf
    int array, offset, size;
  };
  // the leaves of the step and those of the robot, in the order of the layout; the last three are NullSpace's
  enum { Q, DT, DAMPING, CURVATURE_DAMPING, BOX, BOX_END, POTENTIAL_GAIN, MARGIN, RANK_TOLERANCE, STEP_LEAVES };
  enum {
    OFFSET,
    REFERENCE,
    POSITION,
    QUATERNION,
    ANCHOR,
    AXIS,
    MASS,
    CENTER_OF_MASS,
    FRAME_POSITION,
    FRAME_ROTATION,
    ROBOT_LEAVES
  };
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

// The bodies, and the rows of tasks on frames and on the centre of mass. Real: double, or Lanes<double> for a pack.
template <class Real> class MovingRows {
  static constexpr bool ALONE = std::is_same_v<Real, double>;
  using In = std::conditional_t<ALONE, const double*, LaneNumbers<double>>;
  using Out = std::conditional_t<ALONE, double*, LaneResults<double>>;
  template <class At, class Number> static At numbers(Number* at, size_t apart) {
    if constexpr (ALONE) return at;
    else return {at, apart};
  }
  const StepLayout& layout;
  const StepSizes& s;
  const RowPlaces at;
  std::vector<Real> q, poses, frames, below, masses, weights;
  std::vector<double> zeros, unbounded;
  Placed<Real*> placed;
  const double* const* arrays;
  const size_t* apart;
  double* rows;
  Real most_gain;  // 1 / dt

  Leaf<In> leaf(int k) const {
    const StepLayout::Place& place = layout.places[k];
    return {numbers<In>(arrays[place.array] + place.offset, apart[place.array]), place.size};
  }
  In robot(int k) const { return leaf(layout.of_robot[k]).at; }

 public:
  explicit MovingRows(const StepLayout& layout)
      : layout(layout), s(layout.s), at(s), q(s.nq), poses(12 * s.bodies + 9 * s.dofs), frames(12 * s.nv + 24),
        below(4 * s.bodies), masses(s.bodies), weights(s.rows), zeros(s.rows + 6), unbounded(s.rows, -INFINITE) {
    Real *body = poses.data(), *dof = body + 12 * s.bodies;
    placed = {body, body + 3 * s.bodies, dof, dof + 3 * s.dofs, dof + 6 * s.dofs};
  }
  // Take the arrays of a robot or of a pack, in each of which the robots are `apart`, and place the bodies. constants: as
  // in StepData; rows: of the robots, RowPlaces::end apart
  void place(const double* constants, const double* const* given, const size_t* between, double* to) {
    arrays = given, apart = between, rows = to;
    const Real dt = leaf(layout.of_step[StepLayout::DT]).at[0];
    most_gain = Real(1) / select((dt > Real(0)) & (dt <= Real(LARGEST_DOUBLE)), dt, Real(1));
    const In from = leaf(layout.of_step[StepLayout::Q]).at, offset = robot(StepLayout::OFFSET);
    for (int i = 0; i < s.nq; ++i) q[i] = Real(constants[i]) * from[layout.source[i]] + offset[i];
    place_bodies(Tree<In>{s.bodies, s.joints, s.dofs, layout.parents, layout.types, layout.owners,
                          robot(StepLayout::REFERENCE), robot(StepLayout::POSITION), robot(StepLayout::QUATERNION),
                          robot(StepLayout::ANCHOR), robot(StepLayout::AXIS)},
                 q.data(), placed);
    columns = {s.dofs, s.nv, layout.column, numbers<In>(constants + s.nq, 0)};
  }
  // The rows of task k.
  void add(int k) {
    const StepLayout::Task& task = layout.tasks[k];
    const Real own_gain = leaf(task.leaves[0]).at[0], gain = select(own_gain > most_gain, most_gain, own_gain);
    Bounds<In> interval;
    if (task.bounded) {  // a polygon has upper bounds alone
      interval.lower = task.leaves[3] < 0 ? numbers<In>(unbounded.data(), 0) : leaf(task.leaves[3]).at;
      interval.upper = leaf(task.leaves[4]).at;
    }
    auto out = [&](size_t first, size_t i) { return numbers<Out>(rows + first + i, at.end); };
    const Rows<Out> to{out(at.error, task.first),
                       out(at.J, task.first * s.nv),
                       out(at.low, task.first),
                       out(at.curvature, k),
                       out(at.pull, task.first),
                       out(at.levers, k * s.nv),
                       task.bounded ? out(at.high, task.first) : Out{},
                       out(at.square, task.first)};
    if (task.kind == POSE) add_pose(task, interval, &gain, to);
    else add_center(task, interval, &gain, to);
    for (int i = 0; i < task.m; ++i) out(at.weight, task.first)[i] = weights[i];
  }

 private:
  DofColumns<In> columns;

  // the target velocity of a task
  In velocity(const StepLayout::Task& task) const {
    return task.leaves[2] < 0 ? numbers<In>(zeros.data(), 0) : leaf(task.leaves[2]).at;
  }
  void add_pose(const StepLayout::Task& task, const Bounds<In>& interval, const Real* gain, const Rows<Out>& to) {
    const int *options = task.options, *leaves = task.leaves, nv = s.nv, count = options[8];
    const PoseGoal<In, const Real*> goal{leaf(leaves[5]).at, leaf(leaves[6]).at, velocity(task),  weights.data(), gain,
                                         options + 2,        options[0] != 0,    options[1] != 0, interval};
    for (int i = 0, row = 0; i < 6; ++i)
      if (goal.kept[i]) weights[row] = leaf(leaves[1])[row] * leaf(leaves[7 + i / 3])[i % 3], ++row;
    Real *position = frames.data(), *turn = position + 6, *jacobian = position + 24;
    auto frame = [&](int f) { return options + 9 + f * (2 + s.dofs); };  // number, carrier, whether each dof moves it
    auto offset_of = [&](int f) { return robot(StepLayout::FRAME_POSITION) + 3 * frame(f)[0]; };
    auto turn_of = [&](int f) { return robot(StepLayout::FRAME_ROTATION) + 9 * frame(f)[0]; };
    if (count == 1 && columns.alone()) {
      const auto point = place_frame(placed, frame(0)[1], offset_of(0), turn_of(0), position, turn);
      const CarriedColumns<In, Real*> own{placed, columns.factor, frame(0) + 2, point};
      return pose_rows(goal, position, turn, own, nv, to);
    }
    for (int f = 0; f < count; ++f)
      move_frame(columns, placed, frame(f)[1], offset_of(f), turn_of(f), frame(f) + 2, position + 3 * f, turn + 9 * f,
                 jacobian + 6 * nv * f);
    if (count == 2) see_from_root(position, turn, jacobian);
    pose_rows(goal, position, turn, StoredColumns<const Real*>{jacobian, nv}, nv, to);
  }
  // options: whether there is a polygon, axes, whether each body counts
  void add_center(const StepLayout::Task& task, const Bounds<In>& interval, const Real* gain, const Rows<Out>& to) {
    const int *options = task.options, m = task.m;
    CenterGoal<In, const Real*> goal{m, options + 1, layout.turning, {}, velocity(task), weights.data(), gain, {}, interval};
    if (options[0]) goal.normals = leaf(task.leaves[5]).at;
    else if (!task.bounded) goal.target = leaf(task.leaves[5]).at;
    for (int i = 0; i < m; ++i) weights[i] = leaf(task.leaves[1])[i];
    const In mass = robot(StepLayout::MASS);
    for (int b = 0; b < s.bodies; ++b) masses[b] = options[1 + m + b] ? Real(mass[b]) : Real(0);
    Real* point = frames.data();
    const auto center = find_center(columns, placed, s.bodies, layout.parents, layout.owner, masses.data(),
                                    robot(StepLayout::CENTER_OF_MASS), below.data(), point);
    with_columns(center, point + 3, [&](auto columns) { center_rows(goal, point, columns, s.nv, to); });
  }
  // the first frame's pose and Jacobian in the axes of the second (tasks/_relative_frame.py)
  void see_from_root(Real* position, Real* rotation, Real* jacobian) {
    using V = Vec3<Real>;
    const Mat3<Real> turn = Mat3<Real>::of(rotation + 9).transposed();
    const V apart = V::of(position) - V::of(position + 3);
    Real* to = jacobian;
    for (const Real* root = jacobian + 6 * s.nv; to < jacobian + s.nv; ++to, ++root) {
      auto entry = [&](const Real* from, int i) { return V{from[i * s.nv], from[(i + 1) * s.nv], from[(i + 2) * s.nv]}; };
      const V angular = entry(root, 3), linear = turn * (entry(to, 0) - entry(root, 0) + cross(apart, angular));
      const V axis = turn * (entry(to, 3) - angular);
      int i = 0;
      for (Real value : {linear.x, linear.y, linear.z, axis.x, axis.y, axis.z}) to[i++ * s.nv] = value;
    }
    (turn * apart).put(position), (turn * Mat3<Real>::of(rotation)).put(rotation);
  }
};
}  // namespace osik
