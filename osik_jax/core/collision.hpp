// Shapes of a robot and of a scene: whether all pairs keep a distance, and which pair is the nearest.
//
// Shapes are numbered: those of the robot, then the rows of the scene. A pair is tried by its bounding spheres, then by
// the convex shapes themselves (convex_distance.hpp), so that no answer depends on how well spheres fit.
#pragma once
#include <algorithm>
#include <limits>
#include <vector>

#include "convex_distance.hpp"
#include "kinematic_calls.hpp"

namespace osik {

// A robot's tree and shapes, as collision/_core.py lays them out.
template <class Real> struct ShapedRobot {
  using In = const Real*;
  int bodies, joints, dofs, full, shapes, pairs, vertices, nv;
  const int *parents, *types, *owners, *source;          // [bodies], [joints] twice, [full]
  const int *moves, *group;  // [bodies] whether the search moves it; its rigid group, 0 if not
  const int *kind, *body, *first, *count, *world;  // [shapes] each
  const int *pair, *column;  // [pairs, 2]; [dofs] entry of the velocity that each dof adds to, -1 for none
  const int *first_next, *next;  // [vertices + 1]; Convex has the meaning
  In factor, offset, reference, position, quaternion, joint_position, joint_axis;
  In size, place, turn, center, bound, points;  // [shapes, 3] twice, [shapes, 9], centre [shapes, 3] and radius of
  // a sphere in the body's axes, [vertices, 3]
  In column_factor;  // [dofs]
  ShapedRobot(const int* integers, In numbers) {
    Reader<const int*> i{integers};
    bodies = *i.take(1), joints = *i.take(1), dofs = *i.take(1), full = *i.take(1);
    shapes = *i.take(1), pairs = *i.take(1), vertices = *i.take(1), nv = *i.take(1);
    parents = i.take(bodies), types = i.take(joints), owners = i.take(joints), source = i.take(full);
    moves = i.take(bodies), group = i.take(bodies), kind = i.take(shapes), body = i.take(shapes), first = i.take(shapes),
    count = i.take(shapes);
    world = i.take(shapes), pair = i.take(2 * pairs), column = i.take(dofs), first_next = i.take(vertices + 1);
    next = i.at;
    Reader<In> r{numbers};
    factor = r.take(full), offset = r.take(full), reference = r.take(full), position = r.take(3 * bodies);
    quaternion = r.take(4 * bodies), joint_position = r.take(3 * joints), joint_axis = r.take(3 * joints);
    size = r.take(3 * shapes), place = r.take(3 * shapes), turn = r.take(9 * shapes), center = r.take(3 * shapes);
    bound = r.take(shapes), points = r.take(3 * vertices), column_factor = r.take(dofs);
  }
  Tree<In> tree() const {
    return {bodies, joints, dofs, parents, types, owners, reference, position, quaternion, joint_position, joint_axis};
  }
};

// A scene, likewise: fields of ShapeTable, the body that carries each row (-1: none), contacts that are allowed.
template <class Real> struct SceneRows {
  int rows;
  const int *kind, *first, *count, *body;  // [rows] each
  const int *contacts, *among;  // [rows, shapes of the robot], [rows, rows] flags
  const Real *size, *place, *turn, *points;  // [rows, 3] twice, [rows, 9], [vertices, 3]
  SceneRows(const int* integers, const Real* numbers, int shapes) {
    Reader<const int*> i{integers};
    rows = *i.take(1), kind = i.take(rows), first = i.take(rows), count = i.take(rows), body = i.take(rows);
    contacts = i.take(rows * shapes), among = i.take(rows * rows);
    Reader<const Real*> r{numbers};
    size = r.take(3 * rows), place = r.take(3 * rows), turn = r.take(9 * rows), points = r.at;
  }
};

template <class Real> class Collision {
 public:
  struct Pair {
    int i, j;
  };

 private:
  using V = Vec3<Real>;
  using M = Mat3<Real>;
  using List = std::vector<Real>;
  static constexpr int HULL_PACK = 4;

  const ShapedRobot<Real>& robot;
  List turns, positions, unused, points;  // of bodies, [bodies, 9] and [bodies, 3]; [dofs, 9]; vertices of the scene
  std::vector<Convex<Real>> local, world;  // shapes in their bodies, and where they are
  std::vector<V> local_center, center;  // of their bounding spheres
  List bound;
  std::vector<int> carrier;  // body of each shape
  std::vector<Pair> pairs;  // those that are kept apart
  int fixed = 0;  // the first ones, whose distance no search changes

 public:
  struct Nearest {
    int i = -1, j = -1;
    Gap<Real> gap{std::numeric_limits<Real>::infinity(), {}, {}, {}};
  };

  explicit Collision(const ShapedRobot<Real>& robot)
      : robot(robot), turns(9 * robot.bodies), positions(3 * robot.bodies), unused(9 * robot.dofs) {
    for (int k = 0; k < robot.shapes; ++k)
      add(shape_of(robot, k), robot.body[k], V::of(robot.center + 3 * k), robot.bound[k]);
  }

  // Take a scene in place of the last one.
  void set(const SceneRows<Real>& scene) {
    resize(robot.shapes), pairs.clear(), points.clear();
    int needed = 0;
    for (int r = 0; r < scene.rows; ++r) needed += scene.kind[r] == HULL ? 3 * padded(scene.count[r]) : 0;
    points.reserve(needed);  // so that they stay where they are
    for (int r = 0; r < scene.rows; ++r) add_row(scene, r);
    for (int k = 0; k < robot.pairs; ++k) add_pair(robot.pair[2 * k], robot.pair[2 * k + 1]);
    for (int r = 0; r < scene.rows; ++r) {
      for (int k = 0; k < robot.shapes; ++k)
        if (robot.world[k] && !scene.contacts[r * robot.shapes + k]) add_pair(k, robot.shapes + r);
      for (int s = 0; s < scene.rows && scene.body[r] >= 0; ++s)
        if (scene.body[s] < 0 && !scene.among[r * scene.rows + s]) add_pair(robot.shapes + r, robot.shapes + s);
    }
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
      center[k] = turn * local_center[k] + at;
    }
  }
  // The first pair nearer than `least`, among those whose distance a search changes or the fixed ones; or none.
  Nearest nearer(Real least, bool is_moving) {
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
  Nearest nearest() const {
    Nearest best;
    for (const Pair p : pairs) {
      if (lower_bound(p) >= best.gap.distance) continue;
      const Gap<Real> gap = gap_of(p.i, p.j);
      if (!(gap.distance >= best.gap.distance)) best = {p.i, p.j, gap};
      if (gap.distance != gap.distance) break;
    }
    return best;
  }
  // Less than the distance of a pair; of half spaces, no bound.
  Real lower_bound(Pair p) const {
    if (local[p.i].kind == HALF_SPACE) return world[p.i].beyond(center[p.j], center[p.i], bound[p.i]) - bound[p.j];
    return std::max(world[p.j].beyond(center[p.i], center[p.j], bound[p.j]) - bound[p.i],
                    world[p.i].beyond(center[p.j], center[p.i], bound[p.i]) - bound[p.j]);
  }
  // Whether the bounding spheres of a pair are farther apart than `far`: the quickest test.
  bool is_out_of_reach(Pair p, Real far) const {
    const V way = center[p.j] - center[p.i];
    const Real reach = bound[p.i] + bound[p.j] + far;
    return inner(way, way) > reach * reach;
  }
  // f(number, shapes) of each pair whose distance changes
  template <class F> void each_moving_pair(F f) const {
    for (int k = fixed; k < int(pairs.size()); ++k) f(k, pairs[k]);
  }
  Pair pair(int number) const { return pairs[number]; }
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
  V own_center(int shape) const { return local_center[shape]; }  // of its bounding sphere, in its body's axes
  Real own_radius(int shape) const { return bound[shape]; }
  Gap<Real> gap_of(int i, int j) const { return gap_between(world[i], world[j]); }
  // Distance from a point to the farthest point of a shape, or more.
  Real reach(int shape, V from) const { return sqrt(inner(center[shape] - from, center[shape] - from)) + bound[shape]; }

 private:
  static Convex<Real> shape_of(const ShapedRobot<Real>& robot, int k) {
    const int* neighbours = robot.first_next + robot.first[k];
    const bool climbs = robot.count[k] && neighbours[1] > neighbours[0];
    return {robot.kind[k],
            robot.count[k],
            V::of(robot.size + 3 * k),
            V::of(robot.place + 3 * k),
            M::of(robot.turn + 9 * k),
            robot.points + 3 * robot.first[k],
            climbs ? neighbours : nullptr,
            robot.next};
  }
  static int padded(int count) { return (count + HULL_PACK - 1) / HULL_PACK * HULL_PACK; }
  void resize(int count) {
    local.resize(count), world.resize(count), local_center.resize(count), center.resize(count), bound.resize(count);
    carrier.resize(count);
  }
  void add(const Convex<Real>& shape, int body, V middle, Real radius) {
    local.push_back(shape), world.push_back(shape), local_center.push_back(middle), center.push_back(middle);
    bound.push_back(radius), carrier.push_back(body);
  }
  void add_pair(int i, int j) {
    const int first = local[i].kind, second = local[j].kind;
    if (first && second && !(first == HALF_SPACE && second == HALF_SPACE)) pairs.push_back({i, j});
  }
  void add_row(const SceneRows<Real>& scene, int r) {
    const int count = scene.kind[r] == HULL ? scene.count[r] : 0, wide = padded(count);
    const Real *from = scene.points + 3 * scene.first[r], *at = points.data() + points.size();
    for (int axis = 0; axis < 3; ++axis)
      for (int k = 0; k < wide; ++k) points.push_back(from[3 * std::min(k, count - 1) + axis]);
    const Convex<Real> shape{
        scene.kind[r], wide, V::of(scene.size + 3 * r), V::of(scene.place + 3 * r), M::of(scene.turn + 9 * r), at};
    V middle{0, 0, 0};
    for (int k = 0; k < count; ++k) middle = middle + Real(1) / count * shape.vertex(k);
    add(shape, scene.body[r], shape.rotation * middle + shape.position, radius_around(shape, middle));
  }
  static Real radius_around(const Convex<Real>& s, V middle) {
    if (s.kind == HALF_SPACE) return std::numeric_limits<Real>::infinity();
    if (s.kind == BOX) return sqrt(inner(s.size, s.size));
    if (s.kind == CYLINDER) return sqrt(s.size.x * s.size.x + s.size.y * s.size.y);
    if (s.kind != HULL) return s.size.x + (s.kind == CAPSULE ? s.size.y : 0);
    Real most = 0;
    for (int k = 0; k < s.count; ++k) most = std::max(most, inner(s.vertex(k) - middle, s.vertex(k) - middle));
    return sqrt(most) + s.size.x;
  }
};
}  // namespace osik
