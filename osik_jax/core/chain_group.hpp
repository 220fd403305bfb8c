// Whole searches for poses on a GPU (chain_find.hpp): some threads of a warp, the members of a group, take the searches of a
// target in turn. All look together whether one has found a solution; the first member that has gives the answer, so that
// it depends on nothing but the arguments.
//
// A call has further words here:
//   member(), Call::MEMBERS      the number of a thread in its group, and how many there are
//   any_member(flag)             whether the flag of one is set
//   of_member(k, number)         the number that member k gives
#pragma once
#include "chain_find.hpp"

namespace osik {

template <class Call> class GroupFinder : public ChainFinder<Call> {
  using Base = ChainFinder<Call>;
  using Base::NEVER, Base::n, Base::check, Base::trial, Base::longest, Base::progress, Base::here, Base::search,
      Base::freedom;
  using typename Base::Real, typename Base::Errors, typename Base::In;
  enum End { FOUND, BLOCKED, TOUCHING, UNMET };  // of a member, the best one first
  Real* best;  // [n]

 public:
  GroupFinder(const Call& call, Real* space) : Base(call, space), best(space + Base::space_of(call)) {}
  static int space_of(const Call& call) { return Base::space_of(call) + call.integers(4)[0]; }

  void solve(const Call& call, int target) {
    const In goal = call.in(0, target);
    const int most = this->begin_target(call, target), member = call.member();
    int seed = member, best_seed = 0, age = 0, steps = 0;
    Real cost = NEVER, least = NEVER;
    bool is_found = false;
    for (int j = 0; j < n; ++j) best[j] = search.start[j];
    if (seed < most) begin(seed);
    while (call.any_member(seed < most)) {
      if (seed < most) {
        const Errors errors = search.advance(check, goal, here);
        const bool is_met = errors.score <= (freedom ? Real(1) : search.enough);
        steps += check, age += check;
        if (errors.score < least && !(freedom && is_met)) {
          least = errors.score, best_seed = seed;
          for (int j = 0; j < n; ++j) best[j] = here[j];
        }
        const bool is_stuck = age > trial && !(errors.cost < progress * cost);
        cost = errors.cost;
        if (errors.score <= search.enough || is_stuck || age >= longest) {
          is_found = is_met && (!freedom || this->is_free_end(goal, seed, search.x));
          if (is_found) best_seed = seed;
          else if ((seed += Call::MEMBERS) < most) begin(seed), age = 0, cost = NEVER;
        }
      }
      if (call.any_member(is_found || (freedom && freedom->is_blocked))) break;
    }
    End end = is_found ? FOUND : UNMET;
    if (!is_found)
      for (int j = 0; j < n; ++j) here[j] = best[j];
    if (!is_found && freedom && freedom->has_rejected()) {
      end = freedom->is_blocked ? BLOCKED : TOUCHING;
      least = -freedom->take_least_wrong(here, best_seed);
    }
    int chosen = 0, all_steps = 0, best_end = end;
    Real best_least = NEVER;
    for (int k = 0; k < Call::MEMBERS; ++k) {
      const int its_end = call.of_member(k, int(end));
      const Real its_least = call.of_member(k, least);
      all_steps += call.of_member(k, steps);
      if (k && !(its_end < best_end || (its_end == best_end && its_end != FOUND && its_least < best_least))) continue;
      chosen = k, best_end = its_end, best_least = its_least;
    }
    if (chosen == member) this->answer(call, target, best_seed, all_steps);
  }

 private:
  void begin(int seed) {
    Base::begin(seed, false, [&](int j, Real to) { search.x[j] = to; });
  }
};
template <class Call> void find_chain(const Call& call) {
  auto space = call.space();
  GroupFinder<Call> finder(call, space.data());
  call.each_lane([&](int target) { finder.solve(call, target); });
}

// The same in scenes.
template <class Call> void find_free(const Call& call) {
  using Finder = GroupFinder<Call>;
  const auto robot = Finder::robot_of(call);
  auto space = call.space();
  Finder finder(call, space.data());
  auto freedom = finder.freedom_of(robot, space.data() + Finder::space_of(call));
  finder.take(&freedom);
  call.each_lane([&](int target) { finder.solve(call, target); });
}
}  // namespace osik
