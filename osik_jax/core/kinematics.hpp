// Poses of bodies and axes of dofs, poses and Jacobians of frames, centre of mass: what kinematics/_forward.py defines.
//
// Bodies are in an order in which each comes after its parent; body 0 is the world. "Full" dofs are those of MuJoCo's
// model; each adds to one column of the joint velocity v with a factor, or is locked (column -1).
#pragma once
#include "rigid.hpp"

namespace osik {

enum JointType { FREE_JOINT = 0, BALL_JOINT = 1, SLIDE_JOINT = 2, HINGE_JOINT = 3 };  // MuJoCo's

// The robot's kinematic tree. In and Out, here and below: where numbers are, pointers or Strided (lanes_cuda.hpp).
template <class In> struct Tree {
  int bodies, joints, dofs;                        // dofs: full ones
  const int *parents, *types, *owners;             // [bodies]; [joints] type and body; joints of a body are neighbours
  In reference;                                    // [full nq] configuration at which bodies are where they are described
  In position, quaternion;                         // [bodies, 3], [bodies, 4] of each body in its parent
  In joint_position, joint_axis;                   // [joints, 3] in the joint's body
};

// Where everything is, in world axes.
template <class Out> struct Placed {
  Out position, rotation;          // [bodies, 3], [bodies, 9]
  Out linear, angular, anchor;     // [dofs, 3] direction, axis, and a point on the axis of each full dof
};

// Place the bodies at configuration q: [full nq].
template <class In, class Q, class Out> void place_bodies(const Tree<In>& tree, Q q, const Placed<Out>& to) {
  using Real = NumberAt<Out>;
  using V = Vec3<Real>;
  using Turn = Quaternion<Real>;
  const V zero{0, 0, 0};
  zero.put(to.position), Mat3<Real>::identity().put(to.rotation);
  In reference = tree.reference;
  Out linear = to.linear, angular = to.angular, anchor = to.anchor;
  auto add_dof = [&](V direction, V axis, V point) {
    direction.put(linear), axis.put(angular), point.put(anchor);
    linear += 3, angular += 3, anchor += 3;
  };
  for (int body = 1, joint = 0; body < tree.bodies; ++body) {
    const V origin = V::of(to.position + 3 * tree.parents[body]);
    const Mat3<Real> frame = Mat3<Real>::of(to.rotation + 9 * tree.parents[body]);
    V position = V::of(tree.position + 3 * body);
    Turn turn = Turn::of(tree.quaternion + 4 * body);
    const int first = joint;
    Out first_axis = angular;
    for (; joint < tree.joints && tree.owners[joint] == body; ++joint) {
      const int type = tree.types[joint];
      if (type == FREE_JOINT) {
        position = V::of(q), turn = Turn::of(q + 3).normalized();
        const V at = origin + frame * position;
        add_dof({1, 0, 0}, zero, at), add_dof({0, 1, 0}, zero, at), add_dof({0, 0, 1}, zero, at);
        for (int k = 0; k < 3; ++k) add_dof(zero, zero, at);
        q += 7, reference += 7;
        continue;
      }
      const V fixed = V::of(tree.joint_position + 3 * joint), given = V::of(tree.joint_axis + 3 * joint);
      const V own = turn.carry(fixed) + position, axis = turn.carry(given), at = origin + frame * own;
      if (type == BALL_JOINT) {
        turn = turn * Turn::of(q).normalized();
        position = own - turn.carry(fixed);
        for (int k = 0; k < 3; ++k) add_dof(zero, zero, at);
        q += 4, reference += 4;
        continue;
      }
      const Real displacement = q[0] - reference[0];
      q += 1, reference += 1;
      if (type == SLIDE_JOINT) {
        position = position + displacement * axis;
        add_dof(frame * axis, zero, at);
      } else {
        Real sine, cosine;
        sine_and_cosine(Real(Real(0.5) * displacement), sine, cosine);
        turn = turn * Turn{cosine, sine * given.x, sine * given.y, sine * given.z};
        position = own - turn.carry(fixed);
        add_dof(zero, frame * axis, at);
      }
    }
    (origin + frame * position).put(to.position + 3 * body);
    const Mat3<Real> rotation = frame * turn.rotation();
    rotation.put(to.rotation + 9 * body);
    const Mat3<Real> axes = rotation.transposed();
    for (int k = first; k < joint; ++k) {  // ball and free joints rotate about the axes of their body
      const int type = tree.types[k];
      first_axis += type == FREE_JOINT ? 9 : 0;
      if (type <= BALL_JOINT) axes.put(first_axis);
      first_axis += type <= BALL_JOINT ? 9 : 3;
    }
  }
}

// What each full dof does to the velocity: its column of v, -1 for none, and the factor.
template <class In> struct DofColumns {
  int dofs, nv;
  const int* column;  // [dofs]
  In factor;          // [dofs]
  bool alone() const { return dofs == nv; }  // whether each dof has a column of its own
};

// A velocity, and an angular velocity.
template <class Real> struct Twist {
  Vec3<Real> linear, angular;
};

// The motion of a point at `at` for a unit velocity of a full dof that carries it, times a factor.
template <class From, class Real> Twist<Real> motion_of(const Placed<From>& placed, int dof, Vec3<Real> at, Real factor) {
  using V = Vec3<Real>;
  const V axis = V::of(placed.angular + 3 * dof);
  const V speed = V::of(placed.linear + 3 * dof) + cross(axis, at - V::of(placed.anchor + 3 * dof));
  return {factor * speed, factor * axis};
}

// A frame that goes along with a body: offset [3] and turn [9] in the body, position [3] and rotation [9] in the world.
template <class In, class From, class Out>
Vec3<NumberAt<From>> place_frame(const Placed<From>& placed, int body, In offset, In turn, Out position, Out rotation) {
  using Real = NumberAt<From>;
  const Mat3<Real> carrier = Mat3<Real>::of(placed.rotation + 9 * body);
  const Vec3<Real> at = Vec3<Real>::of(placed.position + 3 * body) + carrier * Vec3<Real>::of(offset);
  at.put(position), (carrier * Mat3<Real>::of(turn)).put(rotation);
  return at;
}
// The same, and the Jacobian J [6, nv] of its point: rows [linear; angular]. moved: [dofs] flags
template <class In, class From, class Out> void move_frame(const DofColumns<In>& d, const Placed<From>& placed, int body,
                                                           In offset, In turn, const int* moved, Out position, Out rotation,
                                                           Out J) {
  using Real = NumberAt<Out>;
  const Vec3<Real> at = place_frame(placed, body, offset, turn, position, rotation);
  const bool alone = d.alone();
  for (int e = 0; e < 6 * d.nv && !alone; ++e) J[e] = 0;
  for (int dof = 0; dof < d.dofs; ++dof) {
    const int column = d.column[dof];
    if (column < 0 || !(moved[dof] || alone)) continue;
    const auto [speed, axis] = motion_of(placed, dof, at, Real(d.factor[dof]));
    Out to = J + column;
    auto add = [&](Real v) { to[0] = alone ? (moved[dof] ? v : Real(0)) : to[0] + v, to += d.nv; };
    add(speed.x), add(speed.y), add(speed.z), add(axis.x), add(axis.y), add(axis.z);
  }
}

// The columns of the Jacobian of the centre of mass: the mass that each full dof moves, at its centre, over the whole mass.
template <class In, class From> struct CenterColumns {
  using Real = NumberAt<From>;
  using V = Vec3<Real>;
  Placed<From> placed;
  DofColumns<In> dofs;
  const int* owner;   // [dofs] body of each full dof
  const Real* below;  // [bodies, 4] mass, and mass times position, of a body with all that hangs from it
  V operator[](int dof) const {
    const Real* carried = below + 4 * owner[dof];
    const V arm = V::of(carried + 1) - carried[0] * V::of(placed.anchor + 3 * dof);
    const Real factor = dofs.factor[dof] / below[0];
    return factor * (carried[0] * V::of(placed.linear + 3 * dof) + cross(V::of(placed.angular + 3 * dof), arm));
  }
};
template <class At> struct StoredCenterColumns {
  At J;  // [3, nv]
  int nv;
  Vec3<NumberAt<At>> operator[](int j) const { return {J[j], J[nv + j], J[2 * nv + j]}; }
};

// The centre of mass, and the columns of its Jacobian.
// mass: [bodies], center: [bodies, 3] in the body; owner: [dofs] body of each full dof; below: [bodies, 4] space
template <class In, class From, class Mass, class Out>
CenterColumns<In, From> find_center(const DofColumns<In>& d, const Placed<From>& placed, int bodies, const int* parents,
                                    const int* owner, Mass mass, In center, NumberAt<From>* below, Out point) {
  using Real = NumberAt<From>;
  using V = Vec3<Real>;
  OSIK_UNROLL_4
  for (int body = 0; body < bodies; ++body) {
    const V at = V::of(placed.position + 3 * body) + Mat3<Real>::of(placed.rotation + 9 * body) * V::of(center + 3 * body);
    below[4 * body] = mass[body], (mass[body] * at).put(below + 4 * body + 1);
  }
  for (int body = bodies - 1; body > 0; --body) OSIK_UNROLL_4
  for (int i = 0; i < 4; ++i) below[4 * parents[body] + i] += below[4 * body + i];
  OSIK_UNROLL_4
  for (int i = 0; i < 3; ++i) point[i] = below[1 + i] / below[0];
  return {placed, d, owner, below};
}
// The Jacobian J [3, nv] of the centre of mass: dofs with the same entry of v are added.
template <class In, class From, class Out> void put_jacobian(const CenterColumns<In, From>& columns, Out J) {
  const DofColumns<In>& d = columns.dofs;
  for (int e = 0; e < 3 * d.nv; ++e) J[e] = 0;
  for (int dof = 0; dof < d.dofs; ++dof) {
    const int column = d.column[dof];
    if (column < 0) continue;
    const auto [x, y, z] = columns[dof];
    J[column] += x, J[d.nv + column] += y, J[2 * d.nv + column] += z;
  }
}
// f(the columns of the Jacobian by entries of v): those of the dofs, where each has an entry of its own, else from J, a space
// [3, nv].
template <class In, class From, class F> void with_columns(const CenterColumns<In, From>& columns, NumberAt<From>* J, F f) {
  if (columns.dofs.alone()) return f(columns);
  put_jacobian(columns, J), f(StoredCenterColumns<const NumberAt<From>*>{J, columns.dofs.nv});
}
}  // namespace osik
