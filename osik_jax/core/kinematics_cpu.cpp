// XLA's calls of kinematics and of rows of tasks on a CPU, in double precision.
//
// An argument's leading axis is that of the lanes, or has length 1 where all lanes share it.
#include <vector>

#include "task_rows.hpp"
#include "xla.hpp"

using namespace osik;

namespace {
using Real = double;
using Team = Serial<Real>;

// Arguments 0 to 4 are the fields of Kinematics.
Placed<Real> placed(const xla::Call& call, int lane) {
  auto field = [&](int k) { return const_cast<Real*>(xla::lane_of(call, k, lane)); };  // only read
  return {field(0), field(1), field(2), field(3), field(4)};
}
using Integers = xla::Reader<int>;

// Arguments and results as in kinematics/_kernels.py: bodies.
void place(const xla::Call& call) {
  const int lanes = int(call.result(0).dimensions[0]), bodies = int(call.result(0).dimensions[1]);
  const int dofs = int(call.result(2).dimensions[1]);
  const int nq = *call.in<int>(2), joints = (call.size(2, 0) - 1 - bodies - nq) / 2;  // nq: of MuJoCo's configuration
  Integers integers{call.in<int>(2) + 1};
  Tree<Real> tree{bodies, joints, dofs};
  tree.parents = integers.take(bodies), tree.types = integers.take(joints), tree.owners = integers.take(joints);
  const int* source = integers.take(nq);
  std::vector<Real> q(nq);
  for (int lane = 0; lane < lanes; ++lane) {
    const Real* given = xla::lane_of(call, 0, lane);
    xla::Reader<Real> numbers{xla::lane_of(call, 1, lane)};
    const Real *factor = numbers.take(nq), *offset = numbers.take(nq);
    for (int i = 0; i < nq; ++i) q[i] = factor[i] * given[source[i]] + offset[i];
    tree.reference = numbers.take(nq), tree.position = numbers.take(3 * bodies), tree.quaternion = numbers.take(4 * bodies);
    tree.joint_position = numbers.take(3 * joints), tree.joint_axis = numbers.take(3 * joints);
    const size_t body = size_t(lane) * bodies, dof = size_t(lane) * dofs;
    place_bodies(tree, q.data(), {call.out<Real>(0) + 3 * body, call.out<Real>(1) + 9 * body, call.out<Real>(2) + 3 * dof,
                           call.out<Real>(3) + 3 * dof, call.out<Real>(4) + 3 * dof});
  }
}

// Arguments and results as in kinematics/_kernels.py: moving_frames.
void move_frames(const xla::Call& call) {
  const int lanes = int(call.result(0).dimensions[0]), count = int(call.result(0).dimensions[1]);
  const int nv = int(call.result(2).dimensions[3]), dofs = call.size(2, 1);
  Integers integers{call.in<int>(6)};
  const int *carrier = integers.take(count), *column = integers.take(dofs), *moved = integers.at;
  for (int lane = 0; lane < lanes; ++lane) {
    xla::Reader<Real> numbers{xla::lane_of(call, 5, lane)};
    const DofColumns<Real> columns{dofs, nv, column, numbers.take(dofs)};
    const Real *offset = numbers.take(3 * count), *turn = numbers.take(9 * count);
    const Placed<Real> there = placed(call, lane);
    for (int k = 0; k < count; ++k) {
      const size_t frame = size_t(lane) * count + k;
      move_frame(columns, there, carrier[k], offset + 3 * k, turn + 9 * k, moved + k * dofs,
                 call.out<Real>(0) + 3 * frame, call.out<Real>(1) + 9 * frame, call.out<Real>(2) + 6 * nv * frame);
    }
  }
}

// The centre of mass of one lane: arguments 0 to 6 as in kinematics/_kernels.py, center_arguments.
struct Center {
  int bodies, dofs, nv;
  Integers integers;
  const int *parents, *owner, *column;
  std::vector<Real> below;
  Center(const xla::Call& call, int nv)
      : bodies(call.size(0, 1)), dofs(call.size(2, 1)), nv(nv), integers{call.in<int>(6)}, parents(integers.take(bodies)),
        owner(integers.take(dofs)), column(integers.take(dofs)), below(4 * bodies) {}
  void find(const xla::Call& call, int lane, Real* point, Real* J) {
    xla::Reader<Real> numbers{xla::lane_of(call, 5, lane)};
    const DofColumns<Real> columns{dofs, nv, column, numbers.take(dofs)};
    const Real *mass = numbers.take(bodies), *center = numbers.take(3 * bodies);
    move_center(columns, placed(call, lane), bodies, parents, owner, mass, center, below.data(), point, J);
  }
};
void move_centers(const xla::Call& call) {
  const int lanes = int(call.result(0).dimensions[0]), nv = int(call.result(1).dimensions[2]);
  Center center(call, nv);
  for (int lane = 0; lane < lanes; ++lane)
    center.find(call, lane, call.out<Real>(0) + 3 * lane, call.out<Real>(1) + size_t(3) * nv * lane);
}

// Results of rows of tasks: error, rows, wanted velocity, curvature, pull, levers.
Rows<Real> rows_of(const xla::Call& call, size_t lane) {
  const size_t m = call.result(1).dimensions[1], nv = call.result(1).dimensions[2];
  return {call.out<Real>(0) + m * lane, call.out<Real>(1) + m * nv * lane, call.out<Real>(2) + m * lane,
          call.out<Real>(3) + lane,     call.out<Real>(4) + m * lane,      call.out<Real>(5) + nv * lane};
}

// Arguments as in tasks/_com.py.
void find_center_rows(const xla::Call& call) {
  const int lanes = int(call.result(1).dimensions[0]), m = int(call.result(1).dimensions[1]);
  const int nv = int(call.result(1).dimensions[2]);
  Center center(call, nv);
  const int *axes = center.integers.take(m), *turning = center.integers.take(nv);
  std::vector<Real> J(3 * nv);
  Real point[3];
  for (int lane = 0; lane < lanes; ++lane) {
    center.find(call, lane, point, J.data());
    xla::Reader<Real> numbers{xla::lane_of(call, 7, lane)};
    CenterGoal<Real> goal{m, axes, turning};
    goal.target = numbers.take(m), goal.velocity = numbers.take(m), goal.weight = numbers.take(m), goal.gain = numbers.at;
    center_rows(Team(), goal, point, J.data(), nv, rows_of(call, lane));
  }
}

// Arguments as in tasks/_pose.py.
void find_pose_rows(const xla::Call& call) {
  const int lanes = int(call.result(1).dimensions[0]), m = int(call.result(1).dimensions[1]);
  const int nv = int(call.result(1).dimensions[2]);
  const int* options = call.in<int>(4);
  for (int lane = 0; lane < lanes; ++lane) {
    xla::Reader<Real> numbers{xla::lane_of(call, 3, lane)};
    PoseGoal<Real> goal{};
    goal.position = numbers.take(3), goal.rotation = numbers.take(9), goal.velocity = numbers.take(6);
    goal.weight = numbers.take(m), goal.gain = numbers.at, goal.kept = options;
    goal.in_frame = options[6] != 0, goal.geometric = options[7] != 0;
    pose_rows(Team(), goal, xla::lane_of(call, 0, lane), xla::lane_of(call, 1, lane), xla::lane_of(call, 2, lane), nv,
              rows_of(call, lane));
  }
}
}  // namespace

extern "C" {
void* osik_kinematics(xla::CallFrame* frame) { return xla::handle<place>(frame); }
void* osik_moving_frames(xla::CallFrame* frame) { return xla::handle<move_frames>(frame); }
void* osik_center_of_mass(xla::CallFrame* frame) { return xla::handle<move_centers>(frame); }
void* osik_center_rows(xla::CallFrame* frame) { return xla::handle<find_center_rows>(frame); }
void* osik_pose_rows(xla::CallFrame* frame) { return xla::handle<find_pose_rows>(frame); }
}
