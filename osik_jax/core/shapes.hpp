// Shapes of a robot and of a scene. They are numbered: those of the robot, then the rows of the scene.
#pragma once
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
  SceneRows() = default;
  SceneRows(const int* integers, const Real* numbers, int shapes) {
    Reader<const int*> i{integers};
    rows = *i.take(1), kind = i.take(rows), first = i.take(rows), count = i.take(rows), body = i.take(rows);
    contacts = i.take(rows * shapes), among = i.take(rows * rows);
    Reader<const Real*> r{numbers};
    size = r.take(3 * rows), place = r.take(3 * rows), turn = r.take(9 * rows), points = r.at;
  }
};

// A pair of shapes, and of the nearest one its gap; -1: there is none.
struct Pair {
  int i, j;
};
template <class Real> struct Nearest {
  int i = -1, j = -1;
  Gap<Real> gap{Real(INFINITE), {}, {}, {}};
};

// Write distance, points and normal [10].
template <class Real, class Out> void put(const Gap<Real>& gap, Out to) {
  to[0] = gap.distance, gap.on_a.put(to + 1), gap.on_b.put(to + 4), gap.normal.put(to + 7);
}

// A sphere around a shape.
template <class Real> struct Ball {
  Vec3<Real> center;
  Real radius;
  // Whether two are farther apart than `far`: the quickest test.
  bool is_out_of_reach(const Ball& other, Real far) const {
    const Vec3<Real> way = other.center - center;
    const Real reach = radius + other.radius + far;
    return inner(way, way) > reach * reach;
  }
};

// Less than the distance of two shapes with spheres around them; of half spaces, no bound.
template <class Real>
Real lower_bound(const Convex<Real>& a, const Ball<Real>& on_a, const Convex<Real>& b, const Ball<Real>& on_b) {
  const Real from_a = a.beyond(on_b.center, on_a.center, on_a.radius) - on_b.radius;
  if (a.kind == HALF_SPACE) return from_a;
  const Real from_b = b.beyond(on_a.center, on_b.center, on_b.radius) - on_a.radius;
  return from_a > from_b ? from_a : from_b;
}

// Shape k of the robot, in its body.
template <class Real> Convex<Real> shape_of(const ShapedRobot<Real>& robot, int k) {
  const int* neighbours = robot.first_next + robot.first[k];
  const bool climbs = robot.count[k] && neighbours[1] > neighbours[0];
  return {robot.kind[k],
          robot.count[k],
          Vec3<Real>::of(robot.size + 3 * k),
          Vec3<Real>::of(robot.place + 3 * k),
          Mat3<Real>::of(robot.turn + 9 * k),
          robot.points + 3 * robot.first[k],
          climbs ? neighbours : nullptr,
          robot.next};
}

// Row r of a scene, in the world or in the body that carries it. A hull's vertices are where the scene has them.
template <class Real> Convex<Real> shape_of_row(const SceneRows<Real>& scene, int r) {
  Convex<Real> shape{scene.kind[r],
                     scene.kind[r] == HULL ? scene.count[r] : 0,
                     Vec3<Real>::of(scene.size + 3 * r),
                     Vec3<Real>::of(scene.place + 3 * r),
                     Mat3<Real>::of(scene.turn + 9 * r),
                     scene.points + 3 * scene.first[r]};
  shape.apart = 3, shape.axes = 1;
  return shape;
}

// A sphere around a shape.
template <class Real> Ball<Real> ball_around(const Convex<Real>& s) {
  if (s.kind == HALF_SPACE) return {s.position, Real(INFINITE)};
  if (s.kind == BOX) return {s.position, sqrt(inner(s.size, s.size))};
  if (s.kind == CYLINDER) return {s.position, sqrt(s.size.x * s.size.x + s.size.y * s.size.y)};
  if (s.kind != HULL) return {s.position, s.size.x + (s.kind == CAPSULE ? s.size.y : Real(0))};
  Vec3<Real> middle{0, 0, 0};
  for (int k = 0; k < s.count; ++k) middle = middle + Real(1) / s.count * s.vertex(k);
  Real most = 0;
  for (int k = 0; k < s.count; ++k) {
    const Vec3<Real> out = s.vertex(k) - middle;
    most = inner(out, out) > most ? inner(out, out) : most;
  }
  return {s.rotation * middle + s.position, sqrt(most) + s.size.x};
}

// Whether shapes of these kinds have a distance.
OSIK_FN bool have_distance(int kind, int other) {
  return kind != ABSENT && other != ABSENT && !(kind == HALF_SPACE && other == HALF_SPACE);
}

// f(i, j) of all pairs that are kept apart, until it is true; whether it was.
template <class Real, class F> bool any_pair_apart(const ShapedRobot<Real>& robot, const SceneRows<Real>& scene, F f) {
  for (int k = 0; k < robot.pairs; ++k) {
    const int i = robot.pair[2 * k], j = robot.pair[2 * k + 1];
    if (have_distance(robot.kind[i], robot.kind[j]) && f(i, j)) return true;
  }
  for (int r = 0; r < scene.rows; ++r) {
    if (scene.kind[r] == ABSENT) continue;
    for (int k = 0; k < robot.shapes; ++k)
      if (robot.world[k] && !scene.contacts[r * robot.shapes + k] && have_distance(robot.kind[k], scene.kind[r]) &&
          f(k, robot.shapes + r))
        return true;
    for (int s = 0; s < scene.rows && scene.body[r] >= 0; ++s)
      if (scene.body[s] < 0 && !scene.among[r * scene.rows + s] && have_distance(scene.kind[r], scene.kind[s]) &&
          f(robot.shapes + r, robot.shapes + s))
        return true;
  }
  return false;
}
}  // namespace osik
