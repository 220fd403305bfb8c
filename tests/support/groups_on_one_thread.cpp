// The GPU's text of searches for poses and of shapes, by groups of one thread on a CPU.
#include "chain_group.hpp"
#include "collision_calls.hpp"
#include "lane_collision.hpp"
#include "xla.hpp"

using namespace osik;

namespace {
struct OneThread : xla::Batch {
  using Collision = LaneCollision<double>;
  static constexpr int members = 1, SPACE = 20000;
  Space space() const { return Space(SPACE, INFINITE); }
  static int member() { return 0; }
  template <class T> static T of_member(int, T number) { return number; }
  static int least_of_members(int number) { return number; }
  static bool any(bool flag) { return flag; }
  static bool is_time(bool waits, bool) { return waits; }
  template <class F> void each_group(F f) const {
    each_lane([&](int lane) { f(lane, true); });
  }
};
template <void (*method)(const OneThread&)> void of_lanes(const xla::Call& call) { method(OneThread{{call}}); }
}  // namespace

extern "C" {
void* osik_chain_find(xla::CallFrame* frame) { return xla::handle<of_lanes<find_chain<OneThread>>>(frame); }
void* osik_free_find(xla::CallFrame* frame) { return xla::handle<of_lanes<find_free<OneThread>>>(frame); }
void* osik_clearances(xla::CallFrame* frame) { return xla::handle<of_lanes<find_clearances<OneThread>>>(frame); }
void* osik_are_free(xla::CallFrame* frame) { return xla::handle<of_lanes<find_free_ones<OneThread>>>(frame); }
}
