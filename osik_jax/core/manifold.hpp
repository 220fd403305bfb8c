// Moving along the manifold of configurations, and its inverse, as kinematics/_manifold.py defines them.
#pragma once
#include "rigid.hpp"

namespace osik {

struct Manifold {
  int scalars, quaternions;
  const int* scalar;      // [2, scalars] where numbers that simply add are in q, then in v
  const int* quaternion;  // [2, quaternions] where quaternions are in q, then their rotations in v

  static Quaternion<double> unit(const Quaternion<double>& q) {
    const double by = 1.0 / std::sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    return {by * q.w, by * q.x, by * q.y, by * q.z};
  }
  static Quaternion<double> unit(const double* q) { return unit(Quaternion<double>::of(q)); }
  // out = the configuration that is reached from q at velocity v in unit time
  void integrate(const double* q, const double* v, double* out) const {
    for (int k = 0; k < scalars; ++k) out[scalar[k]] = q[scalar[k]] + v[scalar[scalars + k]];
    for (int k = 0; k < quaternions; ++k) {
      const int at = quaternion[k];
      const double* w = v + quaternion[quaternions + k];
      const double square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], angle = std::sqrt(square);
      const bool small = square < SMALL_TURN_SQUARED;
      const double cosine = small ? 1.0 - square / 8.0 + square * square / 384.0 : std::cos(0.5 * angle);
      const double factor = small ? 0.5 - square / 48.0 + square * square / 3840.0 : std::sin(0.5 * angle) / angle;
      const Quaternion<double> turn{cosine, factor * w[0], factor * w[1], factor * w[2]}, end = unit(unit(q + at) * turn);
      out[at] = end.w, out[at + 1] = end.x, out[at + 2] = end.y, out[at + 3] = end.z;
    }
  }
  // out = the velocity that goes from a to b in unit time; rotations take the short way
  void difference(const double* a, const double* b, double* out) const {
    for (int k = 0; k < scalars; ++k) out[scalar[scalars + k]] = b[scalar[k]] - a[scalar[k]];
    for (int k = 0; k < quaternions; ++k) {
      const int at = quaternion[k];
      Quaternion<double> from = unit(a + at);
      from = {from.w, -from.x, -from.y, -from.z};
      const Quaternion<double> turn = from * unit(b + at);
      const double w = turn.w, square = inner(turn.vector(), turn.vector()), sine = std::sqrt(square);
      const double factor = square < SMALL_TURN_SQUARED ? (2.0 - 2.0 / 3.0 * square / (w * w)) / w
                                                        : 2.0 * std::atan2(w >= 0.0 ? sine : -sine, std::fabs(w)) / sine;
      (factor * turn.vector()).put(out + quaternion[quaternions + k]);
    }
  }
};

}  // namespace osik
