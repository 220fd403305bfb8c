// Kinematics and rows of tasks of a batch: what kinematics/_kernels.py, tasks/_pose.py, tasks/_frame.py and tasks/_com.py call.
//
// A call has arguments and results with a leading axis of lanes, or of length 1 where all lanes share one argument:
//   size(k, axis), result_size(k, axis)   the length of an axis of argument or result k
//   integers(k), integers(k, lane)        argument k, integers that all lanes share; those of one lane
//   in(k, lane), out(k, lane)             the numbers of one lane: pointers (In, Out), or what stands for them
//   each_lane(f)                          f(lane) for all lanes, or for the one of a GPU's thread
//   numbers(k, lane), labels(k, lane)     numbers that are neighbours, by a pointer (Numbers); integers of a result
//   Collision                             what places shapes (collision.hpp, lane_collision.hpp)
//   space()                               numbers to work with, a Space: as many as the caller in Python says
// Both calls are written for it: one of a CPU (xla.hpp: Batch), one of a GPU (lanes_cuda.hpp).
#pragma once
#include "tasks/center.hpp"
#include "tasks/pose.hpp"

namespace osik {

// Hands out one array after another.
template <class At> struct Reader {
  At at;
  At take(int count) {
    const At first = at;
    at += count;
    return first;
  }
};

// Numbers of MuJoCo's configuration: of the given one by a factor and an offset.
template <class In> struct Configuration {
  using Number = NumberAt<In>;
  In given, factor, offset;
  const int* source;
  Number operator[](int i) const { return factor[i] * given[source[i]] + offset[i]; }
  Configuration operator+(int i) const { return {given, factor + i, offset + i, source + i}; }
  Configuration& operator+=(int i) { return *this = *this + i; }
};

// Arguments 0 to 4 are the fields of Kinematics.
template <class Call> Placed<typename Call::In> placed(const Call& call, int lane) {
  return {call.in(0, lane), call.in(1, lane), call.in(2, lane), call.in(3, lane), call.in(4, lane)};
}

// Arguments and results as in kinematics/_kernels.py: bodies.
template <class Call> void place(const Call& call) {
  using In = typename Call::In;
  const int bodies = call.result_size(0, 1), dofs = call.result_size(2, 1);
  const int nq = *call.integers(2), joints = (call.size(2, 0) - 1 - bodies - nq) / 2;  // nq: of MuJoCo's configuration
  Reader<const int*> integers{call.integers(2) + 1};
  Tree<In> tree{};
  tree.bodies = bodies, tree.joints = joints, tree.dofs = dofs;
  tree.parents = integers.take(bodies), tree.types = integers.take(joints), tree.owners = integers.take(joints);
  const int* source = integers.take(nq);
  call.each_lane([&](int lane) {
    Reader<In> numbers{call.in(1, lane)};
    const In factor = numbers.take(nq), offset = numbers.take(nq);
    tree.reference = numbers.take(nq), tree.position = numbers.take(3 * bodies), tree.quaternion = numbers.take(4 * bodies);
    tree.joint_position = numbers.take(3 * joints), tree.joint_axis = numbers.take(3 * joints);
    place_bodies(tree, Configuration<In>{call.in(0, lane), factor, offset, source},
                 Placed<typename Call::Out>{call.out(0, lane), call.out(1, lane), call.out(2, lane), call.out(3, lane),
                                            call.out(4, lane)});
  });
}

// Arguments and results as in kinematics/_kernels.py: moving_frames.
template <class Call> void move_frames(const Call& call) {
  using In = typename Call::In;
  const int count = call.result_size(0, 1), nv = call.result_size(2, 3), dofs = call.size(2, 1);
  Reader<const int*> integers{call.integers(6)};
  const int *carrier = integers.take(count), *column = integers.take(dofs), *moved = integers.at;
  call.each_lane([&](int lane) {
    Reader<In> numbers{call.in(5, lane)};
    const DofColumns<In> columns{dofs, nv, column, numbers.take(dofs)};
    const In offset = numbers.take(3 * count), turn = numbers.take(9 * count);
    const auto there = placed(call, lane);
    for (int k = 0; k < count; ++k)
      move_frame(columns, there, carrier[k], offset + 3 * k, turn + 9 * k, moved + k * dofs, call.out(0, lane) + 3 * k,
                 call.out(1, lane) + 9 * k, call.out(2, lane) + 6 * nv * k);
  });
}

// The centre of mass: arguments 0 to 6 as in kinematics/_kernels.py, center_arguments.
template <class Call> struct Center {
  using In = typename Call::In;
  int bodies, dofs, nv;
  Reader<const int*> integers;
  const int *parents, *owner, *column;
  typename Call::Space space;  // [bodies, 4] of what is below each body, then what the caller of `find` needs
  Center(const Call& call, int nv)
      : bodies(call.size(0, 1)), dofs(call.size(2, 1)), nv(nv), integers{call.integers(6)}, parents(integers.take(bodies)),
        owner(integers.take(dofs)), column(integers.take(dofs)), space(call.space()) {}
  template <class Out> CenterColumns<In, In> find(const Call& call, int lane, Out point) {
    Reader<In> numbers{call.in(5, lane)};
    const DofColumns<In> columns{dofs, nv, column, numbers.take(dofs)};
    const In mass = numbers.take(bodies), center = numbers.take(3 * bodies);
    return find_center(columns, placed(call, lane), bodies, parents, owner, mass, center, space.data(), point);
  }
};
template <class Call> void move_centers(const Call& call) {
  Center<Call> center(call, call.result_size(1, 2));
  call.each_lane([&](int lane) { put_jacobian(center.find(call, lane, call.out(0, lane)), call.out(1, lane)); });
}

// Results of rows of tasks: error, rows, wanted velocity, curvature, pull, levers, squared lengths of the rows.
template <class Call> Rows<typename Call::Out> rows_of(const Call& call, int lane) {
  return {
      call.out(0, lane), call.out(1, lane), call.out(2, lane), call.out(3, lane), call.out(4, lane), call.out(5, lane), {},
      call.out(6, lane)};
}

// Arguments as in tasks/_com.py.
template <class Call> void find_center_rows(const Call& call) {
  using In = typename Call::In;
  const int m = call.result_size(1, 1), nv = call.result_size(1, 2);
  Center<Call> center(call, nv);
  const int *axes = center.integers.take(m), *turning = center.integers.take(nv);
  call.each_lane([&](int lane) {
    typename Call::Real point[3];
    const auto columns = center.find(call, lane, point + 0);
    Reader<In> numbers{call.in(7, lane)};
    CenterGoal<In> goal{};
    goal.m = m, goal.axes = axes, goal.turning = turning;
    goal.target = numbers.take(m), goal.velocity = numbers.take(m), goal.weight = numbers.take(m), goal.gain = numbers.at;
    with_columns(columns, center.space.data() + 4 * center.bodies,
                 [&](auto columns) { center_rows(goal, point + 0, columns, nv, rows_of(call, lane)); });
  });
}

// What a pose task asks for: its target, velocity, weights and gain, one after another, and eight options.
template <class In> PoseGoal<In> pose_goal(Reader<In> numbers, int m, const int* options) {
  PoseGoal<In> goal{};
  goal.position = numbers.take(3), goal.rotation = numbers.take(9), goal.velocity = numbers.take(6);
  goal.weight = numbers.take(m), goal.gain = numbers.at, goal.kept = options;
  goal.in_frame = options[6] != 0, goal.geometric = options[7] != 0;
  return goal;
}

// Arguments as in tasks/_pose.py.
template <class Call> void find_pose_rows(const Call& call) {
  using In = typename Call::In;
  const int m = call.result_size(1, 1), nv = call.result_size(1, 2);
  call.each_lane([&](int lane) {
    const auto goal = pose_goal(Reader<In>{call.in(3, lane)}, m, call.integers(4));
    const StoredColumns<In> columns{call.in(2, lane), nv};
    pose_rows(goal, call.in(0, lane), call.in(1, lane), columns, nv, rows_of(call, lane));
  });
}

// Arguments as in tasks/_frame.py.
template <class Call> void find_frame_rows(const Call& call) {
  using In = typename Call::In;
  using Real = typename Call::Real;
  const int m = call.result_size(1, 1), nv = call.result_size(1, 2);
  const int body = *call.integers(7), *moved = call.integers(7) + 1;
  call.each_lane([&](int lane) {
    Reader<In> numbers{call.in(5, lane)};
    const In factor = numbers.take(nv), offset = numbers.take(3), turn = numbers.take(9);
    const auto there = placed(call, lane);
    Real position[3], rotation[9];
    const auto at = place_frame(there, body, offset, turn, position + 0, rotation + 0);
    const CarriedColumns<In, In> columns{there, factor, moved, at};
    const auto goal = pose_goal(Reader<In>{call.in(6, lane)}, m, moved + nv);
    pose_rows(goal, position + 0, rotation + 0, columns, nv, rows_of(call, lane));
  });
}
}  // namespace osik
