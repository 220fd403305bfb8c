// Rows that keep the nearest pairs of shapes apart: collision/_near_rows.py.
//
//   bodies -> lower bounds on the distances of all pairs -> the nearest pairs, exactly -> their Jacobians and bounds
#pragma once
#include <algorithm>
#include <vector>

#include "collision.hpp"
#include "freedom.hpp"
#include "xla.hpp"

namespace osik {

// Numbers of the limit: least distance, distance from which a pair is free [m], gain [1/s], recovery speed [m/s], time of
// the step [s].
struct AvoidanceNumbers {
  double least, detection, gain, recovery, dt;
};

class NearRows {
  using V = Vec3<double>;
  struct Candidate {
    double distance;  // or a lower bound on it
    int number;       // of the pair
    bool operator<(const Candidate& other) const { return distance < other.distance; }
  };
  struct Found : Candidate {
    Gap<double> gap;
  };

  const ShapedRobot<double>& robot;
  Collision<double> collision;
  std::vector<Candidate> candidates;  // by lower bounds
  std::vector<Found> near;            // a heap of the nearest pairs, and at the end sorted
  std::vector<int> owner;               // [dofs] body of each
  std::vector<char> is_moved;           // [bodies] whether a dof of the body moves the shape at hand

 public:
  explicit NearRows(const ShapedRobot<double>& robot) : robot(robot), collision(robot), is_moved(robot.bodies) {
    for (int j = 0; j < robot.joints; ++j) {
      const int type = robot.types[j], count = type == FREE_JOINT ? 6 : type == BALL_JOINT ? 3 : 1;
      owner.insert(owner.end(), count, robot.owners[j]);
    }
  }
  void set(const SceneRows<double>& scene) { collision.set(scene); }

  // Write the rows of the `most` nearest pairs: J [most, nv], lower bounds and distances [most], and the bodies of the two
  // shapes and their numbers [most, 4], -1 for no pair. Rows of no pair are zeros without bounds.
  void find(const Placed<const double*>& placed, const AvoidanceNumbers& limit, int most, double* J, double* lower,
            double* distance, int* pair) {
    collision.place(placed.position, placed.rotation);
    find_nearest(limit.detection, most);
    std::fill_n(J, most * robot.nv, 0.0), std::fill_n(lower, most, -INFINITE), std::fill_n(distance, most, INFINITE);
    std::fill_n(pair, 4 * most, -1);
    const double gain = limit.gain * limit.dt > 1 ? 1 / limit.dt : limit.gain;
    for (size_t k = 0; k < near.size(); ++k) {
      const auto [i, j] = collision.pair(near[k].number);
      const Gap<double>& gap = near[k].gap;
      const int bodies[] = {collision.body(i), collision.body(j)};
      add_motion(placed, bodies[0], gap.on_a, -1, gap.normal, J + k * robot.nv);
      add_motion(placed, bodies[1], gap.on_b, 1, gap.normal, J + k * robot.nv);
      distance[k] = gap.distance, lower[k] = std::min(-gain * (gap.distance - limit.least), limit.recovery);
      pair[4 * k] = bodies[0], pair[4 * k + 1] = bodies[1], pair[4 * k + 2] = i, pair[4 * k + 3] = j;
    }
  }
  // Write what the derivatives of pair k are made of: four points of each shape's core [2, 4, 3], normal [3], radii [2], and
  // the shape that the normal goes along with, 0 or 1; -1: it is that of the points.
  void put_geometry(int k, double* to, int& carried) const {
    const auto [i, j] = collision.pair(near[k].number);
    const Convex<double>&a = collision.shape(i), &b = collision.shape(j);
    const Gap<double>& gap = near[k].gap;
    V points[8];
    double radius[] = {0, 0};
    std::fill_n(points, 4, gap.on_a), std::fill_n(points + 4, 4, gap.on_b);
    carried = b.kind == HALF_SPACE ? 1 : a.kind == HALF_SPACE || gap.distance <= -a.radius() - b.radius() ? 0 : -1;
    if (carried < 0) {
      Difference<double> difference(a, b);
      difference.gap(), difference.put_points(points, points + 4);
      radius[0] = settle(a, gap.normal, gap.on_a, points);
      radius[1] = settle(b, V{0, 0, 0} - gap.normal, gap.on_b, points + 4);
    }
    for (int p = 0; p < 8; ++p) points[p].put(to + 3 * p);
    gap.normal.put(to + 24), to[27] = radius[0], to[28] = radius[1];
  }
  int count() const { return int(near.size()); }

 private:
  // The nearest pairs that are not farther than `detection`, exact and sorted.
  void find_nearest(double detection, size_t most) {
    candidates.clear(), near.clear();
    collision.each_moving_pair([&](int number, Pair p) {
      if (collision.is_out_of_reach(p, detection)) return;
      const double bound = collision.lower_bound(p);
      if (bound < detection) candidates.push_back({bound, number});
    });
    std::sort(candidates.begin(), candidates.end());
    for (const Candidate& one : candidates) {
      const double limit = near.size() < most ? detection : near[0].distance;
      if (one.distance >= limit) break;
      const auto [i, j] = collision.pair(one.number);
      const Gap<double> gap = gap_between(collision.shape(i), collision.shape(j), limit);
      if (!(gap.distance < limit)) continue;
      if (near.size() == most) std::pop_heap(near.begin(), near.end()), near.pop_back();
      near.push_back({{gap.distance, one.number}, gap}), std::push_heap(near.begin(), near.end());
    }
    std::sort_heap(near.begin(), near.end());
  }
  // Add `sign` times the speed along the normal of a point that goes along with a body.
  void add_motion(const Placed<const double*>& placed, int body, V at, double sign, V normal, double* row) {
    std::fill(is_moved.begin(), is_moved.end(), 0);
    for (int b = body; b > 0; b = robot.parents[b]) is_moved[b] = 1;
    for (int dof = 0; dof < robot.dofs; ++dof)
      if (robot.column[dof] >= 0 && is_moved[owner[dof]])
        row[robot.column[dof]] += sign * inner(normal, motion_of(placed, dof, at, robot.column_factor[dof]).linear);
  }
  // The radius of a shape's core. A cylinder's is that of its axis where its side is met. On its rim the points of its core
  // are one, which leaves out that the nearest point slides along the rim. out: towards the other shape; at: nearest point
  static double settle(const Convex<double>& shape, V out, V at, V* points) {
    constexpr double PERPENDICULAR = 1e-5, PARALLEL_AXIS = 1 - 1e-9;  // cosine of normal and axis
    const double cosine = fabs(inner(shape.axis(), out));
    if (shape.kind != CYLINDER || cosine > PARALLEL_AXIS) return shape.radius();
    if (cosine > PERPENDICULAR) {
      std::fill_n(points, 4, at);
      return 0;
    }
    for (int k = 0; k < 4; ++k) points[k] = shape.position + (k % 2 ? shape.size.y : -shape.size.y) * shape.axis();
    return shape.size.x;
  }
};

// Arguments: the fields of Kinematics, the robot's integers and numbers, a scene, numbers of the limit [5]. Results: those
// of NearRows::find; then, if they are asked for, those of put_geometry [most, 29] and [most].
inline void find_near_rows(const xla::Batch& call) {
  const ShapedRobot<double> robot(call.integers(5), call.in(6, 0));
  NearRows rows(robot);
  const int lanes = call.result_size(0, 0), most = call.result_size(0, 1);
  for (int lane = 0; lane < lanes; ++lane) {
    if (lane == 0 || has_many_scenes(call, 7)) rows.set(scene_of(call, 7, robot.shapes, lane));
    auto in = [&](int k) { return call.in(k, lane); };
    auto out = [&](int k) { return call.out(k, lane); };
    rows.find({in(0), in(1), in(2), in(3), in(4)}, *reinterpret_cast<const AvoidanceNumbers*>(in(9)), most, out(0), out(1),
              out(2), call.labels(3, lane));
    if (call.call.frame->results.size <= 4) continue;
    int* carried = call.labels(5, lane);
    std::fill_n(out(4), 29 * most, 0.0), std::fill_n(carried, most, 0);
    for (int k = 0; k < rows.count(); ++k) rows.put_geometry(k, out(4) + 29 * k, carried[k]);
  }
}
}  // namespace osik
