// XLA's calls of kinematics and of rows of tasks on a CPU, in double precision.
#include "chain_explore.hpp"
#include "collision_calls.hpp"
#include "lane_collision.hpp"
#include "near_rows.hpp"
#include "way_around.hpp"
#include "xla.hpp"

using namespace osik;

namespace {
struct Robots : xla::Batch, Alone {
  using Collision = osik::Collision<double>;
  template <class F> void each_group(F f) const {
    each_lane([&](int lane) { f(lane, true); });
  }
};
template <void (*method)(const Robots&)> void of_lanes(const xla::Call& call) { method(Robots{{call}, {}}); }
template <void (*method)(const Robots&)> void* handle(xla::CallFrame* frame) { return xla::handle<of_lanes<method>>(frame); }
}  // namespace

extern "C" {
// Numbers of workspace of a GPU's thread.
int osik_clearances_space(int bodies, int dofs, int shapes, int rows) {
  return LaneCollision<double>::space_of(bodies, dofs, shapes, rows);
}
int osik_near_rows_space(int bodies, int dofs, int shapes, int rows, int most, int members) {
  const int share = most_pairs(shapes, rows, members);
  return NearRows<LaneCollision<float>>::space_of(most, share, members > 1) +
         osik_clearances_space(bodies, dofs, shapes, rows);
}
int osik_chain_find_space(int n, int frames, int joints, int nq) {
  return n + ChainFinder<Robots, true>::space_of(n, frames, joints, nq);
}
int osik_free_find_space(int n, int frames, int joints, int nq, int bodies, int dofs, int shapes, int rows) {
  return osik_chain_find_space(n, frames, joints, nq) + Freedom<Robots>::space_of(n) +
         osik_clearances_space(bodies, dofs, shapes, rows);
}

void* osik_free_find(xla::CallFrame* frame) { return handle<find_free<Robots>>(frame); }
void* osik_are_free(xla::CallFrame* frame) { return handle<find_free_ones<Robots>>(frame); }
void* osik_clearances(xla::CallFrame* frame) { return handle<find_clearances<Robots>>(frame); }
void* osik_near_rows(xla::CallFrame* frame) { return handle<find_near_rows<Robots>>(frame); }
void* osik_near_geometry(xla::CallFrame* frame) { return handle<find_near_geometry<Robots>>(frame); }
void* osik_shape_gaps(xla::CallFrame* frame) { return handle<find_gaps<Robots>>(frame); }
void* osik_ways(xla::CallFrame* frame) { return xla::handle<xla::of_batch<find_ways<&WayAround::connect>>>(frame); }
void* osik_free_curves(xla::CallFrame* frame) { return xla::handle<xla::of_batch<find_ways<&WayAround::prove>>>(frame); }
void* osik_chain_find(xla::CallFrame* frame) { return handle<find_chain<Robots>>(frame); }
void* osik_chain_steps(xla::CallFrame* frame) { return handle<advance_chain<Robots>>(frame); }
void* osik_kinematics(xla::CallFrame* frame) { return handle<place<Robots>>(frame); }
void* osik_moving_frames(xla::CallFrame* frame) { return handle<move_frames<Robots>>(frame); }
void* osik_center_of_mass(xla::CallFrame* frame) { return handle<move_centers<Robots>>(frame); }
void* osik_center_rows(xla::CallFrame* frame) { return handle<find_center_rows<Robots>>(frame); }
void* osik_frame_rows(xla::CallFrame* frame) { return handle<find_frame_rows<Robots>>(frame); }
void* osik_pose_rows(xla::CallFrame* frame) { return handle<find_pose_rows<Robots>>(frame); }
}
