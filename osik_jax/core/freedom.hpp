// Whether solutions of a search are free, and which of them are the least wrong. Arguments and results as in
// collision/_core.py.
#pragma once
#include "shapes.hpp"

namespace osik {

// The scene of a lane: argument `k` has integers, `k + 1` numbers, each with a row for each scene or one for all.
template <class Call> bool has_many_scenes(const Call& call, int k) {
  return call.size(k, 0) > 1 || call.size(k + 1, 0) > 1;
}
template <class Call> SceneRows<typename Call::Real> scene_of(const Call& call, int k, int shapes, int lane) {
  return {call.integers(k, lane), call.numbers(k + 1, lane), shapes};
}

template <class Call> class Freedom {
  using Real = typename Call::Real;
  static constexpr Real MORE = sizeof(Real) == 8 ? TOUCH : SINGLE_TOUCH;
  static constexpr int MOST = 32;  // rejected solutions that are kept
  enum Reason { NONE, HELD_SHAPES, AROUND_TARGET, EVERY_SOLUTION };

  typename Call::Collision collision;
  const ShapedRobot<Real>& robot;
  const int n, *entry;  // coordinates of the search, and the entries of q that they are [n]
  Real clearance = 0;
  int row = -1;  // of the scene that is taken
  Real *q, *kept;  // [nq] of the caller; [MOST, n] rejected solutions
  int seeds[MOST], rejected = 0;
  Nearest<Real> fixed, around;  // pairs that touch whatever the search does

 public:
  bool is_blocked = false;  // whether no solution of this target is free

  // space: MOST n numbers, then those of the collision
  Freedom(const ShapedRobot<Real>& robot, int n, const int* entry, Real* q, Real* space)
      : collision(robot, space + MOST * n), robot(robot), n(n), entry(entry), q(q), kept(space) {}
  static constexpr OSIK_HOST int space_of(int n) { return MOST * n; }
  bool has_rejected() const { return rejected > 0; }

  // Take a target's scene at the configuration q; false if shapes touch that no joint of the search parts.
  bool begin(const Call& call, int target) {
    const int own = has_many_scenes(call, 8) ? target : 0;
    if (own != row) collision.set(scene_of(call, 8, robot.shapes, target)), row = own;
    clearance = call.in(10, 0)[0], is_blocked = false, rejected = 0;
    collision.place(q);
    fixed = collision.nearer(clearance, false);
    return fixed.i < 0;
  }
  // Whether a solution is free. tips: positions of the frames; score, tolerances: of ChainSearch.
  bool accepts(const Real* x, int seed, const Real* tips, Real score, const Real* tolerances) {
    place(x);
    if (collision.nearer(clearance + MORE, true).i < 0) return true;
    if (!rejected) is_blocked = is_around_target(tips, score, tolerances);  // the same at every solution
    if (rejected == MOST) return false;
    for (int j = 0; j < n; ++j) kept[rejected * n + j] = x[j];
    seeds[rejected++] = seed;
    return false;
  }
  // Replace x by the rejected solution with the largest clearance, if there is one; that clearance.
  Real take_least_wrong(Real* x, int& seed) {
    Real best = -Real(INFINITE);
    for (int k = 0; k < rejected; ++k) {
      place(kept + k * n);
      const Real distance = collision.nearest().gap.distance;
      if (!(distance > best)) continue;
      best = distance, seed = seeds[k];
      for (int j = 0; j < n; ++j) x[j] = kept[k * n + j];
    }
    return best;
  }
  // Write gap, pair and reason of the answer q from result `first` on, and whether it is a free solution.
  template <class Labels> void judge(const Call& call, int target, int first, Labels converged) {
    collision.place(q);
    Nearest<Real> nearest = collision.nearest();
    const Reason missed = fixed.i >= 0 ? HELD_SHAPES : is_blocked ? AROUND_TARGET : rejected ? EVERY_SOLUTION : NONE;
    if (missed == HELD_SHAPES) nearest = fixed;
    if (missed == AROUND_TARGET) nearest = around;
    if (missed == HELD_SHAPES || missed == AROUND_TARGET) nearest.gap = collision.gap_of(nearest.i, nearest.j);
    put(nearest.gap, call.out(first, target));
    auto to = call.labels(first + 1, target);
    to[0] = nearest.i, to[1] = nearest.j;
    converged[0] = converged[0] && nearest.gap.distance >= clearance;
    to[2] = converged[0] ? NONE : missed;
  }

 private:
  void place(const Real* x) {
    for (int j = 0; j < n; ++j) q[entry[j]] = x[j];
    collision.place(q);
  }
  // Whether a shape that a frame's target places touches one that stays, by more than the tolerances of the target allow
  // it to give way.
  bool is_around_target(const Real* tips, Real score, const Real* tolerances) {
    return collision.any_pair([&](int i, int j) {
      const int shape = collision.moves(i) ? i : j, other = shape == i ? j : i;
      const int frame = collision.moves(shape) - 2;  // see collision/_core.py
      if (frame < 0 || collision.moves(other)) return false;
      const Real arm = collision.reach(shape, Vec3<Real>::of(tips + 3 * frame));
      const Real least = clearance - (1 + score) * (tolerances[0] + tolerances[1] * arm);
      around.i = i, around.j = j;
      return collision.lower_bound({i, j}) < least && collision.gap_of(i, j).distance < least;
    });
  }
};
}  // namespace osik
