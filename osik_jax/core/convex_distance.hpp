// Distance of two convex shapes by their support functions.
//
// Shapes that are apart: the method of Gilbert, Johnson and Keerthi (1988), to 1e-11 m in double precision. Shapes that
// overlap: the expanding polytope of van den Bergen (2001). Its depth is the length of a translation that separates the
// shapes; no shorter one exists by more than DEPTH_TOLERANCE while the polytope has room, as it has for all but deep
// overlaps of two curved surfaces.
#pragma once
#ifndef __CUDACC__
#include <cstring>

#include "lanes.hpp"
#endif
#include "rigid.hpp"

namespace osik {

enum ShapeKind { ABSENT, SPHERE, CAPSULE, CYLINDER, BOX, HALF_SPACE, HULL };  // of collision/_table.py

constexpr double DEPTH_TOLERANCE = 1e-8;  // [m]

// A convex shape: all points within `radius` of its core. Fields as in collision/_table.py: ShapeTable.
template <class Real> struct Convex {
  using V = Vec3<Real>;
  int kind, count;       // a hull's number of vertices; a multiple of 4, the last one repeated, where `apart` is 1
  V size, position;
  Mat3<Real> rotation;   // from the shape's axes
  const Real* vertices;  // [3, count] in the shape's axes, or as `apart` and `axes` say
  // neighbours of vertex k of a large hull: next[first_next[k]] and on, up to next[first_next[k + 1]]; or null
  const int *first_next = nullptr, *next = nullptr;
  int apart = 1, axes = 0;  // how far apart vertices are, and their x, y and z (0: count)
  static constexpr int SPREAD = 32;  // so many of the first vertices of such a hull lie in all directions

  OSIK_FN Real radius() const { return kind == SPHERE || kind == CAPSULE || kind == HULL ? size.x : Real(0); }
  OSIK_FN V axis() const { return {rotation.a.z, rotation.b.z, rotation.c.z}; }
  OSIK_FN static Real toward(Real size, Real direction) { return direction < 0 ? -size : size; }
  // The point of the core that is farthest along a unit vector; both in the shape's axes.
  // near: a vertex of a hull to begin with, -1 for none; then the one that was found
  OSIK_FN V support(V d, int& near) const {
    if (kind == HULL)
      return vertex(near = first_next ? climb(d, near < 0 ? farthest(d, SPREAD) : near) : farthest(d, count));
    if (kind == BOX) return {toward(size.x, d.x), toward(size.y, d.y), toward(size.z, d.z)};
    if (kind == CAPSULE) return {0, 0, toward(size.y, d.z)};
    if (kind == SPHERE) return {0, 0, 0};
    const Real across = sqrt(d.x * d.x + d.y * d.y), share = across > Real(1e-30) ? size.x / across : Real(0);
    return {share * d.x, share * d.y, toward(size.y, d.z)};
  }
  OSIK_FN V vertex(int k) const {
    const Real* x = vertices + k * apart;
    const int next_axis = axes ? axes : count;
    return {x[0], x[next_axis], x[2 * next_axis]};
  }
  OSIK_FN V support(V d) const {
    int near = -1;
    return support(d, near);
  }
  OSIK_FN int climb(V d, int best) const {
    Real most = inner(d, vertex(best));
    for (int from = -1; from != best;) {
      from = best;
      for (int k = first_next[from]; k < first_next[from + 1]; ++k) {
        const Real along = inner(d, vertex(next[k]));
        if (along > most) most = along, best = next[k];
      }
    }
    return best;
  }
  // Of the first vertices.
  OSIK_FN int farthest(V d, int number_of_first) const {
#ifdef __CUDACC__
    int best = 0;
    Real most = inner(d, vertex(0));
    for (int k = 1; k < number_of_first; ++k) {
      const Real along = inner(d, vertex(k));
      if (along > most) most = along, best = k;
    }
    return best;
#else  // where `apart` is 1
    typedef Real Pack __attribute__((vector_size(4 * sizeof(Real))));
    Pack most{}, at{}, number{0, 1, 2, 3};
    most += -std::numeric_limits<Real>::infinity();
    for (int k = 0; k < number_of_first; k += 4, number += Real(4)) {
      Pack x, y, z;
      std::memcpy(&x, vertices + k, sizeof x), std::memcpy(&y, vertices + count + k, sizeof y);
      std::memcpy(&z, vertices + 2 * count + k, sizeof z);
      const Pack along = d.x * x + d.y * y + d.z * z;
      const auto is_more = along > most;
      most = is_more ? along : most, at = is_more ? number : at;
    }
    int best = 0;
    for (int k = 1; k < 4; ++k) best = most[k] > most[best] ? k : best;
    return int(at[best]);
#endif
  }
  // A lower bound on the distance from a point of the world; exact outside of all kinds but hulls.
  OSIK_FN Real beyond(V point, V center, Real bound) const {
    const V out = point - position;
    if (kind == HALF_SPACE) return inner(axis(), out);
    if (kind == HULL) return sqrt(inner(point - center, point - center)) - bound;
    const V local = rotation.transposed() * out;
    const Real zero = 0;
    auto over = [&](Real a, Real limit) { return fabs(a) > limit ? fabs(a) - limit : zero; };
    if (kind == BOX) {
      const V far{over(local.x, size.x), over(local.y, size.y), over(local.z, size.z)};
      return sqrt(inner(far, far));
    }
    const Real across = sqrt(local.x * local.x + local.y * local.y), length = kind == SPHERE ? zero : size.y;
    const Real along = over(local.z, length);
    if (kind != CYLINDER) return sqrt(across * across + along * along) - size.x;
    const Real aside = over(across, size.x);
    return sqrt(aside * aside + along * along);
  }
};

// Signed distance of two shapes, nearest points of their surfaces, and the unit vector from the first to the second.
template <class Real> struct Gap {
  Real distance;
  Vec3<Real> on_a, on_b, normal;
};

// Points of a difference, all a - b, of which the one nearest to the origin is made.
template <class Real> struct Simplex {
  using V = Vec3<Real>;
  struct Point {
    V w, a;  // w = a - b
  };
  Point simplex[4];
  Real share[4], size;  // of each point in the nearest one, v; |v|
  V v;
  int count;
};

// The difference of the cores of two shapes, in the axes of the first one, whose centre is the origin.
template <class Real> class Difference : Simplex<Real> {
 public:
  using V = Vec3<Real>;
  using Point = typename Simplex<Real>::Point;
  Difference(const Convex<Real>& a, const Convex<Real>& b)
      : a(a), b(b), turn(a.rotation.transposed() * b.rotation), back(turn.transposed()),
        offset(a.rotation.transposed() * (b.position - a.position)) {}

  // Whether the distance of the cores is at least `least` > 0.
  bool is_apart(Real least) {
    if (!is_known_place()) return false;
    approach(least, true);
    return is_known ? is_far : !overlaps && size >= least && is_exact();
  }
  // Signed distance of the cores, in world axes; `most` alone, if it is positive and the distance not less.
  Gap<Real> gap(Real most = -1) {
    if (!is_known_place()) return {offset.x * Real(0) / Real(0), offset, offset, offset};
    approach(most, false);
    if (is_far) return {most, {}, {}, {}};
    V normal, on_a{0, 0, 0};
    Real distance = size;
    if (overlaps) {
      distance = -deepen(normal, on_a);
    } else {
      normal = (Real(-1) / size) * v;
      distance = is_exact() ? size : lower;
      for (int k = 0; k < count; ++k) on_a = on_a + share[k] * simplex[k].a;
    }
    const V on_b = on_a + distance * normal;
    return {distance, world(on_a), world(on_b), a.rotation * normal};
  }
  // After `gap` of cores that are apart: four points of each, in world axes, between which the nearest points lie.
  void put_points(V* on_a, V* on_b) const {
    for (int k = 0; k < 4; ++k) {
      const Point p = simplex[k < count ? k : 0];
      on_a[k] = world(p.a), on_b[k] = world(p.a - p.w);
    }
  }

 private:
  static constexpr int MOST_STEPS = 100, MOST_POINTS = 100, MOST_FACES = 2 * MOST_POINTS;
  static constexpr Real TOLERANCE = sizeof(Real) == 8 ? 1e-11 : 1e-6;  // of distances [m]
  static constexpr Real ROUNDOFF = sizeof(Real) == 8 ? 1e-13 : 1e-6;   // of points [m]
  static constexpr Real THIN = sizeof(Real) == 8 ? 1e-10 : 1e-5;       // what is thinner is flat [m]
  const Convex<Real>&a, &b;
  const Mat3<Real> turn, back;
  const V offset;
  using Simplex<Real>::simplex, Simplex<Real>::share, Simplex<Real>::size, Simplex<Real>::v, Simplex<Real>::count;
  bool overlaps, is_known, is_far;
  Real lower;  // no point of the difference is nearer to the origin
  int near_a = -1, near_b = -1;  // vertices of hulls that the last direction found

  Point support(V d) {
    const V on_a = a.support(d, near_a), on_b = turn * b.support(Real(-1) * (back * d), near_b) + offset;
    return {on_a - on_b, on_a};
  }
  // Whether the shapes' places are finite numbers.
  bool is_known_place() const {
    const Real sum = inner(offset, offset) + turn.a.x + turn.b.y + turn.c.z;
    return sum - sum == 0;
  }
  // Whether `size` is the distance. Where roundoff has ended the search, it may be larger by far.
  bool is_exact() const { return size - lower <= 10 * TOLERANCE; }
  static Real length(V p) { return sqrt(inner(p, p)); }
  V world(V p) const { return a.rotation * p + a.position; }

  // Find the point of the difference that is nearest to the origin. With `least` > 0, stop as soon as it is known that
  // its distance is at least that, or, if one only `decides`, that it is less.
  OSIK_CALL void approach(Real least, bool decides) {
    v = Real(-1) * offset, count = 0, overlaps = is_known = is_far = false;
    size = length(v), lower = -Real(INFINITE);
    if (!(size > TOLERANCE)) v = {1, 0, 0}, size = 1;
    Real nearest = 0;  // size of v, of the steps that had a simplex
    for (int step = 0; step < MOST_STEPS; ++step) {
      const Point next = support((Real(-1) / size) * v);
      const Real bound = inner(v, next.w) / size;  // no point is nearer
      lower = bound > lower ? bound : lower;
      if (least > 0 && bound >= least) return void(is_known = is_far = true);
      if (count && (size - bound <= TOLERANCE || is_in_simplex(next.w))) return;
      const Simplex<Real> before = *this;
      simplex[count++] = next;
      reduce();
      if (overlaps || size <= TOLERANCE) return void(overlaps = true);
      if (step && size >= nearest) return void(static_cast<Simplex<Real>&>(*this) = before);  // roundoff
      if (decides && size < least) return void(is_known = true);
      nearest = size;
    }
  }
  bool is_in_simplex(V w) const {
    for (int k = 0; k < count; ++k)
      if (w.x == simplex[k].w.x && w.y == simplex[k].w.y && w.z == simplex[k].w.z) return true;
    return false;
  }

  // The nearest point of a part of the simplex: its vertices, their shares, its square.
  struct Part {
    int at[3], count;
    Real share[3], square;
    V v;
  };
  void consider(Part part, Part& best) const {
    part.v = {0, 0, 0};
    for (int k = 0; k < part.count; ++k) part.v = part.v + part.share[k] * simplex[part.at[k]].w;
    part.square = inner(part.v, part.v);
    if (part.square < best.square) best = part;
  }
  void on_edge(int i, int j, Part& best) const {
    const V p = simplex[i].w, along = simplex[j].w - p;
    const Real most = inner(along, along), t = -inner(p, along);
    if (!(t > 0)) return consider({{i}, 1, {1}, 0, {}}, best);
    if (t >= most) return consider({{j}, 1, {1}, 0, {}}, best);
    consider({{i, j}, 2, {1 - t / most, t / most}, 0, {}}, best);
  }
  void on_face(int i, int j, int k, Part& best) const {
    const V p = simplex[i].w, q = simplex[j].w, r = simplex[k].w, normal = cross(q - p, r - p);
    const Real square = inner(normal, normal), x = inner(normal, cross(q, r)), y = inner(normal, cross(r, p));
    const Real z = inner(normal, cross(p, q));
    if (square > 0 && x >= 0 && y >= 0 && z >= 0) {
      const Real sum = x + y + z;
      return consider({{i, j, k}, 3, {x / sum, y / sum, z / sum}, 0, {}}, best);
    }
    on_edge(i, j, best), on_edge(j, k, best), on_edge(i, k, best);
  }
  // Whether the origin is not strictly on the side of a face on which the fourth point is.
  bool is_outside(int i, int j, int k, int other) const {
    const V p = simplex[i].w, normal = cross(simplex[j].w - p, simplex[k].w - p);
    const Real here = -inner(normal, p), there = inner(normal, simplex[other].w - p);
    return here * there <= 0 || fabs(there) <= THIN * length(normal);
  }
  // Keep the points of the simplex that the nearest point is made of.
  void reduce() {
    Part best{{0}, 1, {1}, Real(1e30), {}};
    if (count == 1) consider({{0}, 1, {1}, 0, {}}, best);
    if (count == 2) on_edge(0, 1, best);
    if (count == 3) on_face(0, 1, 2, best);
    if (count == 4) {
      constexpr int FACES[4][4] = {{0, 1, 3, 2}, {0, 2, 3, 1}, {1, 2, 3, 0}, {0, 1, 2, 3}};
      bool is_inside = true;
      for (const auto& f : FACES)
        if (is_outside(f[0], f[1], f[2], f[3])) on_face(f[0], f[1], f[2], best), is_inside = false;
      if (is_inside) return void(overlaps = true);
    }
    Point kept[3];
    for (int k = 0; k < best.count; ++k) kept[k] = simplex[best.at[k]], share[k] = best.share[k];
    for (int k = 0; k < best.count; ++k) simplex[k] = kept[k];
    count = best.count, v = best.v;
    // across the edge or the face: the sum of points has roundoff that turns a short vector
    const V p = simplex[0].w;
    if (count == 2) {
      const V along = simplex[1].w - p;
      v = v - (inner(v, along) / inner(along, along)) * along;
    } else if (count == 3) {
      const V normal = cross(simplex[1].w - p, simplex[2].w - p);
      const Real square = inner(normal, normal);
      if (square > 0) v = (inner(normal, p) / square) * normal;
    }
    size = length(v);
  }

  // A unit vector across one or two directions.
  static V across(V along) {
    const Real x = fabs(along.x), y = fabs(along.y), z = fabs(along.z);
    const V n = cross(along, x <= y && x <= z ? V{1, 0, 0} : y <= z ? V{0, 1, 0} : V{0, 0, 1});
    return (Real(1) / length(n)) * n;
  }
  // Add a point off the simplex on either side along a unit vector; false if there is none.
  bool extend(V n) {
    const Real here = inner(n, simplex[0].w);
    for (const Real side : {Real(1), Real(-1)}) {
      const Point p = support(side * n);
      if (fabs(inner(n, p.w) - here) <= THIN) continue;
      simplex[count++] = p;
      return true;
    }
    return false;
  }
  // Make the simplex, which has the origin, a tetrahedron; false, with a normal, if the difference is flat.
  bool complete(V& normal) {
    for (const V axis : {V{1, 0, 0}, V{0, 1, 0}, V{0, 0, 1}})
      if (count == 1) normal = axis, extend(axis);
    if (count == 1) return false;
    if (count == 2) {
      const V along = simplex[1].w - simplex[0].w;
      normal = across((Real(1) / length(along)) * along);
      if (!extend(normal)) {
        const V other = cross((Real(1) / length(along)) * along, normal);
        if (!extend(other)) return false;
      }
    }
    if (count == 3) {
      const V n = cross(simplex[1].w - simplex[0].w, simplex[2].w - simplex[0].w);
      normal = (Real(1) / length(n)) * n;
      return extend(normal);
    }
    return true;
  }

  struct Face {
    int at[3];
    V normal;
    Real distance;
  };
  static Face face(const Point* points, int i, int j, int k) {
    const V n = cross(points[j].w - points[i].w, points[k].w - points[i].w);
    const Real size = length(n);
    const V normal = (size > 0 ? 1 / size : Real(0)) * n;
    return {{i, j, k}, normal, size > 0 ? inner(normal, points[i].w) : Real(1e30)};
  }
  // The depth of cores that overlap, its direction, and the point of the first core there.
  OSIK_CALL Real deepen(V& normal, V& on_a) {
    if (!complete(normal)) {
      for (int k = 0; k < count; ++k) on_a = on_a + (Real(1) / count) * simplex[k].a;
      return 0;
    }
    Point points[MOST_POINTS];
    Face faces[MOST_FACES];
    int number = 4, known = 0;
    for (int k = 0; k < 4; ++k) points[k] = simplex[k];
    const V out = cross(points[1].w - points[0].w, points[2].w - points[0].w);
    if (inner(out, points[3].w - points[0].w) > 0) points[0] = simplex[1], points[1] = simplex[0];
    constexpr int FACES[4][3] = {{0, 1, 2}, {0, 3, 1}, {1, 3, 2}, {2, 3, 0}};
    for (const auto& f : FACES) faces[known++] = face(points, f[0], f[1], f[2]);
    Real depth = Real(1e30);
    while (true) {
      int nearest = 0;
      for (int k = 1; k < known; ++k) nearest = faces[k].distance < faces[nearest].distance ? k : nearest;
      const Face chosen = faces[nearest];
      if (chosen.distance >= Real(1e30)) return depth;
      const Point next = support(chosen.normal);
      const Real here = inner(chosen.normal, next.w);
      if (here < depth) depth = here, normal = chosen.normal, on_a = middle(points, chosen);
      if (depth - chosen.distance <= Real(DEPTH_TOLERANCE) || number == MOST_POINTS) return depth;
      points[number++] = next;
      if (!replace(points, number - 1, faces, known)) return depth;
    }
  }
  // The point of the first core at the point of a face that is nearest to the origin.
  static V middle(const Point* points, const Face& f) {
    const V p = points[f.at[0]].w, q = points[f.at[1]].w, r = points[f.at[2]].w;
    const Real x = inner(f.normal, cross(q, r)), y = inner(f.normal, cross(r, p)), z = inner(f.normal, cross(p, q));
    const Real share = 1 / (x + y + z);
    return share * (x * points[f.at[0]].a + y * points[f.at[1]].a + z * points[f.at[2]].a);
  }
  // Replace the faces that a new point sees by faces from their border to it; false if there is no room or border.
  static bool replace(const Point* points, int next, Face* faces, int& known) {
    int border[MOST_FACES][2], edges = 0, kept = 0;
    for (int k = 0; k < known; ++k) {
      const Face f = faces[k];
      // a face in one plane with the point goes too: a face between the point and one of its edges could be a line
      if (!(inner(f.normal, points[next].w) >= f.distance - ROUNDOFF)) {
        faces[kept++] = f;
        continue;
      }
      for (int e = 0; e < 3; ++e) {
        const int from = f.at[e], to = f.at[(e + 1) % 3];
        int twin = 0;
        while (twin < edges && !(border[twin][0] == to && border[twin][1] == from)) ++twin;
        if (twin < edges) {
          --edges, border[twin][0] = border[edges][0], border[twin][1] = border[edges][1];
        } else {
          if (edges == MOST_FACES) return false;
          border[edges][0] = from, border[edges++][1] = to;
        }
      }
    }
    if (!edges || kept + edges > MOST_FACES) return false;
    for (int k = 0; k < edges; ++k) faces[kept + k] = face(points, border[k][0], border[k][1], next);
    known = kept + edges;
    return true;
  }
};

// From a shape to a half space.
template <class Real> Gap<Real> gap_to_plane(const Convex<Real>& a, const Convex<Real>& plane) {
  const Vec3<Real> out = plane.axis(), down = Real(-1) * out;
  const Vec3<Real> lowest = a.rotation * a.support(a.rotation.transposed() * down) + a.position + a.radius() * down;
  const Real distance = inner(out, lowest - plane.position);
  return {distance, lowest, lowest + distance * down, down};
}

// Signed distance of two shapes, one of which may be a half space. If `most` is positive and the distance not less, `most`
// or more is all that is found.
template <class Real> Gap<Real> gap_between(const Convex<Real>& a, const Convex<Real>& b, Real most = -1) {
  if (b.kind == HALF_SPACE) return gap_to_plane(a, b);
  if (a.kind == HALF_SPACE) {
    const Gap<Real> turned = gap_to_plane(b, a);
    return {turned.distance, turned.on_b, turned.on_a, Real(-1) * turned.normal};
  }
  const Real first = a.radius(), second = b.radius();
  const Gap<Real> core = Difference<Real>(a, b).gap(most > 0 ? most + first + second : most);
  if (most > 0 && core.distance >= most + first + second) return {most, {}, {}, {}};
  return {core.distance - first - second, core.on_a + first * core.normal, core.on_b - second * core.normal, core.normal};
}

// Whether the distance of two shapes is at least `least` >= 0.
template <class Real> bool is_apart(const Convex<Real>& a, const Convex<Real>& b, Real least) {
  if (a.kind == HALF_SPACE || b.kind == HALF_SPACE) return gap_between(a, b).distance >= least;
  const Real apart = least + a.radius() + b.radius();
  return Difference<Real>(a, b).is_apart(apart > Real(0) ? apart : Real(1e-300));
}
}  // namespace osik
