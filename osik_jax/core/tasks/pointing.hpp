// Tasks that point an axis of a frame along a direction or at a point: what tasks/_pointing.py defines.
#pragma once
#include "pose.hpp"

namespace osik {

// A vector over its length, without overflow of squares; 0 stays 0.
template <class Real> Vec3<Real> unit(Vec3<Real> v) {
  const Real size = largest_entry(v);
  v = select((size > Real(0)) & (size < Real(INFINITE)), Real(1) / size, Real(1)) * v;
  const Real length = sqrt(inner(v, v));
  return select(length > Real(0), Real(1) / length, Real(1)) * v;
}

// The error e of two unit vectors, and D with e' = D d' for a rate d' across the second: tasks/_pointing.py, deviation.
template <class Real> struct Deviation {
  Real e[2];
  Vec3<Real> D[2];
};
inline Deviation<double> deviation(Vec3<double> a, Vec3<double> d) {
  const double sign = a.z < 0 ? -1 : 1, c = -1 / (sign + a.z), xy = a.x * a.y * c;
  const Vec3<double> across[] = {{1 + sign * a.x * a.x * c, sign * xy, -sign * a.x}, {xy, sign + a.y * a.y * c, -a.y}};
  const double cosine = inner(a, d), beside[] = {inner(across[0], d), inner(across[1], d)};
  const double squared = beside[0] * beside[0] + beside[1] * beside[1], sine = sqrt(squared), angle = atan2(sine, cosine);
  Deviation<double> to;
  // D = -(ratio carried + bend way way' carried), e = -size way
  auto put = [&](double ratio, double bend, double size, const double* way, const Vec3<double>* carried) {
    const Vec3<double> along = way[0] * carried[0] + way[1] * carried[1];
    for (int i = 0; i < 2; ++i) to.e[i] = -size * way[i], to.D[i] = (-ratio) * carried[i] - bend * way[i] * along;
  };
  if (cosine < BEHIND) {
    const bool clear = squared > EPSILON * EPSILON;
    const double way[] = {clear ? beside[0] / sine : 1, clear ? beside[1] / sine : 0};
    const double turned = clear ? angle : atan2(0., cosine), ratio = turned / (sine > LEAST_SINE ? sine : LEAST_SINE);
    put(ratio, 1 / cosine - ratio, turned, way, across);
  } else {
    const bool is_small = squared < POINTING_SINE_SQUARED && cosine > 0;
    const double s = squared, series = 1. / 6 + s * (3. / 40 + s * (5. / 112 + s * (35. / 1152 + s * 63 / 2816)));
    const double growth = is_small ? -series : (1 - angle / sine) / s, ratio = 1 - growth * s;
    Vec3<double> carried[2];
    for (int i = 0; i < 2; ++i) carried[i] = across[i] - beside[i] / (1 + cosine) * a;
    put(ratio, growth, ratio, beside, carried);
  }
  return to;
}
template <class R> Deviation<Lanes<R>> deviation(const Vec3<Lanes<R>>& a, const Vec3<Lanes<R>>& d) {
  Deviation<Lanes<R>> to;
  for (int k = 0; k < Lanes<R>::COUNT; ++k) {
    const Deviation<R> one = deviation(lane_of(a, k), lane_of(d, k));
    for (int i = 0; i < 2; ++i)
      to.e[i].v[k] = one.e[i], to.D[i].x.v[k] = one.D[i].x, to.D[i].y.v[k] = one.D[i].y, to.D[i].z.v[k] = one.D[i].z;
  }
  return to;
}
// An angle from its square, rounded off near 0 [rad].
template <class Real> Real rounded(Real squared) {
  constexpr double TIP = CONE_TIP;
  return select(squared < Real(TIP * TIP), squared / Real(2 * TIP) + Real(0.5 * TIP), sqrt(squared));
}

struct PointingTask : FramedCard<1> {
  enum { AXIS = OWN, TARGET };  // leaves; a cone's upper bound is half its opening
  enum { AT_POINT };  // option, then the frames, of which the second one carries the target
  static int velocities(int) { return 3; }
  template <class File, class Task> static void check(const File& file, const Task& task) {
    file.check_leaf(task.leaves[AXIS], 3), file.check_leaf(task.leaves[TARGET], 3);
    file.require(task.m == (task.bounded ? 1 : 2), "rows"), check_frames(file, task);
  }
  template <class Step, class Task> static bool is_valid(const Step& step, const Task& task) {
    return step.is_finite(task, AXIS) && step.is_finite(task, TARGET);
  }
  template <class Own, class Task, class Interval, class Real, class To>
  static void add(Own& own, const Task& task, const Interval& interval, const Real* gain, const To& to) {
    using V = Vec3<Real>;
    const Frames<Own> frames{own, task.options};
    frames.move();
    const int nv = own.s.nv, m = task.m;
    const bool at_point = task.options[AT_POINT], carried = frames.count() == 2;
    const auto R = Mat3<Real>::of(frames.rotation), carrier = carried ? Mat3<Real>::of(frames.rotation + 9) : R.identity();
    const auto back = R.transposed();
    const V axis = unit(V::of(own.leaf(task.leaves[AXIS]).at)), velocity = carrier * V::of(own.velocity(task));
    V goal = V::of(own.leaf(task.leaves[TARGET]).at);
    if (!at_point) goal = unit(goal);
    const V arm = carrier * goal;
    V sight = arm;
    Real per_distance = 0, sees = 1;  // 0 where the point is too near
    if (at_point) {
      const V line = (carried ? V::of(frames.position + 3) + arm : arm) - V::of(frames.position), ahead = R * axis;
      const Real squared = inner(line, line);
      const auto near = squared < Real(NEAREST_SIGHT * NEAREST_SIGHT);
      per_distance = Real(1) / sqrt(select(near, Real(1), squared)), sees = select(near, Real(0), Real(1));
      auto chosen = [&](Real a, Real b) { return select(near, a, per_distance * b); };
      sight = {chosen(ahead.x, line.x), chosen(ahead.y, line.y), chosen(ahead.z, line.z)};
    }
    // the rate of the direction, seen from the frame, where target and frame move so
    auto rate = [&](Twist<Real> target, Twist<Real> eye) {
      if (!at_point) return back * cross(sight, eye.angular - target.angular);
      const V along = target.linear + cross(target.angular, arm) - eye.linear;
      return sees * (back * (per_distance * (along - inner(sight, along) * sight) + cross(sight, eye.angular)));
    };
    const V drift = rate(at_point ? Twist<Real>{velocity, {0, 0, 0}} : Twist<Real>{{0, 0, 0}, velocity}, Twist<Real>{});
    Deviation<Real> off = deviation(axis, back * sight);
    Real none = -INFINITE, upper = 0;
    Bounds<const Real*> bounds;
    if (task.bounded) {
      const Real squared = off.e[0] * off.e[0] + off.e[1] * off.e[1], angle = sqrt(squared), half = interval.upper[0];
      const Real least = select(angle > Real(CONE_TIP), angle, Real(CONE_TIP));
      off.D[0] = Real(1) / least * (off.e[0] * off.D[0] + off.e[1] * off.D[1]), off.e[0] = rounded(squared);
      upper = rounded(half * half), bounds = {&none, &upper};
    }
    Real squares[2] = {0, 0}, turning = 0;
    for (int i = 0; i < m; ++i) own.weights[i] = own.leaf(task.leaves[WEIGHT])[i];
    for (int j = 0; j < nv; ++j) {
      const V column = rate(carried ? frames.columns(1)[j] : Twist<Real>{}, frames.columns(0)[j]);
      Real lever = 0;
      for (int i = 0; i < m; ++i) {
        const Real entry = inner(off.D[i], column), square = entry * entry;
        to.jacobian[i * nv + j] = entry, squares[i] += square, lever += own.weights[i] * square;
      }
      to.levers[j] = sqrt(lever), turning += inner(column, column);
    }
    for (int i = 0; i < m; ++i) {
      ask(to, bounds, i, off.e[i], -inner(off.D[i], drift), *gain);
      if (to.squares) to.squares[i] = squares[i];
    }
    to.curvature[0] = pull_length(own.weights, to.pull, m) * sqrt(turning);
  }
};
}  // namespace osik
