// Ways around obstacles: RRT-Connect (Kuffner and LaValle, 2000) whose edges are proven free, then shortcuts and round
// corners. Arguments and results as in motion/_connect.py.
//
// A curve is proven by bisection (Schwarzer, Saha and Latombe, "Adaptive dynamic collision checking", 2005): in the middle
// of a part, a pair of shapes has to be farther apart than the clearance and the way that its points go in this part. Pairs
// that are not yet are tried again in both halves.
#pragma once
#include <cstdint>

#include "collision.hpp"
#include "freedom.hpp"
#include "threads.hpp"

namespace osik {

class WayAround {
  using List = std::vector<double>;
  using V = Vec3<double>;
  struct Pair {
    int i, j;
    List reach;  // [n] way of a point of one shape in the axes of the other for a unit of each entry, at most
  };
  struct Part {  // of a curve, by its parameter; the pairs that are not proven there
    double from, to;
    size_t first, end;
  };
  struct Tree {
    List nodes;                // [count, n]
    std::vector<int> parents;  // -1: a root
    int count() const { return int(parents.size()); }
    void add(const List& x, int parent) { nodes.insert(nodes.end(), x.begin(), x.end()), parents.push_back(parent); }
  };
  static constexpr double MARGIN = 1e-4;  // states in the middle of parts keep so much more than the clearance [m]
  static constexpr double FINEST = 1e-6;  // the same, where curves are given
  static constexpr double GAIN = 0.01;    // part by which shortcuts have to make a way shorter
  static constexpr int MOST_PARTS = 1000, IDLE = 15, HALVINGS = 48;  // of a curve; shortcuts without gain; of a corner

 public:
  enum Status { FOUND, BAD_START, BAD_GOAL, NOT_FOUND };

 private:
  const ShapedRobot<double>& robot;
  Collision<double> collision;
  const int n, most;           // entries that move; states that are tried
  const int* entry;            // [n]
  const double *low, *high;    // [n]
  const double *start, *goals;  // [nq], [goals, nq]
  double clearance = 0, margin = 0, longest_step = 0;
  int row = -1;
  long tried = 0, limit = 0;  // states
  uint64_t random_state = 0;
  List q, travel, weight;  // [nq]; [joints] of slides; [n] of the metric
  List middle, spread, curve, points;  // [n] of a part twice; a cubic Bezier curve [4, n]; [5, n] of a corner
  std::vector<Pair> pairs;
  std::vector<int> order, arena;
  std::vector<Part> parts;
  Tree trees[2];

 public:
  // Argument 0: configurations [lanes, nq]; 1: more of them [lanes, k, nq]; 2, 3: robot; 4: number of entries that move,
  // states to try, key, the entries; 5: their ranges, and the longest step by the distance of the corners; 6, 7: scene;
  // 8: clearance.
  WayAround(const xla::Batch& call, const ShapedRobot<double>& robot)
      : robot(robot), collision(robot), n(call.integers(4)[0]), most(call.integers(4)[1]), entry(call.integers(4) + 3),
        low(call.in(5, 0)), high(low + n), q(call.size(0, 1)), travel(robot.joints), middle(n), spread(n), curve(4 * n),
        points(5 * n) {}

  // From a configuration to one of more. Results: vertices [lanes, longest, n], radii of corners [lanes, longest], and
  // [lanes, 6] status, goal, vertices, states that were tried, and the pair that touches.
  void connect(const xla::Batch& call, int lane) {
    const int longest = call.result_size(0, 1);
    double* vertices = call.out(0, lane);
    double* radii = call.out(1, lane);
    int* labels = call.labels(2, lane);
    std::fill(vertices, vertices + longest * n, 0.0), std::fill(radii, radii + longest, 0.0);
    begin(call, lane);
    Nearest<double> touching;
    const Status status = plan(call.size(1, 1), touching);
    limit = tried + most;
    List way;
    if (status == FOUND) way = shortened(straightened(path()));
    limit = std::numeric_limits<long>::max();
    const bool fits = int(way.size()) <= longest * n;
    labels[0] = fits ? status : NOT_FOUND, labels[2] = fits ? int(way.size()) / n : 0, labels[3] = int(tried);
    labels[1] = 0, labels[4] = touching.i, labels[5] = touching.j;
    if (!labels[2]) return;
    labels[1] = chosen;
    std::copy(way.begin(), way.end(), vertices);
    for (int k = 1; k + 1 < labels[2]; ++k) radii[k] = corner(vertices + n * (k - 1));
  }
  // Whether a cubic Bezier curve with these four control points is free. Result: [lanes] flags.
  void prove(const xla::Batch& call, int lane) {
    begin(call, lane), margin = FINEST;
    for (int e = 0; e < 4; ++e)
      for (int k = 0; k < n; ++k) curve[e * n + k] = (e ? goals + (e - 1) * q.size() : start)[entry[k]];
    *call.labels(0, lane) = collision.nearer(clearance, false).i < 0 && is_free_curve();
  }

 private:
  // Take a lane's configurations and scene.
  void begin(const xla::Batch& call, int lane) {
    const int own = call.size(6, 0) > 1 ? lane : 0;
    start = call.in(0, lane), goals = call.in(1, lane);
    q.assign(start, start + q.size());
    if (own != row) collision.set(scene_of(call, 6, robot.shapes, lane)), row = own;
    clearance = *call.in(8, lane), tried = 0, limit = most, random_state = uint64_t(call.integers(4)[2]) + 1;
    measure(call.size(1, 1)), collision.place(start);
  }
  int chosen = 0, ends[2] = {0, 0};  // the goal; the nodes at which the trees meet

  double random() {  // splitmix64 (Steele, Lea and Flood, 2014)
    uint64_t z = random_state += 0x9e3779b97f4a7c15u;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u, z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return double((z ^ (z >> 31)) >> 11) * 0x1p-53;
  }

  // ---- Proofs

  void place(const double* x) {
    for (int k = 0; k < n; ++k) q[entry[k]] = x[k];
    collision.place(q.data()), ++tried;
  }
  // Whether a state keeps more than the parts of a curve have to, so that curves that stay near it are free.
  bool is_free_state(const double* x) {
    place(x);
    for (size_t k = 0; k < order.size(); ++k)
      if (!collision.keeps(pairs[order[k]].i, pairs[order[k]].j, clearance + 2 * margin)) return put_first(k), false;
    return true;
  }
  void put_first(size_t k) { std::rotate(order.begin(), order.begin() + k, order.begin() + k + 1); }
  // The middle of a part of the curve, and how far the part's points are from it at most, by entry.
  void split(double from, double to) {
    for (int k = 0; k < n; ++k) {
      const double a = curve[k], b = curve[n + k], c = curve[2 * n + k], d = curve[3 * n + k];
      auto blossom = [&](double r, double s, double t) {
        auto mix = [](double u, double one, double two) { return one + u * (two - one); };
        return mix(t, mix(s, mix(r, a, b), mix(r, b, c)), mix(s, mix(r, b, c), mix(r, c, d)));
      };
      const double half = 0.5 * (from + to), at = middle[k] = blossom(half, half, half);
      double most = 0;
      for (const double end : {from, to})
        most = std::max({most, fabs(blossom(end, end, end) - at), fabs(blossom(end, end, half) - at),
                         fabs(blossom(end, half, half) - at)});
      spread[k] = most;
    }
  }
  // Whether all pairs keep the clearance on the curve.
  bool is_free_curve() {
    parts.assign(1, {0, 1, 0, order.size()}), arena = order;
    for (size_t k = 0; k < parts.size(); ++k) {
      const Part part = parts[k];
      if (k >= MOST_PARTS || tried >= limit) return false;
      split(part.from, part.to), place(middle.data());
      const size_t first = arena.size();
      for (size_t e = part.first; e < part.end; ++e) {
        const Pair& pair = pairs[arena[e]];
        double way = 0;
        for (int j = 0; j < n; ++j) way += pair.reach[j] * spread[j];
        if (collision.keeps(pair.i, pair.j, clearance + std::max(way, margin))) continue;
        if (way <= margin || !collision.keeps(pair.i, pair.j, clearance + margin)) {
          put_first(std::find(order.begin(), order.end(), arena[e]) - order.begin());
          return false;
        }
        arena.push_back(int(arena[e]));
      }
      if (arena.size() == first) continue;
      const double half = 0.5 * (part.from + part.to);
      parts.push_back({part.from, half, first, arena.size()}), parts.push_back({half, part.to, first, arena.size()});
    }
    return true;
  }
  bool is_free_line(const double* from, const double* to) {
    for (int e = 0; e < 4; ++e)
      for (int k = 0; k < n; ++k) curve[e * n + k] = from[k] + e / 3.0 * (to[k] - from[k]);
    return is_free_curve();
  }

  // ---- How far points move

  // Find the pairs that the entries part, how far they move them, and the weights of the metric.
  void measure(int count) {
    pairs.clear(), order.clear(), weight.assign(n, 0);
    for (int joint = 0, full = 0; joint < robot.joints; full += width(joint++)) {
      const double* own = std::find(entry, entry + n, robot.source[full]) - entry + low;
      double least = start[robot.source[full]], greatest = least;
      if (own < low + n) least = std::min(least, own[0]), greatest = std::max(greatest, own[n]);
      for (int g = 0; g < count; ++g) {
        const double x = goals[g * q.size() + robot.source[full]];
        least = std::min(least, x), greatest = std::max(greatest, x);
      }
      const double zero = robot.reference[full] - robot.offset[full], factor = robot.factor[full];
      travel[joint] = std::max(fabs(factor * least - zero), fabs(factor * greatest - zero));
    }
    collision.any_pair([&](int i, int j) {
      if (collision.group(i) == collision.group(j)) return false;
      Pair pair{i, j, List(n)};
      const int a = collision.carrier_of(i), b = collision.carrier_of(j);
      add_reach(i, b, pair.reach), add_reach(j, a, pair.reach);
      for (int k = 0; k < n; ++k) weight[k] = std::max(weight[k], pair.reach[k]);
      order.push_back(int(pairs.size())), pairs.push_back(pair);
      return false;
    });
    for (double& w : weight) w = w > 0 ? w : 1;
    longest_step = high[n] * distance(low, high);
  }
  int width(int joint) const { return robot.types[joint] == FREE_JOINT ? 7 : robot.types[joint] == BALL_JOINT ? 4 : 1; }
  bool carries(int body, int other) const {  // whether `other` hangs from `body`
    while (other > body) other = robot.parents[other];
    return other == body;
  }
  // Add the way of a shape's points for a unit of each entry, by the joints that do not carry body `other` as well: at most
  // the sum of the distances between the joints from this one to the shape, and the shape's radius.
  void add_reach(int shape, int other, List& reach) const {
    int body = collision.carrier_of(shape);
    auto [at, length] = collision.own_ball(shape);
    for (; body > 0; body = robot.parents[body]) {
      int joint = robot.joints - 1;
      for (; joint >= 0 && robot.owners[joint] >= body; --joint) {
        if (robot.owners[joint] > body) continue;
        const bool is_slide = robot.types[joint] == SLIDE_JOINT;
        const V anchor = V::of(robot.joint_position + 3 * joint), out = at - anchor;
        if (robot.types[joint] != FREE_JOINT && !is_slide) length += sqrt(inner(out, out)), at = anchor;
        int full = 0;
        for (int k = 0; k < joint; ++k) full += width(k);
        for (int k = 0; k < n && !(other >= 0 && carries(body, other)); ++k)
          if (robot.source[full] == entry[k]) reach[k] += fabs(robot.factor[full]) * (is_slide ? 1 : length);
        length += is_slide ? travel[joint] : 0;
      }
      at = Quaternion<double>::of(robot.quaternion + 4 * body).carry(at) + V::of(robot.position + 3 * body);
    }
  }

  // ---- Search

  Status plan(int count, Nearest<double>& touching) {
    for (Tree& tree : trees) tree.nodes.clear(), tree.parents.clear();
    goal_of_root.clear(), margin = MARGIN;
    if (!add_root(trees[0], start, touching)) return BAD_START;
    for (int g = 0; g < count; ++g)
      if (add_root(trees[1], goals + g * q.size(), touching)) goal_of_root.push_back(g);
    if (!trees[1].count()) return BAD_GOAL;
    touching = {};
    for (int g = 0; g < trees[1].count(); ++g)
      if (is_free_line(node(0, 0), node(1, g))) return chosen = goal_of_root[ends[1] = g], ends[0] = 0, FOUND;
    List x(n);
    while (tried < limit) {
      const int grown = trees[1].count() < trees[0].count();
      for (int k = 0; k < n; ++k) x[k] = low[k] + (high[k] - low[k]) * random();
      const int added = step(grown, nearest(grown, x.data()), x.data());
      if (added < 0) continue;
      const List aim(node(grown, added), node(grown, added) + n);
      for (int at = nearest(!grown, aim.data()); at >= 0;) {
        if (distance(node(!grown, at), aim.data()) == 0) return meet(grown, added, at);
        at = step(!grown, at, aim.data());
      }
    }
    return NOT_FOUND;
  }
  std::vector<int> goal_of_root;

  const double* node(int tree, int k) const { return trees[tree].nodes.data() + size_t(n) * k; }
  // Make a configuration a root, if it is free; the margin is such that it keeps two of them.
  bool add_root(Tree& tree, const double* from, Nearest<double>& touching) {
    List x(n);
    for (int k = 0; k < n; ++k) x[k] = from[entry[k]];
    place(x.data());
    const auto nearest = collision.nearest();
    if (!(nearest.gap.distance > clearance)) return touching = nearest, false;
    margin = std::min(margin, 0.5 * (nearest.gap.distance - clearance));
    return tree.add(x, -1), true;
  }
  double distance(const double* a, const double* b) const {
    double sum = 0;
    for (int k = 0; k < n; ++k) sum += weight[k] * weight[k] * (a[k] - b[k]) * (a[k] - b[k]);
    return sqrt(sum);
  }
  int nearest(int tree, const double* x) const {
    int best = 0;
    double least = std::numeric_limits<double>::infinity();
    for (int k = 0; k < trees[tree].count(); ++k)
      if (const double own = distance(node(tree, k), x); own < least) least = own, best = k;
    return best;
  }
  // Add a node on the way from another one to x, one step away at most; -1 if that is not free.
  int step(int tree, int from, const double* x) {
    const double length = distance(node(tree, from), x), share = std::min(1.0, longest_step / length);
    if (length == 0) return from;
    List to(x, x + n);
    for (int k = 0; k < n && share < 1; ++k) to[k] = node(tree, from)[k] + share * (x[k] - node(tree, from)[k]);
    if (!is_free_state(to.data()) || !is_free_line(node(tree, from), to.data())) return -1;
    trees[tree].add(to, from);
    return trees[tree].count() - 1;
  }
  Status meet(int grown, int added, int other) {
    ends[grown] = added, ends[!grown] = other;
    int root = ends[1];
    while (trees[1].parents[root] >= 0) root = trees[1].parents[root];
    return chosen = goal_of_root[root], FOUND;
  }
  // The vertices from the start to the goal.
  List path() const {
    std::vector<int> back;
    List way;
    for (int k = ends[0]; k >= 0; k = trees[0].parents[k]) back.push_back(k);
    for (size_t k = back.size(); k-- > 0;) way.insert(way.end(), node(0, back[k]), node(0, back[k]) + n);
    for (int k = ends[1]; k >= 0; k = trees[1].parents[k]) {
      const bool is_same = distance(node(1, k), way.data() + way.size() - n) == 0;
      if (!is_same) way.insert(way.end(), node(1, k), node(1, k) + n);
    }
    return way;
  }

  // ---- Shorter and rounder

  // Straight lines between random points of the way, where they are free.
  List shortened(List way) {
    double before = length(way);
    for (int idle = 0, attempt = 0; idle < IDLE && way.size() > size_t(2 * n) && tried < limit; ++attempt) {
      const int count = int(way.size()) / n;
      List along(count);
      for (int k = 1; k < count; ++k) along[k] = along[k - 1] + distance(&way[n * (k - 1)], &way[n * k]);
      double one = random() * along.back(), two = random() * along.back();
      if (one > two) std::swap(one, two);
      const List from = point(way, along, one), to = point(way, along, two);
      const int first = int(std::upper_bound(along.begin(), along.end(), one) - along.begin()) - 1;
      const int last = int(std::lower_bound(along.begin(), along.end(), two) - along.begin());
      ++idle;
      if (last - first < 2 || !is_free_state(from.data()) || !is_free_state(to.data()) ||
          !is_free_line(from.data(), to.data()))
        continue;
      List shorter(way.begin(), way.begin() + n * (first + 1));
      for (const List& added : {from, to})
        if (distance(added.data(), &shorter[shorter.size() - n]) > 0)
          shorter.insert(shorter.end(), added.begin(), added.end());
      const bool is_end = distance(&way[n * last], to.data()) == 0;
      shorter.insert(shorter.end(), way.begin() + n * (last + is_end), way.end());
      way = straightened(shorter);
      if (const double after = length(way); after < (1 - GAIN) * before) before = after, idle = 0;
    }
    return way;
  }
  // Without the vertices that lines can leave out.
  List straightened(List way) {
    for (size_t k = n; k + n < way.size();)
      if (is_free_line(&way[k - n], &way[k + n])) way.erase(way.begin() + k, way.begin() + k + n);
      else k += n;
    return way;
  }
  double length(const List& way) const {
    double sum = 0;
    for (size_t k = n; k < way.size(); k += n) sum += distance(&way[k - n], &way[k]);
    return sum;
  }
  List point(const List& way, const List& along, double at) const {
    int k = int(std::upper_bound(along.begin(), along.end(), at) - along.begin()) - 1;
    k = std::max(0, std::min(k, int(along.size()) - 2));
    const double share = (at - along[k]) / (along[k + 1] - along[k]);
    List x(n);
    for (int j = 0; j < n; ++j)
      x[j] = share <= 0   ? way[n * k + j]
             : share >= 1 ? way[n * (k + 1) + j]
                          : way[n * k + j] + share * (way[n * (k + 1) + j] - way[n * k + j]);
    return x;
  }
  // How far from the middle one of three vertices the curve leaves the lines: half a line at most. It has two cubics.
  double corner(const double* v) {
    double legs[2] = {0, 0};
    for (int e = 0; e < 2; ++e) {
      for (int k = 0; k < n; ++k) legs[e] += (v[n * (e + 1) + k] - v[n * e + k]) * (v[n * (e + 1) + k] - v[n * e + k]);
      legs[e] = sqrt(legs[e]);
    }
    double radius = 0.5 * std::min(legs[0], legs[1]);
    for (int halving = 0; halving < HALVINGS; ++halving, radius *= 0.5) {
      for (int k = 0; k < n; ++k) {
        const double a = radius / legs[0] * (v[n + k] - v[k]), b = radius / legs[1] * (v[2 * n + k] - v[n + k]);
        const double at = v[n + k];
        points[k] = at - 2 * a, points[n + k] = at - a, points[2 * n + k] = at, points[3 * n + k] = at + b,
        points[4 * n + k] = at + 2 * b;
      }
      bool holds = true;
      for (int piece = 0; piece < 2 && holds; ++piece) {  // of the uniform B-spline with these points
        for (int k = 0; k < n; ++k) {
          const double* p = points.data() + n * piece + k;
          curve[k] = (p[0] + 4 * p[n] + p[2 * n]) / 6, curve[n + k] = (2 * p[n] + p[2 * n]) / 3;
          curve[2 * n + k] = (p[n] + 2 * p[2 * n]) / 3, curve[3 * n + k] = (p[n] + 4 * p[2 * n] + p[3 * n]) / 6;
        }
        holds = is_free_curve();
      }
      if (holds) return radius;
    }
    return 0;
  }
};

template <void (WayAround::*method)(const xla::Batch&, int)> void find_ways(const xla::Batch& call) {
  const ShapedRobot<double> robot(call.integers(2), call.in(3, 0));
  in_threads(call.result_size(0, 0), 2,
             [&] { return [&, way = WayAround(call, robot)](int lane) mutable { (way.*method)(call, lane); }; });
}
}  // namespace osik
