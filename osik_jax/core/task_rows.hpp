// Rows of tasks that ask for a pose or a centre of mass: what tasks/_pose.py and tasks/_com.py define.
#pragma once
#include "kinematics.hpp"

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
  Real size = fabs(pull.x);
  size = select(fabs(pull.y) > size, fabs(pull.y), size), size = select(fabs(pull.z) > size, fabs(pull.z), size);
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
  Real turning = 0, largest = 0, square = 0, xx = 0, xy = 0, yy = 0, zz = 0;
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
    const Real pull = fabs(goal.weight[i] * to.pull[i]);
    largest = select((pull > largest) | (pull != pull), pull, largest);
    if (!to.squares) continue;
    const Real length = goal.normals ? along(i, along(i, xx, xy, Real(0)), along(i, xy, yy, Real(0)), Real(0))
                                     : along(i, xx, yy, zz);
    to.squares[i] = select(length < Real(0), Real(0), length);  // which roundoff may make it
  }
  // the length of the weighted pull times the Frobenius norm of the columns of dofs that turn something
  const Real unit = select(largest > Real(0), Real(1) / largest, Real(0));
  for (int i = 0; i < goal.m; ++i) {
    const Real part = goal.weight[i] * to.pull[i] * unit;
    square += part * part;
  }
  to.curvature[0] = largest * sqrt(square) * sqrt(turning);
}
}  // namespace osik
