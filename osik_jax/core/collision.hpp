// Whether all pairs of shapes keep a distance, and which pair is the nearest, on a CPU (one on a GPU: lane_collision.hpp).
//
// A pair is tried by its bounding spheres, then by the convex shapes themselves (convex_distance.hpp), so that no answer
// depends on how well spheres fit.
#pragma once
#include <algorithm>
#include <utility>
#include <vector>

#include "shapes.hpp"

namespace osik {

template <class R> class Collision {
 public:
  using Real = R;

 private:
  using V = Vec3<Real>;
  using M = Mat3<Real>;
  using List = std::vector<Real>;
  static constexpr int HULL_PACK = 4;

  const ShapedRobot<Real>& robot;
  List turns, positions, unused, points;  // of bodies, [bodies, 9] and [bodies, 3]; [dofs, 9]; vertices of the scene
  std::vector<Convex<Real>> local, world;  // shapes in their bodies, and where they are
  std::vector<Ball<Real>> local_ball, ball;
  std::vector<int> carrier;  // body of each shape
  std::vector<Pair> pairs;  // those that are kept apart
  int fixed = 0;  // the first ones, whose distance no search changes
  std::vector<std::pair<Real, int>> candidates;  // lower bounds on distances, and numbers of pairs

 public:
  // The second argument is for collisions that work in memory of their caller.
  explicit Collision(const ShapedRobot<Real>& robot, Real* = nullptr)
      : robot(robot), turns(9 * robot.bodies), positions(3 * robot.bodies), unused(9 * robot.dofs) {
    for (int k = 0; k < robot.shapes; ++k)
      add(shape_of(robot, k), robot.body[k], {V::of(robot.center + 3 * k), robot.bound[k]});
  }

  // Take a scene in place of the last one.
  void set(const SceneRows<Real>& scene) {
    resize(robot.shapes), pairs.clear(), points.clear();
    int needed = 0;
    for (int r = 0; r < scene.rows; ++r) needed += scene.kind[r] == HULL ? 3 * padded(scene.count[r]) : 0;
    points.reserve(needed);  // so that they stay where they are
    for (int r = 0; r < scene.rows; ++r) add_row(scene, r);
    any_pair_apart(robot, scene, [&](int i, int j) {
      pairs.push_back({i, j});
      return false;
    });
    auto is_fixed = [&](Pair p) { return group(p.i) == group(p.j); };
    fixed = int(std::stable_partition(pairs.begin(), pairs.end(), is_fixed) - pairs.begin());
  }
  int moves(int shape) const { return carrier[shape] < 0 ? 0 : robot.moves[carrier[shape]]; }
  int group(int shape) const { return carrier[shape] < 0 ? 0 : robot.group[carrier[shape]]; }

  // Place the shapes at a configuration [nq].
  void place(const Real* q) {
    place_bodies(robot.tree(), Configuration<const Real*>{q, robot.factor, robot.offset, robot.source},
                 Placed<Real*>{positions.data(), turns.data(), unused.data(), unused.data() + 3 * robot.dofs,
                               unused.data() + 6 * robot.dofs});
    place(positions.data(), turns.data());
  }
  // Place the shapes where the bodies are: [bodies, 3] and [bodies, 9].
  void place(const Real* body_positions, const Real* body_turns) {
    for (size_t k = 0; k < local.size(); ++k) {
      if (carrier[k] < 0) continue;
      const M turn = M::of(body_turns + 9 * carrier[k]);
      const V at = V::of(body_positions + 3 * carrier[k]);
      world[k].rotation = turn * local[k].rotation, world[k].position = turn * local[k].position + at;
      ball[k].center = turn * local_ball[k].center + at;
    }
  }
  // The first pair nearer than `least`, among those whose distance a search changes or the fixed ones; or none.
  Nearest<Real> nearer(Real least, bool is_moving) {
    const int start = is_moving ? fixed : 0, end = is_moving ? int(pairs.size()) : fixed;
    for (int k = start; k < end; ++k) {
      const Pair p = pairs[k];
      if (keeps(p.i, p.j, least)) continue;
      std::rotate(pairs.begin() + start, pairs.begin() + k, pairs.begin() + k + 1);  // first the next time
      return {p.i, p.j, {}};
    }
    return {};
  }
  // The nearest pair; one whose distance is NaN, if there is one.
  Nearest<Real> nearest() const {
    Nearest<Real> best;
    for (const Pair p : pairs) {
      if (lower_bound(p) >= best.gap.distance) continue;
      const Gap<Real> gap = gap_of(p.i, p.j);
      if (!(gap.distance >= best.gap.distance)) best = {p.i, p.j, gap};
      if (gap.distance != gap.distance) break;
    }
    return best;
  }
  // Less than the distance of a pair; of half spaces, no bound.
  Real lower_bound(Pair p) const { return osik::lower_bound(world[p.i], ball[p.i], world[p.j], ball[p.j]); }
  // f(pair, far) of the pairs whose distance changes and is perhaps less than `far`, the likely nearest first; it returns
  // what is far from then on. One thread takes all pairs.
  template <class F> void each_near_pair(Real far, int, int, Pair*, F f) {
    candidates.clear();
    for (int k = fixed; k < int(pairs.size()); ++k) {
      if (ball[pairs[k].i].is_out_of_reach(ball[pairs[k].j], far)) continue;
      const Real bound = lower_bound(pairs[k]);
      if (bound < far) candidates.push_back({bound, k});
    }
    std::sort(candidates.begin(), candidates.end());
    for (const auto& [bound, k] : candidates) {
      if (bound >= far) return;
      far = f(pairs[k], far);
    }
  }
  int body(int shape) const { return carrier[shape]; }
  const Convex<Real>& shape(int number) const { return world[number]; }
  template <class F> bool any_pair(F f) const {
    for (const Pair p : pairs)
      if (f(p.i, p.j)) return true;
    return false;
  }
  // Whether a pair is at least `least` >= 0 apart.
  bool keeps(int i, int j, Real least) const { return lower_bound({i, j}) >= least || is_apart(world[i], world[j], least); }
  int carrier_of(int shape) const { return carrier[shape]; }
  const Ball<Real>& own_ball(int shape) const { return local_ball[shape]; }  // in its body's axes
  Gap<Real> gap_of(int i, int j) const { return gap_between(world[i], world[j]); }
  // Distance from a point to the farthest point of a shape, or more.
  Real reach(int shape, V from) const {
    const V way = ball[shape].center - from;
    return sqrt(inner(way, way)) + ball[shape].radius;
  }

 private:
  static int padded(int count) { return (count + HULL_PACK - 1) / HULL_PACK * HULL_PACK; }
  void resize(int count) {
    local.resize(count), world.resize(count), local_ball.resize(count), ball.resize(count), carrier.resize(count);
  }
  void add(const Convex<Real>& shape, int body, const Ball<Real>& around) {
    local.push_back(shape), world.push_back(shape), local_ball.push_back(around), ball.push_back(around);
    carrier.push_back(body);
  }
  // Add a row with a copy of its vertices, of which the last one is repeated, in the order that the compiler's vectors want.
  void add_row(const SceneRows<Real>& scene, int r) {
    Convex<Real> shape = shape_of_row(scene, r);
    const Ball<Real> around = ball_around(shape);
    const int count = shape.count, wide = padded(count);
    const Real *from = shape.vertices, *at = points.data() + points.size();
    for (int axis = 0; axis < 3; ++axis)
      for (int k = 0; k < wide; ++k) points.push_back(from[3 * std::min(k, count - 1) + axis]);
    shape.vertices = at, shape.count = wide, shape.apart = 1, shape.axes = 0;
    add(shape, scene.body[r], around);
  }
};
}  // namespace osik
