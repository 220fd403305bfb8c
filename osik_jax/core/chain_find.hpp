// Whole searches for poses on a CPU, one target after another, by the steps of chain_search.hpp. They are defined by
// run_pool (inverse/_pool.py), explored (inverse/_run.py) and answer (inverse/_chain_problem.py). Arguments and results
// as in inverse/_whole.py. With a scene, solutions that touch something are no solutions (freedom.hpp).
#pragma once
#include <limits>
#include <memory>
#include <vector>

#include "chain_search.hpp"
#include "freedom.hpp"
#include "lanes.hpp"
#include "xla.hpp"

namespace osik {

class ChainFinder {
  template <class R> struct Kind {
    using Real = R;
    using In = const double*;
  };
  using Search = ChainSearch<Kind<double>>;
  using Pack = Lanes<double>;
  using Errors = Search::Errors;
  using List = std::vector<double>;
  using In = const double*;
  static constexpr int POLISH = 3;
  static constexpr double TURN = 6.283185307179586, NEVER = std::numeric_limits<double>::infinity();
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

  int n, frames, check, trial, last, seeds, nq, nv, longest;
  bool is_warm, is_near, is_every, is_single;
  const int *shift, *increment, *turns, *entry, *dof;  // [n]
  In low, high, home;                                  // [n], [n], [nq]
  double progress, settled, isolated, stopped, still;
  List space, here, gram;
  std::vector<Pack> pack_space, pack_here;
  Search search;
  ChainSearch<Kind<Pack>> pack;
  Freedom* freedom;  // null: every solution is free

  static int workspace(int n, int frames, int joints) {
    return 18 * joints + 3 * frames + 2 * n + 6 * frames * (6 * frames + n + 1);
  }

 public:
  ChainFinder(const xla::Call& call, Freedom* freedom = nullptr)
      : n(call.in<int>(4)[0]), frames(call.size(0, 1)), space(workspace(n, frames, call.in<int>(3)[1])), here(n),
        gram(n * n), pack_space(space.size()), pack_here(n), search(call.in<int>(3) + 1, n, frames, space.data()),
        pack(call.in<int>(3) + 1, n, frames, pack_space.data()), freedom(freedom) {
    Reader<const int*> options{call.in<int>(4) + 1};
    longest = *options.take(1), check = *options.take(1), trial = *options.take(1), last = *options.take(1),
    seeds = *options.take(1);
    nq = *options.take(1), nv = *options.take(1);
    is_warm = *options.take(1), is_near = *options.take(1), is_every = *options.take(1), is_single = *options.take(1);
    shift = options.take(n), increment = options.take(n), turns = options.take(n), entry = options.take(n),
    dof = options.take(n);
    search.read(call.in<double>(2)), pack.read(call.in<double>(2));
    search.near = false, search.pull = 0;
    Reader<In> more{search.numbers + 6};
    low = more.take(n), high = more.take(n), home = more.take(nq);
    progress = *more.take(1), settled = *more.take(1), isolated = *more.take(1), stopped = *more.take(1),
    still = *more.take(1);
  }

  void solve(const xla::Call& call, int target) {
    const In goal = call.in<double>(0) + 12 * frames * target;
    double* outcomes = is_every ? call.out<double>(3) + size_t(seeds) * (n + 2) * target : nullptr;
    double* q = call.out<double>(0) + nq * target;
    int* labels = call.out<int>(2) + (3 + nv) * target;
    std::copy(home, home + nq, q);
    const int most = freedom && !freedom->begin(call, target, q) ? 0 : call.in<int>(1)[target];
    const int all = most ? seeds : 0;
    Best best = is_near || is_every ? explored(goal, all, is_near, false, outcomes) : plain(goal, most);
    if (is_near) compare_with_plain(goal, most, best);
    if (freedom && is_every && !(best.score <= 1)) best = plain(goal, most);
    if (freedom && !(best.score <= 1)) freedom->take_least_wrong(best.x, best.seed);
    answer(goal, best, q, call.out<double>(1) + (3 + 6 * frames) * target, labels);
    if (freedom) freedom->judge(call, target, q, is_every, labels[0]);
  }

 private:
  // The start of a search.
  template <class F> void begin(int seed, bool near, F put) const {
    const double share = near ? std::min(double(seed) / seeds, 1.0) : 1;
    for (int j = 0; j < n; ++j) {
      const unsigned bits = unsigned(shift[j]) + unsigned(seed) * unsigned(increment[j]);
      const double point = low[j] + (high[j] - low[j]) * ((bits >> 8) * (1.0 / (1 << 24))), first = search.start[j];
      const double to = near ? first + share * (point - first) : is_warm && seed == 0 ? first : point;
      put(j, std::min(std::max(to, search.lower[j]), search.upper[j]));
    }
  }
  // Searches until one has a solution.
  Best plain(In goal, int most) { return freedom ? explored(goal, most, false, true, nullptr) : found(goal, most); }
  // One search after another.
  Best found(In goal, int most) {
    Best best{List(search.start, search.start + n), NEVER, 0, 0, 0};
    for (int seed = 0; seed < most && !(best.score <= search.enough); ++seed) {
      begin(seed, false, [&](int j, double to) { search.x[j] = to; });
      double cost = NEVER;
      for (int age = check;; age += check) {
        const Errors errors = search.advance(check, goal, here.data());
        best.steps += check;
        if (errors.score < best.score) best.x = here, best.score = errors.score, best.seed = seed;
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
    for (int k = 1; outcomes && freedom && k <= seeds; ++k) outcomes[(n + 2) * k - 2] = NEVER, outcomes[(n + 2) * k - 1] = 0;
    for (int j = 0; j < n; ++j) pack.x[j] = search.start[j];
    for (int k = 0; k < Pack::COUNT; ++k) start(k);
    auto is_over = [&] { return (brief && best.score <= 1) || (freedom && freedom->is_blocked); };
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
    here = other.x, keep(goal, other.seed, std::min(other.score, settled), best, nullptr);
    unwind(search.x);
    search.near = true, search.pull = 1;
    search.advance(longest, goal, here.data());
    search.near = false, search.pull = 0;
    keep(goal, other.seed, search.advance(last, goal, here.data()).score, best, nullptr);
    best.steps += longest + last;
  }
  // Keep the end `here` of a search among the outcomes, and as the best if it is.
  void keep(In goal, int seed, double score, Best& best, double* outcomes) {
    List x(n);
    for (int k = 0; k < POLISH && freedom; ++k) polish(goal);  // what is judged is the answer
    unwind(x.data());
    score = score == score && (score > 1 || is_free(goal, x, seed)) ? score : NEVER;
    double distance = is_near ? 0 : seed;
    for (int j = 0; j < n && is_near; ++j) distance += (x[j] - search.start[j]) * (x[j] - search.start[j]);
    if (outcomes) {
      double* to = std::copy(x.begin(), x.end(), outcomes + (n + 2) * seed);
      to[0] = score, to[1] = score <= 1 && is_isolated(goal, x.data());
    }
    if (is_better(score, distance, best)) best.x = x, best.score = score, best.distance = distance, best.seed = seed;
  }
  // Whether a solution touches nothing.
  bool is_free(In goal, const List& x, int seed) {
    if (!freedom) return true;
    std::copy(x.begin(), x.end(), search.x);
    const double score = compare(goal).score, tolerances[2] = {search.numbers[1], search.numbers[2]};
    return freedom->accepts(x, entry, home, nq, seed, search.tips, score, tolerances);
  }
  // By class first: settled, found, or neither; within the first two by distance.
  bool is_better(double score, double distance, const Best& best) const {
    auto rank = [&](double score) { return score <= settled ? 0 : score <= 1 ? 1 : 2; };
    const int own = rank(score), other = rank(best.score);
    return own != other ? own < other : own < 2 ? distance < best.distance : score < best.score;
  }
  // `here` with whole turns added, as near to the start as the limits allow.
  void unwind(double* x) const {
    for (int j = 0; j < n; ++j) {
      const double lower = search.lower[j], upper = search.upper[j];
      const double fewest = std::ceil((lower - here[j]) / TURN), most = std::floor((upper - here[j]) / TURN);
      const double number = turns[j] ? std::min(std::max(std::nearbyint((search.start[j] - here[j]) / TURN), fewest), most)
                                     : 0;
      x[j] = number == 0 ? here[j] : std::min(std::max(here[j] + TURN * number, lower), upper);
    }
  }
  Errors compare(In goal) {
    search.place();
    return search.compare(goal);
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
  // `here` after one more step, where it is a solution and the step lowers its error.
  void polish(In goal) {
    const double enough = search.enough;
    search.enough = 0;
    std::copy(here.begin(), here.end(), search.x);
    List before(n);
    const Errors first = search.advance(1, goal, before.data());
    if (first.score <= 1 && compare(goal).score < first.score) std::copy(search.x, search.x + n, here.begin());
    search.enough = enough;
  }
  // The configuration q, its errors, residuals, and the limits that stop joints.
  void answer(In goal, const Best& best, double* q, double* sizes, int* labels) {
    std::copy(best.x.begin(), best.x.end(), here.begin());
    if (!freedom) polish(goal);
    unwind(search.x);
    for (int j = 0; j < n; ++j) q[entry[j]] = search.x[j] = is_single ? double(float(search.x[j])) : search.x[j];
    const Errors errors = compare(goal);
    search.differentiate();
    sizes[0] = errors.position, sizes[1] = errors.orientation, sizes[2] = errors.score;
    labels[0] = errors.score <= 1, labels[1] = best.seed, labels[2] = best.steps;
    std::fill(labels + 3, labels + 3 + nv, 0);
    for (int k = 0; k < 6 * frames; ++k)
      sizes[3 + k] = search.row[k] < 0 ? 0 : search.e[search.row[k]] / (k % 6 < 3 ? 1 : search.numbers[0]);
    for (int j = 0; j < n; ++j) {
      double gradient = 0, squares = 0;
      const double* column = search.J + j * search.rows;
      for (int a = 0; a < search.rows; ++a) gradient += column[a] * search.e[a], squares += column[a] * column[a];
      if (!(std::abs(gradient) > stopped * std::sqrt(squares * errors.cost))) continue;
      labels[3 + dof[j]] = (search.x[j] >= search.upper[j] && gradient < 0) -
                           (search.x[j] <= search.lower[j] && gradient > 0);
    }
  }
};

inline void find_chain(const xla::Call& call) {
  ChainFinder finder(call);
  for (int target = 0; target < call.size(0, 0); ++target) finder.solve(call, target);
}

// The same in scenes, by all processor cores where there are many targets.
inline void find_free(const xla::Call& call) {
  constexpr int LEAST = 8;  // targets of a thread
  const ShapedRobot<double> robot(call.in<int>(5), call.in<double>(6));
  struct Worker {
    Freedom freedom;
    ChainFinder finder;
    Worker(const xla::Call& call, const ShapedRobot<double>& robot) : freedom(robot), finder(call, &freedom) {}
  };
  in_threads(call.size(0, 0), LEAST, [&] {
    return [&call, own = std::make_unique<Worker>(call, robot)](int target) { own->finder.solve(call, target); };
  });
}
}  // namespace osik
