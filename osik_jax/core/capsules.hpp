// Nearest points of two capsules, as collision/_distance.py between_segments computes them.
#pragma once
#include "rigid.hpp"

namespace osik {

struct Capsule {
  Vec3<double> start, along;  // one end of the axis, and the vector from there to the other end
  double radius;
};
struct Nearest {
  double distance;
  Vec3<double> on_a, on_b, normal;  // nearest points of the surfaces; unit vector from a to b
};

namespace capsules {
using V = Vec3<double>;
constexpr double TINY = 1.4916681462400413e-154;  // a squared length below it counts as none

inline double quotient(double a, double b) { return b == 0.0 ? 0.0 : a / b; }
inline double inside(double x) { return x < 0.0 ? 0.0 : x > 1.0 ? 1.0 : x; }
inline V unit(V a, V otherwise) {
  const double square = inner(a, a);
  return square <= TINY ? otherwise : (1.0 / std::sqrt(square)) * a;
}

// A unit vector perpendicular to two directions, as far outward as possible; any one where there is none.
inline V across(V a, V b, V outward) {
  const V longer = inner(a, a) >= inner(b, b) ? a : b;
  const double x = std::fabs(longer.x), y = std::fabs(longer.y), z = std::fabs(longer.z);
  const V steepest = x <= y && x <= z ? V{1, 0, 0} : y <= z ? V{0, 1, 0} : V{0, 0, 1};
  const V normal = unit(cross(a, b), unit(cross(longer, steepest), V{0, 0, 1}));
  return inner(normal, outward) < 0.0 ? -1.0 * normal : normal;
}
}  // namespace capsules

inline Nearest nearest(const Capsule& first, const Capsule& second) {
  using namespace capsules;
  const V a = first.along, b = second.along, offset = first.start - second.start;
  const double aa = inner(a, a), bb = inner(b, b), ab = inner(a, b), ao = inner(a, offset), bo = inner(b, offset);
  const double square = aa * bb - ab * ab;
  // where along the two axes, from 0 to 1
  double s = square <= PARALLEL * aa * bb ? 0.5 * (inside(quotient(-ao, aa)) + inside(quotient(ab - ao, aa)))
                                          : inside(quotient(ab * bo - ao * bb, square));
  const double at = inside(quotient(ab * s + bo, bb));
  s = inside(quotient(ab * at - ao, aa));
  const V on_a = first.start + s * a, on_b = second.start + at * b, between = on_b - on_a;
  const double gap = inner(between, between);
  const V normal = gap <= TINY ? across(a, b, second.start - first.start + 0.5 * (b - a)) : (1.0 / std::sqrt(gap)) * between;
  return {std::sqrt(gap) - first.radius - second.radius, on_a + first.radius * normal, on_b - second.radius * normal,
          normal};
}

}  // namespace osik
