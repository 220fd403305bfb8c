// Whether solutions of a search are free, which of them are the least wrong, and distances of many configurations.
// Arguments and results as in collision/_core.py.
#pragma once
#include <atomic>
#include <thread>

#include "collision.hpp"
#include "xla.hpp"

namespace osik {

constexpr double TOUCH = 1e-6;  // solutions keep so much more, against rounding of their numbers [m]

// The scene of a target: argument `k` has integers, `k + 1` numbers, each with a row for each scene or one for all.
inline bool has_many_scenes(const xla::Call& call, int k) { return call.size(k, 0) > 1 || call.size(k + 1, 0) > 1; }
inline SceneRows<double> scene_of(const xla::Call& call, int k, int shapes, int target) {
  const size_t row = call.size(k, 0) > 1 ? target : 0;
  return {call.in<int>(k) + call.size(k, 1) * row, xla::lane_of(call, k + 1, target), shapes};
}

// Call a worker that `make` makes with each number below `count`, in threads that take `least` of them or more.
template <class Make> void in_threads(int count, int least, Make make) {
  const int most = std::max(1, int(std::thread::hardware_concurrency()));
  std::atomic<int> next{0};
  std::atomic<bool> has_failed{false};
  auto work = [&] {
    try {
      auto worker = make();
      for (int k = next++; k < count; k = next++) worker(k);
    } catch (const std::exception&) {  // no memory
      has_failed = true;
    }
  };
  std::vector<std::thread> others;
  for (int k = 1; k < std::min(most, count / least); ++k) others.emplace_back(work);
  work();
  for (auto& other : others) other.join();
  xla::Call::require(!has_failed, "the core has no memory for a search in a scene");
}

class Freedom {
  struct Rejected {
    std::vector<double> x, q;
    int seed;
  };
  static constexpr size_t MOST = 32;  // rejected solutions that are kept
  enum Reason { NONE, HELD_SHAPES, AROUND_TARGET, EVERY_SOLUTION };

  Collision<double> collision;
  const ShapedRobot<double>& robot;
  double clearance = 0;
  int row = -1;  // of the scene that is taken
  std::vector<double> q;
  std::vector<Rejected> rejected;
  Collision<double>::Nearest fixed, around;  // pairs that touch whatever the search does

 public:
  bool is_blocked = false;  // whether no solution of this target is free

  explicit Freedom(const ShapedRobot<double>& robot) : collision(robot), robot(robot) {}

  // Take a target's scene; false if shapes touch that no joint of the search parts.
  bool begin(const xla::Call& call, int target, const double* home) {
    const int own = has_many_scenes(call, 7) ? target : 0;
    if (own != row) collision.set(scene_of(call, 7, robot.shapes, target)), row = own;
    clearance = call.in<double>(9)[0], is_blocked = false, rejected.clear();
    collision.place(home);
    fixed = collision.nearer(clearance, false);
    return fixed.i < 0;
  }
  // Whether a solution is free. tips: positions of the frames; score, tolerances: of ChainSearch.
  bool accepts(const std::vector<double>& x, const int* entry, const double* home, int nq, int seed, const double* tips,
               double score, const double* tolerances) {
    q.assign(home, home + nq);
    for (size_t j = 0; j < x.size(); ++j) q[entry[j]] = x[j];
    collision.place(q.data());
    const auto hit = collision.nearer(clearance + TOUCH, true);
    if (hit.i < 0) return true;
    if (rejected.empty()) is_blocked = is_around_target(tips, score, tolerances);  // the same at every solution
    if (rejected.size() < MOST) rejected.push_back({x, q, seed});
    return false;
  }
  // Replace x by the rejected solution with the largest clearance, if there is one.
  void take_least_wrong(std::vector<double>& x, int& seed) {
    double best = -std::numeric_limits<double>::infinity();
    for (const Rejected& own : rejected) {
      collision.place(own.q.data());
      const double distance = collision.nearest().gap.distance;
      if (distance > best) best = distance, x = own.x, seed = own.seed;
    }
  }
  // Write clearance, pair and reason of an answer, and whether it is a free solution.
  void judge(const xla::Call& call, int target, const double* answer, bool is_every, int& converged) {
    collision.place(answer);
    auto nearest = collision.nearest();
    const Reason missed = fixed.i >= 0 ? HELD_SHAPES : is_blocked ? AROUND_TARGET : rejected.empty() ? NONE : EVERY_SOLUTION;
    if (missed == HELD_SHAPES) nearest = fixed;
    if (missed == AROUND_TARGET) nearest = around;
    if (missed == HELD_SHAPES || missed == AROUND_TARGET) nearest.gap = collision.gap_of(nearest.i, nearest.j);
    const int first = is_every ? 4 : 3;
    call.out<double>(first)[target] = nearest.gap.distance;
    int* to = call.out<int>(first + 1) + 3 * target;
    to[0] = nearest.i, to[1] = nearest.j;
    converged = converged && nearest.gap.distance >= clearance;
    to[2] = converged ? NONE : missed;
  }

 private:
  // Whether a shape that a frame's target places touches one that stays, by more than the tolerances of the target allow
  // it to give way.
  bool is_around_target(const double* tips, double score, const double* tolerances) {
    return collision.any_pair([&](int i, int j) {
      const int shape = collision.moves(i) ? i : j, other = shape == i ? j : i;
      const int frame = collision.moves(shape) - 2;  // see collision/_core.py
      if (frame < 0 || collision.moves(other)) return false;
      const double arm = collision.reach(shape, Vec3<double>::of(tips + 3 * frame));
      const double least = clearance - (1 + score) * (tolerances[0] + tolerances[1] * arm);
      around.i = i, around.j = j;
      return collision.lower_bound({i, j}) < least && collision.gap_of(i, j).distance < least;
    });
  }
};

inline void put(const Gap<double>& gap, double* to) {
  to[0] = gap.distance, gap.on_a.put(to + 1), gap.on_b.put(to + 4), gap.normal.put(to + 7);
}
// Nearest pairs at many configurations: arguments q [lanes, nq], the robot's integers and numbers, a scene; results
// distance, points and normal [lanes, 10], and the pair [lanes, 2].
inline void find_clearances(const xla::Call& call) {
  const ShapedRobot<double> robot(call.in<int>(1), call.in<double>(2));
  Collision<double> collision(robot);
  const int lanes = call.result_size(0, 0);
  for (int lane = 0; lane < lanes; ++lane) {
    if (lane == 0 || has_many_scenes(call, 3)) collision.set(scene_of(call, 3, robot.shapes, lane));
    collision.place(xla::lane_of(call, 0, lane));
    const auto nearest = collision.nearest();
    double* to = call.out<double>(0) + 10 * lane;
    int* pair = call.out<int>(1) + 2 * lane;
    put(nearest.gap, to);
    pair[0] = nearest.i, pair[1] = nearest.j;
  }
}

// Whether all pairs keep a distance, argument 5, at many configurations; other arguments as in find_clearances.
inline void find_free_ones(const xla::Call& call) {
  const ShapedRobot<double> robot(call.in<int>(1), call.in<double>(2));
  Collision<double> collision(robot);
  for (int lane = 0; lane < call.result_size(0, 0); ++lane) {
    if (lane == 0 || has_many_scenes(call, 3)) collision.set(scene_of(call, 3, robot.shapes, lane));
    collision.place(xla::lane_of(call, 0, lane));
    const double least = *xla::lane_of(call, 5, lane);
    call.out<int>(0)[lane] = collision.nearer(least, false).i < 0 && collision.nearer(least, true).i < 0;
  }
}

// Gaps of pairs of shapes: arguments are integers [pairs, 2, 3] (kind, first vertex, count), numbers [pairs, 2, 15] (size,
// position, rotation) and vertices; results are distance, points and normal [pairs, 10].
inline void find_gaps(const xla::Call& call) {
  for (int pair = 0; pair < call.size(0, 0); ++pair) {
    Convex<double> shape[2];
    for (int k = 0; k < 2; ++k) {
      const int* integers = call.in<int>(0) + 6 * pair + 3 * k;
      const double* numbers = call.in<double>(1) + 30 * pair + 15 * k;
      shape[k] = {integers[0],
                  integers[2],
                  Vec3<double>::of(numbers),
                  Vec3<double>::of(numbers + 3),
                  Mat3<double>::of(numbers + 6),
                  call.in<double>(2) + 3 * integers[1]};
    }
    const Gap<double> gap = gap_between(shape[0], shape[1]);
    double* to = call.out<double>(0) + 10 * pair;
    put(gap, to);
  }
}
}  // namespace osik
