// Whole searches for poses on a CPU, one target after another, some searches of a target at a time (chain_find.hpp).
#pragma once
#include <memory>

#include "chain_find.hpp"
#include "collision.hpp"
#include "lanes.hpp"
#include "threads.hpp"

namespace osik {

template <class Call, bool IN_SCENE> class PackFinder : public ChainFinder<Call, IN_SCENE> {
  template <class R> struct Kind {
    using Real = R;
    using In = const double*;
    using Numbers = const double*;
  };
  using Base = ChainFinder<Call, IN_SCENE>;
  using typename Base::Errors, typename Base::In;
  using Pack = Lanes<double>;
  using List = std::vector<double>;
  using Base::NEVER, Base::n, Base::frames, Base::check, Base::trial, Base::last, Base::seeds, Base::longest, Base::is_near,
      Base::is_every, Base::turns, Base::progress, Base::settled, Base::isolated, Base::still, Base::here, Base::search,
      Base::freedom, Base::begin, Base::unwind, Base::compare;
  struct Lane {  // of a pack: a search that runs, -1 for none
    int seed, age;
    bool is_last;  // its last steps
    double cost;
  };
  struct Best {  // x of the best search of a target, what it is judged by, its number; steps of all searches
    List x;
    double score, distance;
    int seed, steps;
  };

  List gram;
  std::vector<Pack> pack_space, pack_here;
  ChainSearch<Kind<Pack>> pack;

 public:
  PackFinder(const Call& call, double* space)
      : Base(call, space), gram(n * n), pack_space(Base::Search::space_of(n, frames, call.integers(3)[1])), pack_here(n),
        pack(call.integers(3) + 1, n, frames, pack_space.data()) {
    pack.read(call.numbers(2, 0));
  }

  void solve(const Call& call, int target) {
    const In goal = call.in(0, target);
    double* outcomes = is_every ? call.out(3, target) : nullptr;
    const int most = this->begin_target(call, target), all = most ? seeds : 0;
    Best best = is_near || is_every ? explored(goal, all, is_near, false, outcomes) : plain(goal, most);
    if (is_near) compare_with_plain(goal, most, best);
    if (IN_SCENE && is_every && !(best.score <= 1)) best = plain(goal, most);
    if (IN_SCENE && !(best.score <= 1)) freedom->take_least_wrong(best.x.data(), best.seed);
    std::copy(best.x.begin(), best.x.end(), here);
    this->answer(call, target, best.seed, best.steps);
  }

 private:
  // Searches until one has a solution.
  Best plain(In goal, int most) { return IN_SCENE ? explored(goal, most, false, true, nullptr) : found(goal, most); }
  // One search after another.
  Best found(In goal, int most) {
    Best best{List(search.start, search.start + n), NEVER, 0, 0, 0};
    for (int seed = 0; seed < most && !(best.score <= search.enough); ++seed) {
      begin(seed, false, [&](int j, double to) { search.x[j] = to; });
      double cost = NEVER;
      for (int age = check;; age += check) {
        const Errors errors = search.advance(check, goal, here);
        best.steps += check;
        if (errors.score < best.score) best.x.assign(here, here + n), best.score = errors.score, best.seed = seed;
        const bool is_stuck = age > trial && !(errors.cost < progress * cost);
        if (is_stuck || age >= longest || best.score <= search.enough) break;
        cost = errors.cost;
      }
    }
    return best;
  }
  // `count` searches, some at a time; the nearest of those that are found, or the first, or the least wrong. `near`: they
  // go towards the start. `brief`: they end with the first that is found.
  Best explored(In goal, int count, bool near, bool brief, double* outcomes) {
    Best best{List(search.start, search.start + n), NEVER, NEVER, 0, 0};
    Lane lanes[Pack::COUNT];
    int next = 0, running = 0;
    auto start = [&](int k) {
      lanes[k] = {next < count ? next++ : -1, 0, false, NEVER};
      if (lanes[k].seed < 0) return;
      ++running;
      begin(lanes[k].seed, near, [&](int j, double to) { pack.x[j].v[k] = to; });
      pack.pull.v[k] = near, pack.enough.v[k] = search.enough;
    };
    for (int k = 1; outcomes && IN_SCENE && k <= seeds; ++k)
      outcomes[(n + 2) * k - 2] = NEVER, outcomes[(n + 2) * k - 1] = 0;
    for (int j = 0; j < n; ++j) pack.x[j] = search.start[j];
    for (int k = 0; k < Pack::COUNT; ++k) start(k);
    auto is_over = [&] { return (brief && best.score <= 1) || (IN_SCENE && freedom->is_blocked); };
    while (running && !is_over()) {
      const auto errors = pack.advance(check, goal, pack_here.data());
      for (int k = 0; k < Pack::COUNT; ++k) {
        if (lanes[k].seed < 0 || is_over()) continue;
        best.steps += check;
        const double score = errors.score.v[k];
        if (!ends(k, lanes[k], score, errors.cost.v[k])) continue;
        if (!lanes[k].is_last && !brief) {
          lanes[k] = {lanes[k].seed, 0, true, NEVER};
          pack.pull.v[k] = 0, pack.enough.v[k] = is_every ? 0 : search.enough;
          continue;
        }
        for (int j = 0; j < n; ++j) here[j] = pack_here[j].v[k];
        keep(goal, lanes[k].seed, score, best, outcomes);
        --running, start(k);
      }
    }
    return best;
  }
  // Whether a search of a pack has led as far as it leads, and its cost now.
  bool ends(int k, Lane& lane, double score, double cost) const {
    double moved = 0;
    for (int j = 0; j < n; ++j) moved = std::max(moved, std::abs(pack.x[j].v[k] - pack_here[j].v[k]));
    lane.age += check;
    const bool is_stuck = lane.age > trial && score > 1 && !(cost < progress * lane.cost);
    lane.cost = cost;
    return is_stuck || !(moved > still) || lane.age >= (lane.is_last ? last : longest);
  }
  // A pull towards the start can keep a search from any solution. So what the plain call finds is a candidate too, as it
  // is and moved towards the start.
  void compare_with_plain(In goal, int most, Best& best) {
    const Best other = plain(goal, most);
    best.steps += other.steps;
    if (!(other.score <= 1)) return;
    std::copy(other.x.begin(), other.x.end(), here), keep(goal, other.seed, std::min(other.score, settled), best, nullptr);
    unwind(search.x);
    search.near = true, search.pull = 1;
    search.advance(longest, goal, here);
    search.near = false, search.pull = 0;
    keep(goal, other.seed, search.advance(last, goal, here).score, best, nullptr);
    best.steps += longest + last;
  }
  // Keep the end `here` of a search among the outcomes, and as the best if it is.
  void keep(In goal, int seed, double score, Best& best, double* outcomes) {
    List x(n);
    unwind(x.data());
    score = score == score && (score > 1 || !IN_SCENE || this->is_free_end(goal, seed, x.data())) ? score : NEVER;
    double distance = is_near ? 0 : seed;
    for (int j = 0; j < n && is_near; ++j) distance += (x[j] - search.start[j]) * (x[j] - search.start[j]);
    if (outcomes) {
      double* to = std::copy(x.begin(), x.end(), outcomes + (n + 2) * seed);
      to[0] = score, to[1] = score <= 1 && is_isolated(goal, x.data());
    }
    if (is_better(score, distance, best)) best.x = x, best.score = score, best.distance = distance, best.seed = seed;
  }
  // By class first: settled, found, or neither; within the first two by distance.
  bool is_better(double score, double distance, const Best& best) const {
    auto rank = [&](double score) { return score <= settled ? 0 : score <= 1 ? 1 : 2; };
    const int own = rank(score), other = rank(best.score);
    return own != other ? own < other : own < 2 ? distance < best.distance : score < best.score;
  }
  // Whether every motion of the joints moves a frame: the smallest pivot of J'J is positive.
  bool is_isolated(In goal, const double* x) {
    if (search.rows < n) return false;
    std::copy(x, x + n, search.x), compare(goal), search.differentiate();
    const int rows = search.rows;
    double least = NEVER;
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) {
        double& sum = gram[i * n + j] = 0;
        for (int a = 0; a < rows; ++a) sum += search.J[i * rows + a] * search.J[j * rows + a];
      }
    for (int k = 0; k < n; ++k) {
      least = std::min(least, gram[k * n + k]);
      for (int i = k + 1; i < n; ++i)
        for (int j = k + 1; j < n; ++j) gram[i * n + j] -= gram[i * n + k] / gram[k * n + k] * gram[k * n + j];
    }
    return least > isolated * isolated * search.numbers[0] * search.numbers[0];
  }
};

template <class Call> void find_chain(const Call& call) {
  using Finder = PackFinder<Call, false>;
  std::vector<double> space(Finder::space_of(call));
  Finder finder(call, space.data());
  for (int target = 0; target < call.size(0, 0); ++target) finder.solve(call, target);
}

// The same in scenes, by all processor cores where there are many targets.
template <class Call> void find_free(const Call& call) {
  constexpr int LEAST = 8;  // targets of a thread
  using Finder = PackFinder<Call, true>;
  const auto robot = Finder::robot_of(call);
  struct Worker {
    std::vector<double> space, kept;
    Finder finder;
    Freedom<Call> freedom;
    Worker(const Call& call, const ShapedRobot<double>& robot)
        : space(Finder::space_of(call)), kept(Freedom<Call>::space_of(call.size(5, 1))), finder(call, space.data()),
          freedom(finder.freedom_of(robot, kept.data())) {
      finder.take(&freedom);
    }
  };
  in_threads(call.size(0, 0), LEAST, [&] {
    return [&call, own = std::make_unique<Worker>(call, robot)](int target) { own->finder.solve(call, target); };
  });
}
}  // namespace osik
