// Rows of all tasks of one control step, its box, and what both are computed from: what control/_compiled_step.py lays out.
//
//   configuration -> bodies -> rows of all tasks; limits -> box
//
// The rows of task k are rows first .. first + m of the matrix of all rows. The weighted scheme has the equalities of
// frames and of the centre of mass first (`dense` rows), then the inequalities (`intervals`), then the equalities of
// single dofs, which are terms of its diagonal.
#pragma once
#include <algorithm>
#include <vector>

#include "serial.hpp"
#include "task_rows.hpp"

namespace osik {

enum StepScheme { WEIGHTED = 0, HIERARCHICAL = 1, CLASSICAL = 2, SATURATED = 3 };  // the last two: NullSpace
enum StepTask { POSE = 0, CENTER = 1, POSTURE = 2 };
enum StepLimit { SPEED = 0, RANGE = 1 };  // in the order in which they narrow the box
enum StepStatus { SOLVED = 0, MAX_ITERATIONS = 1, INFEASIBLE = 2, NUMERICAL_ERROR = 3 };

// Sizes of a step; m, p, L and h are those of QPSizes and Sizes.
struct StepSizes {
  int scheme, leaves, nq, given, bodies, joints, dofs, nv, tasks, limits, rows, m, p, L, h, max_iterations;

  int labels() const {  // for the next warm start
    return scheme == WEIGHTED ? nv + p : scheme == HIERARCHICAL ? L * (h + m) : 0;
  }
};

// An array of numbers of one lane. A scalar is each entry of an array that it stands for.
struct Leaf {
  const double* at;
  int size;
  double operator[](int i) const { return at[size > 1 ? i : 0]; }
};

// What is given of one step, and what it returns.
struct StepData {
  const double* constants;        // factors of the configuration [nq] and of the dofs [dofs], largest number, tolerances
  const double* const* arrays;    // of this lane; a leaf of numbers is in one of them
  int count;                      // of the arrays; leaves of integers are behind them
  const int *guess, *guess_own;   // labels of the warm start, those of a hierarchy's levels beside them; null for none
};
struct StepResult {
  double* numbers;  // velocity [nv], residual, violation of the box, slacks and errors of all rows
  int* integers;    // status, iterations, factorizations, labels for the next warm start
};

// The point of [low, high] next to a; the upper end of an interval whose ends are the wrong way round.
inline double nearest(double a, double low, double high) {
  const double raised = a < low ? low : a;
  return raised > high ? high : raised;
}

inline double positive_root(double a) { return a > 0 ? sqrt(a) : 0; }
// The smaller one; NaN if one is.
inline double least(double a, double b) { return a != a || a < b ? a : b; }

// The Euclidean norm, whose squares neither overflow nor underflow.
inline double safe_norm(const double* v, int count) {
  double size = 0, squares = 0;
  for (int i = 0; i < count; ++i) size = larger(size, fabs(v[i]));
  if (!(size > 0 && size < INFINITE)) size = 1;
  for (int i = 0; i < count; ++i) squares += square(v[i] / size);
  return size * sqrt(squares);
}

// The rows and the box of a step at hand; the workspace and the layout are those of all steps.
class StepRows {
 protected:
  using Team = Serial<double>;
  using Numbers = std::vector<double>;
  struct Task {
    int kind, m, first, out, level, bounded, diagonal;  // out: of its slack and error; diagonal: equality of single dofs
    bool valid;
    const int *leaves, *options;                        // gain, weight, target velocity, bounds, then those of its kind
    Rows<double*> rows;
    double* weight;
  };
  struct Place {  // of a leaf
    int array, offset, size;
  };
  // the robot's leaves, in the order of the layout
  enum { OFFSET, REFERENCE, POSITION, QUATERNION, ANCHOR, AXIS, MASS, CENTER_OF_MASS, FRAME_POSITION, FRAME_ROTATION,
         ROBOT_LEAVES };
  StepSizes s;
  std::vector<int> layout;
  std::vector<Task> tasks;
  Tree<const double*> tree;
  DofColumns<const double*> columns;
  const Place* places;
  const int *of_step, *of_robot;                      // leaves: q, dt, damping, curvature damping, box, those of
                                                      // NullSpace: potential gain, margin, rank tolerance; the robot's
  const int *source, *owner, *turning, *scalar;       // [nq] entry of the given q, [dofs] body, [nv], [nv] place in q or -1
  const int *limits;                                  // [limits, 5] kind and leaves of each
  const int *row_counts, *level_of_hard, *row_of_hard;
  Numbers q, poses, J, error, low, high, weight, pull, levers, curvature, frames, below, bounds, parts, lower, upper, low_speed, high_speed, zeros;
  std::vector<int> no_labels;
  Placed<double*> placed;
  const double* const* arrays;  // of the step at hand
  const double* tolerances;
  double dt, damping, kappa;
  bool ordered;  // whether no lower bound is above its upper one

 public:
  StepRows(const int* given, int count) : layout(given, given + count) {
    const int* at = layout.data();
    auto take = [&](int n) { return (at += n) - n; };
    s = *reinterpret_cast<const StepSizes*>(take(sizeof(StepSizes) / sizeof(int)));
    const int R = s.rows, nv = s.nv;
    places = reinterpret_cast<const Place*>(take(3 * s.leaves));
    of_step = take(9), of_robot = take(ROBOT_LEAVES), limits = take(5 * s.limits);
    tree.bodies = s.bodies, tree.joints = s.joints, tree.dofs = s.dofs;
    tree.parents = take(s.bodies), tree.types = take(s.joints), tree.owners = take(s.joints), source = take(s.nq);
    columns = {s.dofs, nv, take(s.dofs), nullptr};
    owner = take(s.dofs), turning = take(nv), scalar = take(nv);
    row_counts = take(s.L), level_of_hard = take(s.h), row_of_hard = take(s.h > nv ? s.h - nv : 0);
    q.resize(s.nq), poses.resize(12 * s.bodies + 9 * s.dofs), J.resize(R * nv + 8), frames.resize(12 * nv + 24);
    for (Numbers* v : {&error, &low, &high, &weight, &pull}) v->resize(R + 8);
    levers.resize(s.tasks * nv), curvature.resize(s.tasks), below.resize(4 * s.bodies), zeros.resize(R + 1);
    bounds.resize(s.tasks), parts.resize(larger(R + 3 * s.tasks, s.bodies) + 8), lower.resize(nv), upper.resize(nv), low_speed.resize(nv), high_speed.resize(nv);
    no_labels.resize(s.labels());
    double *body = poses.data(), *dof = body + 12 * s.bodies;
    placed = {body, body + 3 * s.bodies, dof, dof + 3 * s.dofs, dof + 6 * s.dofs};
    for (int k = 0; k < s.tasks; ++k) {
      const int *o = take(8), *leaves = take(9);
      const size_t i = o[2];
      tasks.push_back({o[0], o[1], o[2], o[3], o[4], o[5], o[6], true, leaves, take(o[7]),
                       {&error[i], &J[i * nv], &low[i], &curvature[k], &pull[i], &levers[k * nv], o[5] ? &high[i] : nullptr},
                       &weight[i]});
    }
  }
  bool has(const int* given, int count) const {
    return size_t(count) == layout.size() && std::equal(given, given + count, layout.begin());
  }

 protected:
  Leaf leaf(int k) const { return {arrays[places[k].array] + places[k].offset, places[k].size}; }
  // the entries of a leaf, 0 where there is none
  const double* leaf_or_zeros(int k) const { return k < 0 ? zeros.data() : leaf(k).at; }
  static bool all_finite(const double* v, int count) {
    bool finite = true;
    for (int i = 0; i < count; ++i) finite &= fabs(v[i]) <= LARGEST_DOUBLE;
    return finite;
  }

  // Whether a number of these leaves is NaN.
  bool spoiled(int from, int to, int count) const {
    for (int k = from; k < to; ++k)
      for (int i = 0; i < leaf(k).size && places[k].array < count; ++i)
        if (leaf(k).at[i] != leaf(k).at[i]) return true;
    return false;
  }

  // ---- box, kinematics and rows of tasks; returns whether all numbers are valid
  bool find_rows(const StepData& d, bool clean) {
    arrays = d.arrays, ordered = true;
    auto robot = [&](int k) { return leaf(of_robot[k]).at; };
    const double *given = leaf(of_step[0]).at, *factor = d.constants, *offset = robot(OFFSET);
    dt = *leaf(of_step[1]).at, damping = *leaf(of_step[2]).at, kappa = *leaf(of_step[3]).at;
    tolerances = d.constants + s.nq + s.dofs + 1;
    if (!(dt > 0)) dt = NAN;
    const bool has_box = find_box(given), set_up = dt <= LARGEST_DOUBLE && (clean || !spoiled(of_step[2], of_step[1], d.count));
    bool valid = has_box && set_up && all_finite(given, s.given);
    if (!(dt <= LARGEST_DOUBLE)) dt = 1;
    const bool is_placed = all_finite(given, s.given) && (clean || !spoiled(0, of_step[0], d.count));
    if (is_placed) {
      for (int i = 0; i < s.nq; ++i) q[i] = factor[i] * given[source[i]] + offset[i];
      tree.reference = robot(REFERENCE), tree.position = robot(POSITION), tree.quaternion = robot(QUATERNION);
      tree.joint_position = robot(ANCHOR), tree.joint_axis = robot(AXIS), columns.factor = d.constants + s.nq;
      place_bodies(tree, q.data(), placed);
    }
    for (Task& task : tasks) {
      task.valid = is_placed;
      for (int i = 0; i < 9 && !clean; ++i)
        task.valid = task.valid && !(task.leaves[i] >= 0 && spoiled(task.leaves[i], task.leaves[i] + 1, d.count));
      if (task.valid) valid = add_task(task, given) && valid;
      valid = valid && task.valid;
    }
    return valid;
  }
  // A bound of the solver's: where they are the wrong way round, both are in the middle (solvers/_box.py).
  static double order(double low, double high, int side) { return low > high ? 0.5 * (low + high) : side < 0 ? low : high; }
  // limits/_box.py: of ConfigurationLimit and VelocityLimit, or as it is given. What depends on NaN is NaN. The classical
  // projection has no box, whatever its bounds are.
  bool find_box(const double* given) {
    const int nv = s.nv;
    for (int j = 0; j < nv; ++j) lower[j] = of_step[4] < 0 ? -INFINITE : leaf(of_step[4]).at[j];
    for (int j = 0; j < nv; ++j) upper[j] = of_step[4] < 0 ? INFINITE : leaf(of_step[5]).at[j];
    bool valid = true;
    for (int k = 0; k < s.limits; ++k) {
      const int* limit = limits + 5 * k;
      const bool of_speed = limit[0] == SPEED;
      const Leaf low = leaf(limit[1]), high = leaf(limit[2]), gain = leaf(limit[3]), speed = leaf(limit[4]);
      valid &= of_speed || all_finite(gain.at, gain.size);
      if (of_step[4] >= 0) continue;
      auto reach = [&](double bound, double at, double inward, int j) {  // rounded inward
        const double way = bound - at;
        return fabs(bound) < INFINITE ? gain[j] * (way + inward * RANGE_ROUNDOFF * EPSILON * fabs(way)) / dt : bound;
      };
      for (int j = 0; j < nv; ++j) {
        double a = -high[j], b = high[j];
        if (!of_speed) {
          const bool is_scalar = scalar[j] >= 0;
          double at = is_scalar ? given[scalar[j]] : 0.0;
          at = fabs(at) < INFINITE || at != at ? at : 1;
          a = reach(is_scalar ? low[j] : -INFINITE, at, 1, j), b = reach(is_scalar ? high[j] : INFINITE, at, -1, j);
          b = -least(-b, speed[j]), a = least(least(a, speed[j]), b);
        }
        const double first = lower[j], last = upper[j];
        auto narrowed = [&](double bound) { return first == first && bound == bound ? nearest(bound, first, last) : NAN; };
        lower[j] = narrowed(a), upper[j] = narrowed(b);
      }
    }
    for (int j = 0; j < nv; ++j) {
      if (s.scheme != CLASSICAL) valid &= lower[j] < INFINITE && upper[j] > -INFINITE, ordered &= lower[j] <= upper[j];
      low_speed[j] = order(lower[j], upper[j], -1), high_speed[j] = order(lower[j], upper[j], 1);
    }
    return valid;
  }
  // The rows of a task, and whether a solver takes them. Leaves of a task: gain, weight, target velocity (or none), bounds
  // (or none), then those of its kind.
  bool add_task(Task& task, const double* given) {
    const int m = task.m, nv = s.nv, *options = task.options, *leaves = task.leaves;
    const double own_gain = *leaf(leaves[0]).at, gain = own_gain > 1 / dt ? 1 / dt : own_gain;
    const Leaf weights = leaf(leaves[1]);
    const double* velocity = leaf_or_zeros(leaves[2]);
    Bounds<const double*> interval;
    bool takes = true;
    task.valid = fabs(own_gain) <= LARGEST_DOUBLE;
    if (task.bounded) {
      for (int i = 0; i < m; ++i) high[task.first + i] = -INFINITE;  // a polygon has upper bounds alone
      interval = {leaves[3] < 0 ? &high[task.first] : leaf(leaves[3]).at, leaf(leaves[4]).at};
      for (int i = 0; i < m; ++i) {
        const double a = interval.lower[i], b = interval.upper[i];
        takes &= a < INFINITE && b > -INFINITE;
      }
    }
    if (task.kind == POSE) {
      const double *position = leaf(leaves[5]).at, *rotation = leaf(leaves[6]).at;
      const int count = options[8];
      PoseGoal<const double*> goal{position, rotation, velocity, task.weight, &gain, options + 2, options[0] != 0, options[1] != 0};
      for (int i = 0, row = 0; i < 6; ++i)
        if (goal.kept[i]) task.weight[row] = weights[row] * leaf(leaves[7 + i / 3])[i % 3], ++row;
      task.valid &= all_finite(position, 3) && all_finite(rotation, 9) && all_finite(velocity, 6);
      for (int k : {7, 8}) task.valid &= all_finite(leaf(leaves[k]).at, leaf(leaves[k]).size);
      goal.bounds = interval;
      double *at = frames.data(), *turn = at + 6, *jacobian = at + 24;
      for (int f = 0; f < count; ++f) {
        const int* frame = options + 9 + f * (2 + s.dofs);  // number, carrier, whether each dof moves it
        move_frame(columns, placed, frame[1], leaf(of_robot[FRAME_POSITION]).at + 3 * frame[0],
                   leaf(of_robot[FRAME_ROTATION]).at + 9 * frame[0], frame + 2, at + 3 * f, turn + 9 * f,
                   jacobian + 6 * nv * f);
      }
      if (count == 2) see_from_root(at, turn, jacobian);
      if (task.valid) pose_rows(goal, at, turn, StoredColumns<const double*>{jacobian, nv}, nv, task.rows);
    } else if (task.kind == CENTER) {  // options: whether there is a polygon, axes, whether each body counts
      CenterGoal<const double*> goal{m, options + 1, turning, nullptr, velocity, task.weight, &gain};
      for (int i = 0; i < m; ++i) task.weight[i] = weights[i];
      if (options[0]) goal.normals = leaf(leaves[5]).at, takes &= all_finite(goal.normals, 2 * m);
      else if (!task.bounded) goal.target = leaf(leaves[5]).at, task.valid &= all_finite(goal.target, m);
      task.valid &= all_finite(velocity, m);
      goal.bounds = interval;
      const double* own = leaf(of_robot[MASS]).at;
      for (int b = 0; b < s.bodies; ++b) parts[b] = options[1 + m + b] ? own[b] : 0.0;
      move_center(columns, placed, s.bodies, tree.parents, owner, parts.data(), leaf(of_robot[CENTER_OF_MASS]).at,
                  below.data(), frames.data(), frames.data() + 3);
      if (task.valid) center_rows(goal, frames.data(), frames.data() + 3, nv, task.rows);
    } else {  // options: place in q and dof of each row
      const double* target = task.bounded ? nullptr : leaf(leaves[5]).at;
      task.valid &= (!target || all_finite(target, s.given)) && all_finite(velocity, m);
      *task.rows.curvature = 0;
      for (int j = 0; j < nv; ++j) task.rows.levers[j] = 0;
      for (int i = 0; i < m; ++i) {
        const double value = given[options[i]] - (target ? target[options[i]] : 0.0);
        task.weight[i] = weights[i];
        ask(task.rows, interval, i, value, velocity[i], gain);
        if (task.diagonal) continue;
        for (int j = 0; j < nv; ++j) task.rows.jacobian[i * nv + j] = j == options[m + i];
      }
    }
    for (int i = 0; i < m; ++i) {
      const bool counts = task.weight[i] > 0 || s.scheme != WEIGHTED;  // a row of weight 0 has no bounds
      task.valid &= fabs(task.weight[i]) <= LARGEST_DOUBLE;
      takes &= task.weight[i] >= 0 || counts || task.bounded || task.diagonal;
      if (task.bounded && counts && task.rows.lower[i] > task.rows.upper[i]) ordered = false;
    }
    takes = takes && (task.bounded || all_finite(task.rows.lower, m));
    return takes && (task.kind == POSTURE || all_finite(task.rows.jacobian, m * nv));
  }
  // the first frame's pose and Jacobian in the axes of the second (tasks/_relative_frame.py)
  void see_from_root(double* position, double* rotation, double* jacobian) {
    using V = Vec3<double>;
    const Mat3<double> turn = Mat3<double>::of(rotation + 9).transposed();
    const V apart = V::of(position) - V::of(position + 3);
    double* to = jacobian;
    for (const double *root = jacobian + 6 * s.nv; to < jacobian + s.nv; ++to, ++root) {
      auto entry = [&](const double* from, int i) { return V{from[i * s.nv], from[(i + 1) * s.nv], from[(i + 2) * s.nv]}; };
      const V angular = entry(root, 3), linear = turn * (entry(to, 0) - entry(root, 0) + cross(apart, angular));
      const V axis = turn * (entry(to, 3) - angular);
      int i = 0;
      for (double value : {linear.x, linear.y, linear.z, axis.x, axis.y, axis.z}) to[i++ * s.nv] = value;
    }
    (turn * apart).put(position), (turn * Mat3<double>::of(rotation)).put(rotation);
  }
};
}  // namespace osik
