// What whole searches for poses of all kinds share: settings, starts, and answers. They are defined by run_pool
// (inverse/_pool.py), explored (inverse/_run.py) and answer (inverse/_chain_problem.py). Arguments and results as in
// inverse/_whole.py. With a scene, solutions that touch something are no solutions (freedom.hpp).
#pragma once
#include "chain_search.hpp"
#include "freedom.hpp"

namespace osik {

// IN_SCENE: whether it has a scene; else every solution is free.
template <class Call, bool IN_SCENE> class ChainFinder {
 protected:
  using Real = typename Call::Real;
  using In = typename Call::In;
  using Search = ChainSearch<Call>;
  using Errors = typename Search::Errors;
  static constexpr int POLISH = 3;
  static constexpr Real TURN = 6.283185307179586, NEVER = INFINITE;

  int n, frames, check, trial, last, seeds, nq, nv, longest;
  bool is_warm, is_near, is_every, is_single, is_unchecked;  // the last one: its caller asks whether solutions are free
  const int *shift, *increment, *turns, *entry, *dof;  // [n]
  const Real *low, *high, *home;                                 // [n], [n], [nq]
  Real progress, settled, isolated, stopped, still;
  Real *here, *before, *q;  // [n] end of a search, and of the steps before; [nq] of an answer
  Search search;
  Freedom<Call>* freedom = nullptr;  // of a search in a scene

  ChainFinder(const Call& call, Real* space)
      : n(call.size(5, 1)), frames(call.size(0, 1)), here(space), before(space + n), q(space + 2 * n),
        search(call.integers(3) + 1, n, frames, space + 2 * n + call.integers(4)[5]) {
    Reader<const int*> options{call.integers(4)}, lists{call.integers(5)};
    longest = *options.take(1), check = *options.take(1), trial = *options.take(1), last = *options.take(1),
    seeds = *options.take(1), nq = *options.take(1), nv = *options.take(1);
    is_warm = *options.take(1), is_near = *options.take(1), is_every = *options.take(1), is_single = *options.take(1);
    is_unchecked = *options.take(1);
    shift = lists.take(n), increment = lists.take(n), turns = lists.take(n), entry = lists.take(n), dof = lists.take(n);
    search.read(call.numbers(2, 0));
    search.near = false, search.pull = 0;
    Reader<const Real*> more{search.numbers + 6};
    low = more.take(n), high = more.take(n), home = more.take(nq);
    progress = more.take(1)[0], settled = more.take(1)[0], isolated = more.take(1)[0], stopped = more.take(1)[0],
    still = more.take(1)[0];
  }

 public:
  static constexpr OSIK_HOST int space_of(int n, int frames, int joints, int nq) {
    return 2 * n + nq + Search::space_of(n, frames, joints);
  }
  static int space_of(const Call& call) {
    return space_of(call.size(5, 1), call.size(0, 1), call.integers(3)[1], call.integers(4)[5]);
  }
  // The robot in a scene that a search reads; argument 6 and on.
  static ShapedRobot<Real> robot_of(const Call& call) { return {call.integers(6), call.numbers(7, 0)}; }
  Freedom<Call> freedom_of(const ShapedRobot<Real>& robot, Real* space) const { return {robot, n, entry, q, space}; }
  void take(Freedom<Call>* given) { freedom = given; }

 protected:
  static Real within(Real a, Real lower, Real upper) { return a < lower ? lower : a > upper ? upper : a; }
  // Begin with a target: the number of its searches.
  int begin_target(const Call& call, int target) {
    for (int k = 0; k < nq; ++k) q[k] = home[k];
    return IN_SCENE && !freedom->begin(call, target) ? 0 : call.integers(1, target)[0];
  }
  // The start of a search.
  template <class F> void begin(int seed, bool near, F put) const {
    const Real share = near ? within(Real(seed) / seeds, 0, 1) : Real(1);
    for (int j = 0; j < n; ++j) {
      const unsigned bits = unsigned(shift[j]) + unsigned(seed) * unsigned(increment[j]);
      const Real point = low[j] + (high[j] - low[j]) * ((bits >> 8) * Real(1.0 / (1 << 24))), first = search.start[j];
      const Real to = near ? first + share * (point - first) : is_warm && seed == 0 ? first : point;
      put(j, within(to, search.lower[j], search.upper[j]));
    }
  }
  // Whether `here`, the end of a search, is free: its last steps, and turns to x, are those of an answer.
  bool is_free_end(In goal, int seed, Real* x) {
    for (int k = 0; k < POLISH; ++k) polish(goal);
    unwind(x);
    for (int j = 0; j < n; ++j) search.x[j] = x[j];
    const Real score = compare(goal).score, tolerances[2] = {search.numbers[1], search.numbers[2]};
    return freedom->accepts(x, seed, search.tips, score, tolerances);
  }
  // `here` with whole turns added, as near to the start as the limits allow.
  OSIK_CALL void unwind(Real* x) const {
    for (int j = 0; j < n; ++j) {
      const Real lower = search.lower[j], upper = search.upper[j];
      const Real fewest = ceil((lower - here[j]) / TURN), most = floor((upper - here[j]) / TURN);
      Real number = turns[j] ? rint((search.start[j] - here[j]) / TURN) : Real(0);
      if (turns[j]) number = number < fewest ? fewest : number, number = number > most ? most : number;
      x[j] = number == 0 ? here[j] : within(here[j] + TURN * number, lower, upper);
    }
  }
  OSIK_CALL Errors compare(In goal) {
    search.place();
    return search.compare(goal);
  }
  // `here` after one more step, where it is a solution and the step lowers its error.
  OSIK_CALL void polish(In goal) {
    const Real enough = search.enough;
    search.enough = 0;
    for (int j = 0; j < n; ++j) search.x[j] = here[j];
    const Errors first = search.advance(1, goal, before);
    if (first.score <= 1 && compare(goal).score < first.score)
      for (int j = 0; j < n; ++j) here[j] = search.x[j];
    search.enough = enough;
  }
  // Write the answer `here`: the configuration q, its errors, residuals, and the limits that stop joints.
  void answer(const Call& call, int target, int seed, int steps) {
    const In goal = call.in(0, target);
    for (int k = 0; !IN_SCENE && k < (is_unchecked ? POLISH : 1); ++k) polish(goal);
    unwind(search.x);
    for (int k = 0; k < nq; ++k) q[k] = home[k];
    for (int j = 0; j < n; ++j) q[entry[j]] = search.x[j] = is_single ? Real(float(search.x[j])) : search.x[j];
    const Errors errors = compare(goal);
    search.differentiate();
    auto to = call.out(0, target), sizes = call.out(1, target);
    auto labels = call.labels(2, target);
    for (int k = 0; k < nq; ++k) to[k] = q[k];
    sizes[0] = errors.position, sizes[1] = errors.orientation, sizes[2] = errors.score;
    labels[0] = errors.score <= 1, labels[1] = seed, labels[2] = steps;
    for (int k = 0; k < nv; ++k) labels[3 + k] = 0;
    for (int k = 0; k < 6 * frames; ++k)
      sizes[3 + k] = search.row[k] < 0 ? Real(0) : search.e[search.row[k]] / (k % 6 < 3 ? Real(1) : search.numbers[0]);
    for (int j = 0; j < n; ++j) {
      Real gradient = 0, squares = 0;
      const Real* column = search.J + j * search.rows;
      for (int a = 0; a < search.rows; ++a) gradient += column[a] * search.e[a], squares += column[a] * column[a];
      if (!(fabs(gradient) > stopped * sqrt(squares * errors.cost))) continue;
      labels[3 + dof[j]] = (search.x[j] >= search.upper[j] && gradient < 0) -
                           (search.x[j] <= search.lower[j] && gradient > 0);
    }
    if (IN_SCENE) freedom->judge(call, target, is_every ? 4 : 3, labels);
  }
};
}  // namespace osik
