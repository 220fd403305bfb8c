// XLA's calls of kinematics and of rows of tasks on a CPU, in double precision.
#include <vector>

#include "chain_find.hpp"
#include "way_around.hpp"
#include "near_rows.hpp"
#include "xla.hpp"

using namespace osik;

namespace {
struct Robots {
  using Real = double;
  using In = const double*;
  using Out = double*;
  using Space = std::vector<double>;
  xla::Call call;
  Space space() const { return Space(xla::number(call.frame->attributes, "space")); }
  int size(int k, int axis) const { return call.size(k, axis); }
  int result_size(int k, int axis) const { return call.result_size(k, axis); }
  const int* integers(int k) const { return call.in<int>(k); }
  In in(int k, int lane) const { return xla::lane_of(call, k, lane); }
  Out out(int k, int lane) const { return call.out<double>(k) + xla::numbers_of_lane(call.result(k)) * lane; }
  template <class F> void each_lane(F f) const {
    for (int lane = 0; lane < result_size(0, 0); ++lane) f(lane);
  }
};
template <void (*method)(const Robots&)> void of_lanes(const xla::Call& call) { method(Robots{call}); }
}  // namespace

extern "C" {
void* osik_free_find(xla::CallFrame* frame) { return xla::handle<find_free>(frame); }
void* osik_are_free(xla::CallFrame* frame) { return xla::handle<find_free_ones>(frame); }
void* osik_clearances(xla::CallFrame* frame) { return xla::handle<find_clearances>(frame); }
void* osik_near_rows(xla::CallFrame* frame) { return xla::handle<find_near_rows>(frame); }
void* osik_shape_gaps(xla::CallFrame* frame) { return xla::handle<find_gaps>(frame); }
void* osik_ways(xla::CallFrame* frame) { return xla::handle<find_ways<&WayAround::connect>>(frame); }
void* osik_free_curves(xla::CallFrame* frame) { return xla::handle<find_ways<&WayAround::prove>>(frame); }
void* osik_chain_find(xla::CallFrame* frame) { return xla::handle<find_chain>(frame); }
void* osik_chain_steps(xla::CallFrame* frame) { return xla::handle<of_lanes<advance_chain<Robots>>>(frame); }
void* osik_kinematics(xla::CallFrame* frame) { return xla::handle<of_lanes<place<Robots>>>(frame); }
void* osik_moving_frames(xla::CallFrame* frame) { return xla::handle<of_lanes<move_frames<Robots>>>(frame); }
void* osik_center_of_mass(xla::CallFrame* frame) { return xla::handle<of_lanes<move_centers<Robots>>>(frame); }
void* osik_center_rows(xla::CallFrame* frame) { return xla::handle<of_lanes<find_center_rows<Robots>>>(frame); }
void* osik_frame_rows(xla::CallFrame* frame) { return xla::handle<of_lanes<find_frame_rows<Robots>>>(frame); }
void* osik_pose_rows(xla::CallFrame* frame) { return xla::handle<of_lanes<find_pose_rows<Robots>>>(frame); }
}
