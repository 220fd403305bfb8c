// Vectors, rotations and quaternions (w, x, y, z) of one thread. At: where numbers are, a pointer or Strided (lanes_cuda.hpp).
#pragma once
#include <cmath>

#include "constants.hpp"
#include "team.hpp"

namespace osik {

template <class Real> OSIK_FN void sine_and_cosine(Real angle, Real& sine, Real& cosine) {
  sine = sin(angle), cosine = cos(angle);
}

template <class Real> struct Vec3 {
  Real x, y, z;
  template <class At> OSIK_FN static Vec3 of(At a) { return {a[0], a[1], a[2]}; }
  template <class At> OSIK_FN void put(At a) const { a[0] = x, a[1] = y, a[2] = z; }
  OSIK_FN Vec3 operator+(Vec3 b) const { return {x + b.x, y + b.y, z + b.z}; }
  OSIK_FN Vec3 operator-(Vec3 b) const { return {x - b.x, y - b.y, z - b.z}; }
};
template <class Real> OSIK_FN Vec3<Real> operator*(Real a, Vec3<Real> v) { return {a * v.x, a * v.y, a * v.z}; }
template <class Real> OSIK_FN Real inner(Vec3<Real> a, Vec3<Real> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class Real> OSIK_FN Vec3<Real> cross(Vec3<Real> a, Vec3<Real> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// The largest absolute entry.
template <class Real> OSIK_FN Real largest_entry(Vec3<Real> v) {
  const Real x = fabs(v.x), y = fabs(v.y), z = fabs(v.z), most = select(y > x, y, x);
  return select(z > most, z, most);
}

template <class Real> struct Mat3 {
  using V = Vec3<Real>;
  V a, b, c;  // rows
  OSIK_FN static Mat3 identity() { return {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}; }
  template <class At> OSIK_FN static Mat3 of(At m) { return {V::of(m), V::of(m + 3), V::of(m + 6)}; }
  template <class At> OSIK_FN void put(At m) const { a.put(m), b.put(m + 3), c.put(m + 6); }
  OSIK_FN Mat3 transposed() const { return {{a.x, b.x, c.x}, {a.y, b.y, c.y}, {a.z, b.z, c.z}}; }
  OSIK_FN V operator*(V v) const { return {inner(a, v), inner(b, v), inner(c, v)}; }
  OSIK_FN Mat3 operator*(const Mat3& m) const {
    const Mat3 t = m.transposed();
    return {t * a, t * b, t * c};
  }
};

template <class Real> struct Quaternion {
  using V = Vec3<Real>;
  Real w, x, y, z;
  template <class At> OSIK_FN static Quaternion of(At a) { return {a[0], a[1], a[2], a[3]}; }
  OSIK_FN V vector() const { return {x, y, z}; }
  OSIK_FN Quaternion operator*(const Quaternion& q) const {
    const V v = w * q.vector() + q.w * vector() + cross(vector(), q.vector());
    return {w * q.w - inner(vector(), q.vector()), v.x, v.y, v.z};
  }
  // q v q*: the vector rotated, and scaled by the square of the quaternion's length
  OSIK_FN V carry(V v) const {
    const V u = vector();
    return Real(2) * inner(u, v) * u + (w * w - inner(u, u)) * v + Real(2) * w * cross(u, v);
  }
  OSIK_FN Mat3<Real> rotation() const {  // of a quaternion of any length but 0
    const Real factor = Real(2) / (w * w + x * x + y * y + z * z), fx = factor * x, fy = factor * y, fz = factor * z;
    const Real wx = w * fx, wy = w * fy, wz = w * fz, xx = x * fx, xy = x * fy, xz = x * fz, yy = y * fy, yz = y * fz,
               zz = z * fz;
    return {{1 - yy - zz, xy - wz, xz + wy}, {xy + wz, 1 - xx - zz, yz - wx}, {xz - wy, yz + wx, 1 - xx - yy}};
  }
  // the quaternion over its length; one of zeros becomes finite and useless, as in MJX
  OSIK_FN Quaternion normalized() const {
    const Real least = 1e-8, length = sqrt(w * w + x * x + y * y + z * z);
    const auto none = (fabs(w) <= least) & (fabs(x) <= least) & (fabs(y) <= least) & (fabs(z) <= least);
    auto part = [&](Real a) { return select(none, Real(1e6), a / length); };
    return {part(w), part(x), part(y), part(z)};
  }
};

// The quaternion of a rotation by the largest of its four numbers, w >= 0 (M. Day, "Converting a rotation matrix to a
// quaternion", 2015).
template <class Real> OSIK_FN Quaternion<Real> quaternion_of(const Mat3<Real>& m) {
  Quaternion<Real> q;
  Real t;
  if (m.c.z < 0) {
    if (m.a.x > m.b.y) t = 1 + m.a.x - m.b.y - m.c.z, q = {m.c.y - m.b.z, t, m.b.x + m.a.y, m.a.z + m.c.x};
    else t = 1 - m.a.x + m.b.y - m.c.z, q = {m.a.z - m.c.x, m.b.x + m.a.y, t, m.c.y + m.b.z};
  } else if (m.a.x < -m.b.y) t = 1 - m.a.x - m.b.y + m.c.z, q = {m.b.x - m.a.y, m.a.z + m.c.x, m.c.y + m.b.z, t};
  else t = 1 + m.a.x + m.b.y + m.c.z, q = {t, m.c.y - m.b.z, m.a.z - m.c.x, m.b.x - m.a.y};
  const Real factor = (q.w < 0 ? Real(-0.5) : Real(0.5)) / sqrt(t);
  return {factor * q.w, factor * q.x, factor * q.y, factor * q.z};
}

// The rotation vector of a rotation [rad]; its angle is in [0, pi].
template <class Real> OSIK_FN Vec3<Real> rotation_log(const Mat3<Real>& m) {
  const Quaternion<Real> q = quaternion_of(m);
  const Real square = inner(q.vector(), q.vector());
  if (square < Real(SMALL_SINE_SQUARED)) {
    const Real tangent = square / (q.w * q.w);
    return (Real(2) - tangent * (Real(2) / 3 - tangent * (Real(2) / 5))) / q.w * q.vector();
  }
  const Real sine = sqrt(square);
  return Real(2) * atan2(sine, q.w) / sine * q.vector();
}

// c = (1 - (angle/2) cot(angle/2)) / angle^2 of the squared angle of a rotation
template <class Real> OSIK_FN Real turn_factor(Real s) {
  const Real half = Real(0.5) * sqrt(s);
  return s < Real(SMALL_ANGLE_SQUARED) ? 1. / 12 + s * (1. / 720 + s * (1. / 30240 + s * (1. / 1209600 + s / 47900160)))
                                       : (1 - half * cos(half) / sin(half)) / s;
}

// I - [e]/2 + c [e]^2: the inverse left Jacobian of SO(3) at e.
template <class Real> OSIK_FN Mat3<Real> inverse_left_jacobian(Vec3<Real> e) {
  const Real s = inner(e, e), c = turn_factor(s);
  const Vec3<Real> h = Real(0.5) * e;
  return {{1 + c * (e.x * e.x - s), c * e.x * e.y + h.z, c * e.x * e.z - h.y},
          {c * e.x * e.y - h.z, 1 + c * (e.y * e.y - s), c * e.y * e.z + h.x},
          {c * e.x * e.z + h.y, c * e.y * e.z - h.x, 1 + c * (e.z * e.z - s)}};
}
}  // namespace osik
