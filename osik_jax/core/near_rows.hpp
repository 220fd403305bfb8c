// Rows that keep the nearest pairs of shapes apart: collision/_near_rows.py.
//
//   bodies -> lower bounds on the distances of all pairs -> the nearest pairs, exactly -> their Jacobians and bounds
//
// On a GPU the members of a group (chain_group.hpp) share the pairs of a robot: each keeps the nearest of its own, which then
// get their places among those of all. Of pairs at the same distance, any may have the last row.
#pragma once
#include "freedom.hpp"

namespace osik {

// A group of one thread, as of a CPU.
struct Alone {
  static constexpr int members = 1;
  static int member() { return 0; }
  template <class T> static T of_member(int, T number) { return number; }
};

// Numbers of the limit: least distance, distance from which a pair is free [m], gain [1/s], recovery speed [m/s], time of
// the step [s].
template <class Real> struct AvoidanceNumbers {
  Real least, detection, gain, recovery, dt;
};

// How many pairs each of some threads can have.
constexpr OSIK_HOST int most_pairs(int shapes, int rows, int members) {
  return (shapes * (shapes - 1) / 2 + rows * (shapes + rows) + members - 1) / members;
}

// Collision: collision.hpp, or on a GPU lane_collision.hpp.
template <class Collision> class NearRows {
  using Real = typename Collision::Real;
  using V = Vec3<Real>;

  struct Near {
    int i, j, row;
    Gap<Real> gap;
  };
  const ShapedRobot<Real>& robot;
  Collision collision;
  Near* near;  // [most] the nearest pairs of this thread, sorted
  Pair* list;  // of a GPU: pairs whose distances are looked for
  int most, count = 0, first_free = 0, stride = 1;

 public:
  // space: space_of numbers, then those of the collision. share: pairs that a thread can have
  NearRows(const ShapedRobot<Real>& robot, int most, int share, bool lists, Real* space)
      : robot(robot), collision(robot, space + space_of(most, share, lists)), near(reinterpret_cast<Near*>(space)),
        list(reinterpret_cast<Pair*>(space + space_of(most, share, false))), most(most) {}
  static constexpr OSIK_HOST int space_of(int most, int share, bool lists) {
    return (most < share ? most : share) * int(sizeof(Near) / sizeof(Real)) +
           (lists ? share : 0) * int(sizeof(Pair) / sizeof(float));
  }
  void set(const SceneRows<Real>& scene) { collision.set(scene); }

  // Write the rows of the nearest pairs: J [most, nv], lower bounds and distances [most], and the bodies of the two shapes
  // and their numbers [most, 4], -1 for no pair. Rows of no pair are zeros without bounds. group: the words member(),
  // members and of_member of a call; is_real: whether it has a robot
  template <class Group, class In, class Out, class Labels>
  void find(const Group& group, bool is_real, const Placed<In>& placed, const AvoidanceNumbers<Real>& limit, Out J,
            Out lower, Out distance, Labels pair) {
    collision.place(placed.position, placed.rotation);
    find_nearest(limit.detection, group.member(), group.members);
    const Real gain = limit.gain * limit.dt > 1 ? 1 / limit.dt : limit.gain;
    first_free = take_places(group) + group.member(), stride = group.members;
    if (!is_real) count = 0, first_free = most;  // others write these rows
    each_free_row([&](int row) {
      for (int e = 0; e < robot.nv; ++e) J[row * robot.nv + e] = 0;
      for (int e = 0; e < 4; ++e) pair[4 * row + e] = -1;
      distance[row] = Real(INFINITE), lower[row] = -Real(INFINITE);
    });
    for (int k = 0; k < count; ++k) {
      const auto& [i, j, row, gap] = near[k];
      const int labels[] = {collision.body(i), collision.body(j), i, j};
      for (int e = 0; e < robot.nv; ++e) J[row * robot.nv + e] = 0;
      for (int e = 0; e < 4; ++e) pair[4 * row + e] = labels[e];
      const Real rate = -gain * (gap.distance - limit.least);
      distance[row] = gap.distance, lower[row] = rate < limit.recovery ? rate : limit.recovery;
      add_motion(placed, labels[0], gap.on_a, -1, gap.normal, J + row * robot.nv);
      add_motion(placed, labels[1], gap.on_b, 1, gap.normal, J + row * robot.nv);
    }
  }
  // f(row) of the rows of no pair that are this thread's to write, and f(k, row) of its pairs.
  template <class F> void each_free_row(F f) const {
    for (int row = first_free; row < most; row += stride) f(row);
  }
  template <class F> void each_row(F f) const {
    for (int k = 0; k < count; ++k) f(k, near[k].row);
  }
  // Write what the derivatives of pair k are made of: four points of each shape's core [2, 4, 3], normal [3], radii [2], and
  // the shape that the normal goes along with, 0 or 1; -1: it is that of the points.
  template <class Out> int put_geometry(int k, Out to) const {
    const auto& [i, j, row, gap] = near[k];
    const Convex<Real> a = collision.shape(i), b = collision.shape(j);
    V points[8];
    Real radius[] = {0, 0};
    for (int p = 0; p < 8; ++p) points[p] = p < 4 ? gap.on_a : gap.on_b;
    const bool is_deep = gap.distance <= -a.radius() - b.radius();
    const int carried = b.kind == HALF_SPACE ? 1 : a.kind == HALF_SPACE || is_deep ? 0 : -1;
    if (carried < 0) {
      Difference<Real> difference(a, b);
      difference.gap(), difference.put_points(points, points + 4);
      radius[0] = settle(a, gap.normal, gap.on_a, points);
      radius[1] = settle(b, V{0, 0, 0} - gap.normal, gap.on_b, points + 4);
    }
    for (int p = 0; p < 8; ++p) points[p].put(to + 3 * p);
    gap.normal.put(to + 24), to[27] = radius[0], to[28] = radius[1];
    return carried;
  }

 private:
  // The nearest of this thread's pairs that are not farther than `detection`, exact and sorted.
  OSIK_CALL void find_nearest(Real detection, int member, int members) {
    count = 0;
    collision.each_near_pair(detection, member, members, list, [&](Pair p, Real far) {
      const Gap<Real> gap = gap_between<Real>(collision.shape(p.i), collision.shape(p.j), far);
      if (!(gap.distance < far)) return far;
      int k = count < most ? count++ : most - 1;
      for (; k > 0 && near[k - 1].gap.distance > gap.distance; --k) near[k] = near[k - 1];
      near[k] = {p.i, p.j, 0, gap};
      return count < most ? far : near[most - 1].gap.distance;
    });
  }
  // Keep those of the pairs that are among the nearest of the group, each with its row; how many rows there are.
  template <class Group> int take_places(const Group& group) {
    int own = 0, row = 0;
    for (int chosen = 0; row < most && chosen >= 0; row += chosen >= 0) {
      const Real head = own < count ? near[own].gap.distance : Real(INFINITE);
      Real least = Real(INFINITE);
      chosen = -1;
      for (int k = 0; k < group.members; ++k) {
        const Real its = group.of_member(k, head);
        if (its < least) least = its, chosen = k;
      }
      if (chosen == group.member()) near[own++].row = row;
    }
    count = own;
    return row;
  }
  // Add `sign` times the speed along the normal of a point that goes along with a body.
  template <class In, class Out>
  void add_motion(const Placed<In>& placed, int body, V at, Real sign, V normal, Out row) const {
    for (int joint = robot.joints, dof = robot.dofs; joint--;) {
      const int type = robot.types[joint], first = dof - (type == FREE_JOINT ? 6 : type == BALL_JOINT ? 3 : 1);
      while (body > robot.owners[joint]) body = robot.parents[body];
      while (dof-- > first)
        if (body == robot.owners[joint] && robot.column[dof] >= 0)
          row[robot.column[dof]] += sign * inner(normal, motion_of(placed, dof, at, robot.column_factor[dof]).linear);
      dof = first;
    }
  }
  // The radius of a shape's core. A cylinder's is that of its axis where its side is met. On its rim the points of its core
  // are one, which leaves out that the nearest point slides along the rim. out: towards the other shape; at: nearest point
  static Real settle(const Convex<Real>& shape, V out, V at, V* points) {
    constexpr Real PERPENDICULAR = 1e-5, PARALLEL_AXIS = 1 - (sizeof(Real) == 8 ? 1e-9 : 1e-6);  // cosine of normal and axis
    const Real cosine = fabs(inner(shape.axis(), out));
    if (shape.kind != CYLINDER || cosine > PARALLEL_AXIS) return shape.radius();
    for (int k = 0; k < 4; ++k)
      points[k] = cosine > PERPENDICULAR ? at : shape.position + (k % 2 ? shape.size.y : -shape.size.y) * shape.axis();
    return cosine > PERPENDICULAR ? Real(0) : shape.size.x;
  }
};

// Arguments: the fields of Kinematics, the robot's integers and numbers, a scene, numbers of the limit [5]; on a GPU also the
// number of members. Results: those of NearRows::find; with_geometry: then those of put_geometry [most, 29] and [most].
template <bool with_geometry, class Call> void find_near_pairs(const Call& call) {
  using Real = typename Call::Real;
  const ShapedRobot<Real> robot(call.integers(5), call.numbers(6, 0));
  const int most = call.result_size(0, 1);
  auto space = call.space();
  const int share = most_pairs(robot.shapes, scene_of(call, 7, robot.shapes, 0).rows, call.members);
  NearRows<typename Call::Collision> rows(robot, most, share, call.members > 1, space.data());
  bool is_set = false;
  call.each_group([&](int lane, bool is_real) {
    if (!is_set || has_many_scenes(call, 7)) rows.set(scene_of(call, 7, robot.shapes, lane)), is_set = true;
    const auto n = call.in(9, lane);
    rows.find(call, is_real, placed(call, lane), AvoidanceNumbers<Real>{n[0], n[1], n[2], n[3], n[4]}, call.out(0, lane),
              call.out(1, lane), call.out(2, lane), call.labels(3, lane));
    if constexpr (with_geometry) {
      const auto geometry = call.out(4, lane);
      const auto carried = call.labels(5, lane);
      rows.each_row([&](int k, int row) { carried[row] = rows.put_geometry(k, geometry + 29 * row); });
      rows.each_free_row([&](int row) {
        for (int e = 0; e < 29; ++e) geometry[29 * row + e] = 0;
        carried[row] = 0;
      });
    }
  });
}
template <class Call> void find_near_rows(const Call& call) { find_near_pairs<false>(call); }
template <class Call> void find_near_geometry(const Call& call) { find_near_pairs<true>(call); }
}  // namespace osik
