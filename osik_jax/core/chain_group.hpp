// Whole searches for poses on a GPU (chain_find.hpp): some threads of a warp, the members of a group, take the searches of a
// target in turn. Where there is a solution, the answer is that of the first search with one, in the order of their numbers:
// it depends neither on how many members there are nor on other targets.
//
// Whether solutions are free is asked for many threads of a warp at once: it takes a thread alone as long as all of them.
//
// A call has further words here:
//   member(), members          the number of a thread in its group, and how many there are
//   of_member(k, number)       the number that member k gives
//   least_of_members(number)   the least one
//   any(flag)                  whether the flag of any thread of the warp is set
//   is_time(waits, goes_on)    whether so many threads of the warp wait, or so few go on, that it is their turn
//   each_group(f)              f(lane, is_real) for all threads of the warp, of which the last may have no lane
#pragma once
#include "chain_find.hpp"

namespace osik {

template <class Call, bool IN_SCENE> class GroupFinder : public ChainFinder<Call, IN_SCENE> {
  using Base = ChainFinder<Call, IN_SCENE>;
  using Base::NEVER, Base::n, Base::check, Base::trial, Base::longest, Base::progress, Base::here, Base::search,
      Base::freedom, Base::is_unchecked;
  using typename Base::Real, typename Base::Errors, typename Base::In;
  enum End { FOUND, BLOCKED, TOUCHING, UNMET };  // of a member, the best one first
  static constexpr int NONE = -1;
  Real* best;  // [n] where nothing is found

 public:
  GroupFinder(const Call& call, Real* space) : Base(call, space), best(space + Base::space_of(call)) {}
  static int space_of(const Call& call) { return Base::space_of(call) + call.size(5, 1); }

  void solve(const Call& call, int target, bool is_real) {
    const In goal = call.in(0, target);
    const int most = is_real ? this->begin_target(call, target) : 0, member = call.member();
    int first = most, seed, age, best_seed = 0, steps = 0;  // first: search with a solution; NONE: there cannot be any
    Real cost, least = NEVER;
    bool waits = false;  // its search has led to a solution, which has to be free
    auto own = search;  // whose numbers stay in registers
    auto begin = [&](int to) {
      seed = to, age = 0, cost = NEVER, waits = false;
      if (seed < first) Base::begin(seed, false, [&](int j, Real x) { own.x[j] = x; });
    };
    for (int j = 0; j < n; ++j) best[j] = search.start[j];
    begin(member);
    while (call.any(seed < first)) {
      if (seed < first && !waits) {
        const Errors errors = own.advance(check, goal, here);
        const bool is_met = errors.score <= (IN_SCENE || is_unchecked ? Real(1) : own.enough);
        steps += check, age += check;
        if (errors.score < least && !(IN_SCENE && is_met)) {
          least = errors.score, best_seed = seed;
          for (int j = 0; j < n; ++j) best[j] = here[j];
        }
        const bool is_stuck = age > trial && !(errors.cost < progress * cost);
        cost = errors.cost;
        if (errors.score <= own.enough || is_stuck || age >= longest) {
          if (!is_met) begin(seed + call.members);
          else if (IN_SCENE) waits = true;
          else first = best_seed = seed;
        }
      }
      const bool goes_on = seed < first, asks = goes_on && waits;
      if (IN_SCENE && call.is_time(asks, goes_on && !waits) && asks) {
        waits = false;
        if (this->is_free_end(goal, seed, search.x)) first = best_seed = seed;
        else if (freedom->is_blocked) first = NONE;
        else begin(seed + call.members);
      }
      first = call.least_of_members(first);
    }
    End end = first != NONE && first < most && first % call.members == member ? FOUND : UNMET;
    if (end != FOUND)
      for (int j = 0; j < n; ++j) here[j] = best[j];
    if (end != FOUND && IN_SCENE && freedom->has_rejected()) {
      end = freedom->is_blocked ? BLOCKED : TOUCHING;
      if (first == NONE || first == most) least = -freedom->take_least_wrong(here, best_seed);
    }
    int chosen = 0, all_steps = 0, best_end = end;
    Real best_least = NEVER;
    for (int k = 0; k < call.members; ++k) {
      const int its_end = call.of_member(k, int(end));
      const Real its_least = call.of_member(k, least);
      all_steps += call.of_member(k, steps);
      if (k && !(its_end < best_end || (its_end == best_end && its_least < best_least))) continue;
      chosen = k, best_end = its_end, best_least = its_least;
    }
    if (is_real && chosen == member) this->answer(call, target, best_seed, all_steps);
  }
};

template <class Call> void find_chain(const Call& call) {
  auto space = call.space();
  GroupFinder<Call, false> finder(call, space.data());
  call.each_group([&](int target, bool is_real) { finder.solve(call, target, is_real); });
}

// The same in scenes.
template <class Call> void find_free(const Call& call) {
  using Finder = GroupFinder<Call, true>;
  const auto robot = Finder::robot_of(call);
  auto space = call.space();
  Finder finder(call, space.data());
  auto freedom = finder.freedom_of(robot, space.data() + Finder::space_of(call));
  finder.take(&freedom);
  call.each_group([&](int target, bool is_real) { finder.solve(call, target, is_real); });
}
}  // namespace osik
