// What collision.hpp does, by one thread of a GPU. It keeps the poses of bodies and spheres around shapes; the shapes
// themselves are placed anew for each pair whose spheres are near.
#pragma once
#include "shapes.hpp"

namespace osik {

template <class R> class LaneCollision {
 public:
  using Real = R;

 private:
  using V = Vec3<Real>;
  using M = Mat3<Real>;

  const ShapedRobot<Real>& robot;
  SceneRows<Real> scene;
  Real *positions, *turns, *unused;    // of bodies, [bodies, 3] and [bodies, 9]; [dofs, 9]
  Ball<Real>*ball, *row_ball;  // [shapes + rows]; [rows] in the carrying body

 public:
  static constexpr OSIK_HOST int space_of(int bodies, int dofs, int shapes, int rows) {
    return 12 * bodies + 9 * dofs + 4 * (shapes + 2 * rows);
  }
  LaneCollision(const ShapedRobot<Real>& robot, Real* space) : robot(robot) {
    Reader<Real*> next{space};
    positions = next.take(3 * robot.bodies), turns = next.take(9 * robot.bodies), unused = next.take(9 * robot.dofs);
    ball = reinterpret_cast<Ball<Real>*>(next.at);
  }

  // Take a scene in place of the last one.
  void set(const SceneRows<Real>& given) {
    scene = given, row_ball = ball + robot.shapes + scene.rows;
    for (int r = 0; r < scene.rows; ++r) row_ball[r] = ball_around(shape_of_row(scene, r));
  }
  int moves(int shape) const { return body(shape) < 0 ? 0 : robot.moves[body(shape)]; }
  int group(int shape) const { return body(shape) < 0 ? 0 : robot.group[body(shape)]; }

  // Place the shapes at a configuration [nq].
  OSIK_CALL void place(const Real* q) {
    place_bodies(robot.tree(), Configuration<const Real*>{q, robot.factor, robot.offset, robot.source},
                 Placed<Real*>{positions, turns, unused, unused + 3 * robot.dofs, unused + 6 * robot.dofs});
    place_balls();
  }
  // Place the shapes where the bodies are: [bodies, 3] and [bodies, 9].
  template <class In> void place(In body_positions, In body_turns) {
    for (int e = 0; e < 3 * robot.bodies; ++e) positions[e] = body_positions[e];
    for (int e = 0; e < 9 * robot.bodies; ++e) turns[e] = body_turns[e];
    place_balls();
  }
  void place_balls() {
    for (int k = 0; k < robot.shapes + scene.rows; ++k) {
      const Ball<Real> own = k < robot.shapes ? Ball<Real>{V::of(robot.center + 3 * k), robot.bound[k]}
                                              : row_ball[k - robot.shapes];
      const int carrier = body(k);
      ball[k] = carrier < 0 ? own : Ball<Real>{turn(carrier) * own.center + position(carrier), own.radius};
    }
  }
  // The first pair nearer than `least`, among those whose distance a search changes or the fixed ones; or none.
  OSIK_CALL Nearest<Real> nearer(Real least, bool is_moving) const {
    Nearest<Real> found;
    any_pair([&](int i, int j) {
      if ((group(i) != group(j)) != is_moving || keeps(i, j, least)) return false;
      found.i = i, found.j = j;
      return true;
    });
    return found;
  }
  // The nearest pair; one whose distance is NaN, if there is one.
  OSIK_CALL Nearest<Real> nearest() const {
    Nearest<Real> best;
    any_pair([&](int i, int j) {
      if (best.i >= 0 && ball[i].is_out_of_reach(ball[j], best.gap.distance > 0 ? best.gap.distance : Real(0))) return false;
      if (lower_bound({i, j}) >= best.gap.distance) return false;
      const Gap<Real> gap = gap_between(shape(i), shape(j), best.gap.distance);
      if (!(gap.distance >= best.gap.distance)) best = {i, j, gap};
      return gap.distance != gap.distance;
    });
    return best;
  }
  // f(pair, far) of a member's share of the pairs whose distance changes and is perhaps less than `far`; it returns what is
  // far from then on. Several members list theirs first, so that they find distances at the same time; where each robot has
  // one, those of a warp take the same pair at the same time.
  template <class F> void each_near_pair(Real far, int member, int members, Pair* list, F f) const {
    int number = 0, count = 0;
    auto take = [&](Pair p) {
      if (lower_bound(p) < far) far = f(p, far);
    };
    any_pair([&](int i, int j) {
      const bool is_own = number++ % members == member;
      if (!is_own || group(i) == group(j) || ball[i].is_out_of_reach(ball[j], far)) return false;
      if (members == 1) take({i, j});
      else list[count++] = {i, j};
      return false;
    });
    for (int k = 0; k < count; ++k) take(list[k]);
  }
  OSIK_CALL Real lower_bound(Pair p) const { return osik::lower_bound(shape(p.i), ball[p.i], shape(p.j), ball[p.j]); }
  template <class F> bool any_pair(F f) const { return any_pair_apart(robot, scene, f); }
  OSIK_CALL Gap<Real> gap_of(int i, int j) const { return gap_between(shape(i), shape(j)); }
  // Distance from a point to the farthest point of a shape, or more.
  Real reach(int shape, V from) const {
    const V way = ball[shape].center - from;
    return sqrt(inner(way, way)) + ball[shape].radius;
  }
  int body(int shape) const { return shape < robot.shapes ? robot.body[shape] : scene.body[shape - robot.shapes]; }
  OSIK_CALL Convex<Real> shape(int k) const {
    Convex<Real> to = k < robot.shapes ? shape_of(robot, k) : shape_of_row(scene, k - robot.shapes);
    const int carrier = body(k);
    if (carrier < 0) return to;
    const M turned = turn(carrier);
    to.rotation = turned * to.rotation, to.position = turned * to.position + position(carrier);
    return to;
  }

 private:
  M turn(int body) const { return M::of(turns + 9 * body); }
  V position(int body) const { return V::of(positions + 3 * body); }
  // Whether a pair is at least `least` >= 0 apart.
  OSIK_CALL bool keeps(int i, int j, Real least) const {
    if (ball[i].is_out_of_reach(ball[j], least)) return true;
    const Convex<Real> a = shape(i), b = shape(j);
    return osik::lower_bound(a, ball[i], b, ball[j]) >= least || is_apart(a, b, least);
  }
};
}  // namespace osik
