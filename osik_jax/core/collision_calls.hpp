// Distances of many configurations, and of pairs of shapes. Arguments and results as in collision/_core.py.
#pragma once
#include "freedom.hpp"

namespace osik {

// f(collision, lane) with the shapes placed at each configuration: arguments q [lanes, nq], the robot's integers and numbers,
// a scene.
template <class Call, class F> void each_placed(const Call& call, F f) {
  using Real = typename Call::Real;
  const ShapedRobot<Real> robot(call.integers(1), call.numbers(2, 0));
  auto space = call.space();
  typename Call::Collision collision(robot, space.data());
  bool is_set = false;
  call.each_lane([&](int lane) {
    if (!is_set || has_many_scenes(call, 3)) collision.set(scene_of(call, 3, robot.shapes, lane)), is_set = true;
    collision.place(call.numbers(0, lane));
    f(collision, lane);
  });
}

// Nearest pairs: results distance, points and normal [lanes, 10], and the pair [lanes, 2].
template <class Call> void find_clearances(const Call& call) {
  each_placed(call, [&](auto& collision, int lane) {
    const auto nearest = collision.nearest();
    put(nearest.gap, call.out(0, lane));
    auto pair = call.labels(1, lane);
    pair[0] = nearest.i, pair[1] = nearest.j;
  });
}

// Whether all pairs keep a distance, argument 5: result [lanes].
template <class Call> void find_free_ones(const Call& call) {
  each_placed(call, [&](auto& collision, int lane) {
    const auto least = call.in(5, lane)[0];
    call.labels(0, lane)[0] = collision.nearer(least, false).i < 0 && collision.nearer(least, true).i < 0;
  });
}

// Gaps of pairs of shapes: arguments are integers [pairs, 6] (kind, first vertex, count, of both), numbers [pairs, 30] (size,
// position, rotation, of both) and vertices; results are distance, points and normal [pairs, 10].
template <class Call> void find_gaps(const Call& call) {
  using Real = typename Call::Real;
  call.each_lane([&](int pair) {
    Convex<Real> shape[2];
    for (int k = 0; k < 2; ++k) {
      const int* integers = call.integers(0, pair) + 3 * k;
      const Real* numbers = call.numbers(1, pair) + 15 * k;
      shape[k] = {integers[0],
                  integers[2],
                  Vec3<Real>::of(numbers),
                  Vec3<Real>::of(numbers + 3),
                  Mat3<Real>::of(numbers + 6),
                  call.numbers(2, 0) + 3 * integers[1]};
    }
    put(gap_between(shape[0], shape[1]), call.out(0, pair));
  });
}
}  // namespace osik
