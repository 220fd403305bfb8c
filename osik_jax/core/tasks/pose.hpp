// Tasks that ask for the pose of a frame, or of one frame in another: what tasks/_pose.py defines.
#pragma once
#include "../kinematics.hpp"
#include "rows.hpp"

namespace osik {

// The pose that a task asks for, and how.
template <class In, class Own = In> struct PoseGoal {
  In position, rotation, velocity;  // [3], [9], [6] of the target, [linear; angular]
  Own weight, gain;                 // [m] of the rows that are kept, [1]
  const int* kept;                  // [6] flags
  bool in_frame, geometric;         // rows along the frame's axes; without the inverse left Jacobian
  Bounds<In> bounds;
};

// The sums of products of the entries of vectors: xx, xy, xz, yy, yz, zz.
template <class Real> struct Products {
  Real sums[6] = {};
  void add(Real x, Real y, Real z) {
    sums[0] += x * x, sums[1] += x * y, sums[2] += x * z, sums[3] += y * y, sums[4] += y * z, sums[5] += z * z;
  }
};

// The Frobenius norm of the matrix with entries pull . (axis_i x arm_j), from the products of axes and of arms.
template <class Real> Real paired(Vec3<Real> pull, const Products<Real>& of_axes, const Products<Real>& of_arms) {
  const Real *axes = of_axes.sums, *arms = of_arms.sums;
  const Real size = largest_entry(pull);
  const auto pulls = size > Real(0);
  if (!any(pulls)) return 0;
  const Vec3<Real> unit = Real(1) / size * pull;
  const Real x = unit.x, y = unit.y, z = unit.z;
  const Real xx = axes[0], xy = axes[1], xz = axes[2], yy = axes[3], yz = axes[4], zz = axes[5];
  // products of pull x axis_i with each other
  const Real txx = y * y * zz - 2 * y * z * yz + z * z * yy, tyy = z * z * xx - 2 * z * x * xz + x * x * zz;
  const Real tzz = x * x * yy - 2 * x * y * xy + y * y * xx, txy = y * z * xz - x * y * zz - z * z * xy + x * z * yz;
  const Real txz = x * y * yz - y * y * xz - x * z * yy + y * z * xy;
  const Real tyz = x * z * xy - y * z * xx - x * x * yz + x * y * xz;
  const Real squared = txx * arms[0] + tyy * arms[3] + tzz * arms[5] + 2 * (txy * arms[1] + txz * arms[2] + tyz * arms[4]);
  return select(pulls & (squared > Real(0)), size * sqrt(squared), Real(0));
}

// The columns of a frame's Jacobian J [6, nv], which are there.
template <class At> struct StoredColumns {
  using Real = NumberAt<At>;
  At J;
  int nv;
  Twist<Real> operator[](int j) const {
    return {{J[j], J[nv + j], J[2 * nv + j]}, {J[3 * nv + j], J[4 * nv + j], J[5 * nv + j]}};
  }
};

// The same of a frame at a point, computed where they are asked for; each dof has a column of its own.
template <class In, class From> struct CarriedColumns {
  using Real = NumberAt<From>;
  Placed<From> placed;
  In factor;         // [nv]
  const int* moved;  // [nv] flags
  Vec3<Real> at;
  Twist<Real> operator[](int j) const { return moved[j] ? motion_of(placed, j, at, Real(factor[j])) : Twist<Real>{}; }
};

// Rows of a pose task, from the frame's position [3], rotation [9] and the columns of its Jacobian.
//
// The error of the position is p - p*; that of the rotation R is the logarithm e of R R*', or of R*'R in the frame's
// axes. Its rate is E w: E the inverse left Jacobian of SO(3) at e, w the angular velocity; in the frame's axes E'R' w.
template <class In, class Own, class From, class Columns, class Out>
void pose_rows(const PoseGoal<In, Own>& goal, From position, From rotation, const Columns& J, int nv, const Rows<Out>& to) {
  using Real = NumberAt<Out>;
  using V = Vec3<Real>;
  using M = Mat3<Real>;
  const M R = M::of(rotation), own = R.transposed(), wanted = M::of(goal.rotation);
  const M outer = goal.in_frame ? own : M::identity();  // to the axes of the linear rows
  const M between = goal.in_frame ? wanted.transposed() * R : R * wanted.transposed();
  const V offset = V::of(position) - V::of(goal.position), turn = rotation_log(between);
  const M E = goal.geometric ? M::identity() : inverse_left_jacobian(turn);
  const M factor = goal.in_frame ? E.transposed() * own : E;
  const V linear = outer * V::of(goal.velocity), target_turn = V::of(goal.velocity + 3);
  const V angular = factor * (goal.in_frame ? target_turn : between * target_turn), distance = outer * offset;
  const Real error[6] = {distance.x, distance.y, distance.z, turn.x, turn.y, turn.z};
  const Real forward[6] = {linear.x, linear.y, linear.z, angular.x, angular.y, angular.z};
  Real squares[6] = {};
  Products<Real> axes, arms;  // of the columns that turn the frame
  OSIK_UNROLL_4
  for (int j = 0; j < nv; ++j) {
    const auto [moves, axis] = J[j];
    const V v = goal.in_frame ? own * (moves + cross(offset, axis)) : moves, w = factor * axis;
    const Real column[6] = {v.x, v.y, v.z, w.x, w.y, w.z};
    Real lever = 0;
    OSIK_UNROLL
    for (int i = 0, row = 0; i < 6; ++i) {
      const Real square = column[i] * column[i];
      squares[i] += square;
      if (!goal.kept[i]) continue;
      to.jacobian[row * nv + j] = column[i], lever += goal.weight[row] * square, ++row;
    }
    to.levers[j] = sqrt(lever);
    const auto turns = (axis.x != Real(0)) | (axis.y != Real(0)) | (axis.z != Real(0));
    auto arm = [&](Real a) { return select(turns, a, Real(0)); };
    axes.add(axis.x, axis.y, axis.z), arms.add(arm(moves.x), arm(moves.y), arm(moves.z));
  }
  Real pull[6] = {};
  OSIK_UNROLL
  for (int i = 0, row = 0; i < 6; ++i)
    if (goal.kept[i]) {
      ask(to, goal.bounds, row, error[i], forward[i], goal.gain[0]);
      pull[i] = goal.weight[row] * to.pull[row];
      if (to.squares) to.squares[row] = squares[i];
      ++row;
    }
  // a bound on the curvature of the error along force and torque on the frame: tasks/_curvature.py, pose_curvature
  const V along = V::of(pull + 0), about = V::of(pull + 3), force = goal.in_frame ? R * along : along;
  const V torque = goal.in_frame ? R * about : about;
  to.curvature[0] = (paired(force, axes, arms) + Real(0.5) * paired(torque, axes, axes)) / Real(1.4142135623730951);
}

// Turn the first of two frames' poses and Jacobians into those in the axes of the second (tasks/_frame.py: RelativeFrameTask).
template <class Real> void see_from_root(Real* position, Real* rotation, Real* jacobian, int nv) {
  using V = Vec3<Real>;
  const Mat3<Real> turn = Mat3<Real>::of(rotation + 9).transposed();
  const V apart = V::of(position) - V::of(position + 3);
  Real* to = jacobian;
  for (const Real* root = jacobian + 6 * nv; to < jacobian + nv; ++to, ++root) {
    auto entry = [&](const Real* from, int i) { return V{from[i * nv], from[(i + 1) * nv], from[(i + 2) * nv]}; };
    const V angular = entry(root, 3), linear = turn * (entry(to, 0) - entry(root, 0) + cross(apart, angular));
    const V axis = turn * (entry(to, 3) - angular);
    int i = 0;
    for (Real value : {linear.x, linear.y, linear.z, axis.x, axis.y, axis.z}) to[i++ * nv] = value;
  }
  (turn * apart).put(position), (turn * Mat3<Real>::of(rotation)).put(rotation);
}

// Cards of tasks on one or two frames. Options from FRAMES on: how many, and of each its number, its body, and whether each dof
// moves it.
template <int FRAMES> struct FramedCard : CommonCard {
  static constexpr bool MOVES = true;
  static constexpr int FIRST = FRAMES + 1;
  template <class File, class Task> static void check_frames(const File& file, const Task& task) {
    const int *options = task.options, size = 2 + file.s.dofs;
    file.require(task.count >= FIRST && (options[FRAMES] == 1 || options[FRAMES] == 2) &&
                     task.count == FIRST + options[FRAMES] * size,
                 "frames");
    for (const int* frame = options + FIRST; frame < options + task.count; frame += size)
      file.require_within(frame, 1, 0, file.frames(), "frames"),
          file.require_within(frame + 1, 1, 0, file.s.bodies, "frames");
  }
  // Positions [2, 3], rotations [2, 9] and Jacobians [2, 6, nv] of the frames, where the robot's rows keep them (MovingRows).
  template <class Own> struct Frames {
    using Real = typename Own::Number;
    using In = typename Own::In;
    Own& own;
    const int* options;
    Real *position = own.frames.data(), *rotation = position + 6, *jacobian = position + 24;

    int count() const { return options[FRAMES]; }
    const int* moved(int f) const { return options + FIRST + f * (2 + own.s.dofs) + 2; }
    int body(int f) const { return moved(f)[-1]; }
    In offset(int f) const { return own.robot(own.layout.FRAME_POSITION) + 3 * moved(f)[-2]; }
    In turn(int f) const { return own.robot(own.layout.FRAME_ROTATION) + 9 * moved(f)[-2]; }
    StoredColumns<const Real*> columns(int f) const { return {jacobian + 6 * own.s.nv * f, own.s.nv}; }
    Vec3<Real> place() const { return place_frame(own.placed, body(0), offset(0), turn(0), position, rotation); }
    void move() const {
      for (int f = 0; f < count(); ++f)
        move_frame(own.columns, own.placed, body(f), offset(f), turn(f), moved(f), position + 3 * f, rotation + 9 * f,
                   jacobian + 6 * own.s.nv * f);
    }
  };
};

struct PoseTask : FramedCard<8> {
  enum { POSITION = OWN, ROTATION, POSITION_WEIGHT, ROTATION_WEIGHT };  // leaves; a weight of each row, or of all three
  enum { IN_FRAME, GEOMETRIC, KEPT };  // options, then the frames, of which the second one is what the first one is in
  static int velocities(int) { return 6; }
  template <class File, class Task> static void check(const File& file, const Task& task) {
    const int *options = task.options, *leaves = task.leaves;
    file.check_leaf(leaves[POSITION], 3), file.check_leaf(leaves[ROTATION], 9);
    file.check_leaf(leaves[POSITION_WEIGHT], 1, 3), file.check_leaf(leaves[ROTATION_WEIGHT], 1, 3);
    check_frames(file, task);
    int kept = 0;
    for (int i = 0; i < 6; ++i) kept += options[KEPT + i] != 0;
    file.require(kept == task.m, "rows");
  }
  template <class Step, class Task> static bool is_valid(const Step& step, const Task& task) {
    auto finite = [&](int i) { return step.is_finite(task, i); };
    return finite(POSITION) && finite(ROTATION) && finite(POSITION_WEIGHT) && finite(ROTATION_WEIGHT);
  }
  // own: the rows of a robot (MovingRows), whose bodies are placed
  template <class Own, class Task, class Interval, class Real, class To>
  static void add(Own& own, const Task& task, const Interval& interval, const Real* gain, const To& to) {
    using In = typename Own::In;
    const int *options = task.options, *leaves = task.leaves, nv = own.s.nv;
    auto leaf = [&](int i) { return own.leaf(leaves[i]); };
    PoseGoal<In, const Real*> goal{};
    goal.position = leaf(POSITION).at, goal.rotation = leaf(ROTATION).at, goal.velocity = own.velocity(task);
    goal.weight = own.weights.data(), goal.gain = gain, goal.kept = options + KEPT, goal.bounds = interval;
    goal.in_frame = options[IN_FRAME] != 0, goal.geometric = options[GEOMETRIC] != 0;
    for (int i = 0, row = 0; i < 6; ++i)
      if (goal.kept[i]) own.weights[row] = leaf(WEIGHT)[row] * leaf(POSITION_WEIGHT + i / 3)[i % 3], ++row;
    const Frames<Own> frames{own, options};
    if (frames.count() == 1 && own.columns.alone()) {
      const CarriedColumns<In, Real*> carried{own.placed, own.columns.factor, frames.moved(0), frames.place()};
      return pose_rows(goal, frames.position, frames.rotation, carried, nv, to);
    }
    frames.move();
    if (frames.count() == 2) see_from_root(frames.position, frames.rotation, frames.jacobian, nv);
    pose_rows(goal, frames.position, frames.rotation, frames.columns(0), nv, to);
  }
};
}  // namespace osik
