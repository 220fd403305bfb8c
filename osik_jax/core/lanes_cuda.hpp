// A call of kinematic_calls.hpp, collision_calls.hpp, near_rows.hpp or chain_group.hpp on a GPU. A lane is one robot or target of the batch,
// and has one thread, or the few threads of a group, which are neighbours in a warp.
//
// The lanes are the fastest axis of matrices and of long results, so that the threads of a warp read and write neighbours. In
// all others the numbers of a lane are neighbours, as XLA has them. The text that includes this file defines Real, the sizes, and SPACE
// (core/_cuda.py: call_lanes).
#pragma once
#include "chain_group.hpp"
#include "collision_calls.hpp"
#include "lane_collision.hpp"
#include "near_rows.hpp"

namespace osik {

// An entry of an array. A constant one is an argument, which no thread writes: it may be read before results that stand
// earlier in the text are written.
template <class T> __device__ T& entry_of(T& at) { return at; }
template <class T> __device__ T entry_of(const T& at) { return __ldg(&at); }

// The numbers of one lane, `step` apart.
template <class T> struct Strided {
  using Number = NumberAt<T*>;
  T* at = nullptr;
  int step = 1;
  decltype(auto) operator[](int i) const { return entry_of(at[size_t(i) * step]); }
  Strided operator+(int i) const { return {at + size_t(i) * step, step}; }
  Strided& operator+=(int i) { return at += size_t(i) * step, *this; }
  explicit operator bool() const { return at; }
};

// Given: the sizes of arguments and results as functions, those whose lanes are the fastest axis, and the numbers of `Space`.
template <class R, class Sizes> struct ThreadCall {
  using Real = R;
  using In = Strided<const R>;
  using Out = Strided<R>;
  using Numbers = const R*;
  using Collision = LaneCollision<R>;
  struct Space {
    R numbers[Sizes::SPACE];
    R* data() { return numbers; }
  };
  const void* const* arguments;
  void* const* results;
  const R* const* kept;  // copies of arguments in shared memory, or null
  int lanes, members;  // of the batch; threads of each lane
  Space space() const {
    Space own;  // whoever uses it writes first
    return own;
  }
  int size(int k, int axis) const { return Sizes::argument(k, axis); }
  int result_size(int k, int axis) const { return Sizes::result(k, axis); }
  const int* integers(int k, int lane = 0) const {
    return static_cast<const int*>(arguments[k]) + (Sizes::argument(k, 0) == 1 ? 0 : size_t(lane) * Sizes::argument(k, 1));
  }
  // of an argument with one axis beside the lanes, whose numbers are neighbours
  Numbers numbers(int k, int lane) const { return kept[k] ? kept[k] : in(k, lane).at; }
  Strided<int> labels(int k, int lane) const {
    return of_lane(Strided<int>{static_cast<int*>(results[k])}, lane, Sizes::RESULTS_LANES_LAST >> k & 1,
                   Sizes::result(k, 1));
  }
  In in(int k, int lane) const {
    const In first{static_cast<const R*>(arguments[k])};
    return Sizes::argument(k, 0) == 1 ? first : of_lane(first, lane, Sizes::LANES_LAST >> k & 1, Sizes::argument(k, 1));
  }
  Out out(int k, int lane) const {
    const Out first{static_cast<R*>(results[k])};
    return of_lane(first, lane, Sizes::RESULTS_LANES_LAST >> k & 1, Sizes::result(k, 1));
  }
  // the numbers of one lane; count: how many there are, if they are neighbours, or 0 for one
  template <class At> At of_lane(At first, int lane, bool lanes_last, int count) const {
    return lanes_last ? At{first.at + lane, lanes} : At{first.at + size_t(lane) * (count ? count : 1), 1};
  }
  template <class F> void each_lane(F f) const {
    if (lane() < lanes) f(lane());
  }
  template <class F> void each_group(F f) const { f(lane() < lanes ? lane() : lanes - 1, lane() < lanes); }
  int lane() const { return (blockIdx.x * blockDim.x + threadIdx.x) / members; }
  int member() const { return threadIdx.x % members; }
  // The threads of this one's group.
  unsigned group() const { return (members == 32 ? ~0u : (1u << members) - 1) << threadIdx.x % 32 / members * members; }
  template <class T> T of_member(int k, T number) const { return __shfl_sync(group(), number, k, members); }
  int least_of_members(int number) const { return __reduce_min_sync(group(), number); }
  static bool any(bool flag) { return __any_sync(~0u, flag); }
  static bool is_time(bool waits, bool goes_on) {
    constexpr int ENOUGH = 24;
    const unsigned waiting = __ballot_sync(~0u, waits), going_on = __ballot_sync(~0u, goes_on);
    return waiting && (!going_on || __popc(waiting) >= ENOUGH);
  }
};
}  // namespace osik
