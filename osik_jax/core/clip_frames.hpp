// What the frames of a clip ask for, as retargeting/_plan.py and _terms.py say: rows of goals and bounds, frame by frame.
//
// Rows of weight 0 are left out, which are most rows of bounds. The others are scaled by the roots of their weights and
// have their residuals in column n, so that one product gives matrix and gradient. Standing points are tied to those of
// the frame before, so the rows of a frame are complete when the points of the next frame are known.
#pragma once
#include "banded.hpp"
#include "capsules.hpp"
#include "kinematics.hpp"

namespace osik {

// The arrays of a robot with its profile, in the order of retargeting/_plan_kernel.py.
struct ClipRobot {
  struct Counts {
    int bodies, joints, values, full, keys, capsules, above, pairs, turned, most_pairs, root, places, straight, limbs,
        reaches, roots, corners, scalars, quaternions, dofs;
  } c;
  const int *parents, *types, *owners, *source, *columns;  // [bodies], [joints] twice, [values], [full]
  const int *places, *joints, *limbs, *roots;          // [places] body of each; [dofs] place in q or -1; [limbs, 2] keys,
                                                       // the reaches last; [roots] places, 2 or none
  const int *above, *pairs;                            // [above], [pairs, 2] capsules
  const int *moves, *scalar, *quaternion;              // [bodies, full] flags; [2, scalars], [2, quaternions]
  const double *coefficient, *offset, *reference, *body_position, *body_quaternion, *joint_position, *joint_axis;
  const double *factors, *points, *turns, *home, *reach, *rise, *radii;  // [reaches] and [corners] lengths
  const double *lower, *upper, *rest, *step, *change, *mass, *center;
  // weights of goals and bounds, and other numbers of them
  enum { LIMB, PELVIS, TORSO, ROOT_X, ROOT_Y, ROOT_Z, FOOT, POSTURE, STANCE, APART, LIMIT, MARGIN, STIFFNESS, CLEARANCE };
  enum { SWINGING = CLEARANCE + 1, SHORTEST, TIED, SMOOTH, SMOOTH_BASE, SPEED, BALANCE, INSIDE, WEIGHTS };
  double weight[WEIGHTS];

  Tree<const double*> tree() const {
    return {c.bodies,  c.joints,      c.full,          parents,        types,     owners,
            reference, body_position, body_quaternion, joint_position, joint_axis};
  }
  void read(const int* at) {
    auto take = [&](int count) { return at += count, at - count; };
    __builtin_memcpy(&c, take(sizeof c / sizeof(int)), sizeof c);
    parents = take(c.bodies), types = take(c.joints), owners = take(c.joints), source = take(c.values);
    columns = take(c.full), places = take(c.places), joints = take(c.dofs), limbs = take(2 * c.limbs);
    roots = take(c.roots), above = take(c.above), pairs = take(2 * c.pairs), moves = take(c.bodies * c.full),
    scalar = take(2 * c.scalars);
    quaternion = take(2 * c.quaternions);
  }
  void read(const double* at) {
    auto take = [&](int count) { return at += count, at - count; };
    coefficient = take(c.values), offset = take(c.values), reference = take(c.values), body_position = take(3 * c.bodies);
    body_quaternion = take(4 * c.bodies), joint_position = take(3 * c.joints), joint_axis = take(3 * c.joints);
    factors = take(c.full), points = take(3 * c.places), turns = take(36), home = take(36), reach = take(c.reaches);
    rise = take(c.corners), radii = take(c.capsules);
    lower = take(c.dofs), upper = take(c.dofs), rest = take(c.dofs), step = take(c.dofs), change = take(c.dofs);
    mass = take(c.bodies), center = take(3 * c.bodies);
    for (double& w : weight) w = *at++;
  }
};

// Goals of a clip of F frames.
struct ClipGoals {
  const double *directions, *pelvis, *torso, *root, *feet, *contact, *held, *present;  // [F, 3 limbs], [F, 9], [F, 9],
                                                                                       // [F, 3], [F, 18], [F, 4],
                                                                                       // [F, reaches], [F]
};

struct Cost {
  double soft = 0.0, penalty = 0.0;  // of goals, and of bounds
  Cost& operator+=(const Cost& o) { return soft += o.soft, penalty += o.penalty, *this; }
};

struct ClipFrames {
  using Team = Serial<double>;
  using Algebra = LinearAlgebra<Team>;
  using V = Vec3<double>;
  using M = Mat3<double>;
  using R = ClipRobot;
  static constexpr int ROWS = 45, POINTS = ClipSystem::POINTS;
  // ROWS without those of limbs, capsules and the floor: at most 3 and 12 of rotations, 8 and 8 of soles, and some
  Team t;
  R& robot;
  const ClipGoals& goals;
  const double* w;  // weights
  int n, N, wide, most;  // dofs; strides of rows and of motion; rows of a frame at most
  double *value, *position, *rotation, *linear, *angular, *anchor;  // where the robot is
  double *motion, *masks, *point, *turned, *line;  // [6, wide] linear velocity at the root and axis of each dof;
                                                   // [bodies, wide]; [places, 3]; [4, 9]; [wide] rates of a row
  double *close, *spheres;                         // [pairs, 2] pair and distance; [capsules, 4] center and radius
  double* rows[2];                                 // [most, N] of this frame and of the last one, in turn
  double at[2][POINTS], tie_weight[3][POINTS], tie_move[3][POINTS];  // of standing points; entry 2 is nothing
  int count[2], row;
  double* J;

  static int wide_of(const R::Counts& c) { return Team::stride(c.full); }
  static int most_of(const R::Counts& c) { return ROWS + 3 * c.limbs + 2 * c.above + c.most_pairs; }
  static size_t doubles(const R::Counts& c, int N) {
    const int wide = wide_of(c);
    return c.values + 12 * c.bodies + 9 * c.full + (7 + c.bodies) * wide + 3 * c.places + 36 + 2 * c.pairs + 4 * c.capsules +
           2 * most_of(c) * N;
  }
  ClipFrames(R& robot, const ClipGoals& goals, int N, double* next)
      : robot(robot), goals(goals), w(robot.weight), n(robot.c.dofs), N(N), wide(wide_of(robot.c)), most(most_of(robot.c)) {
    const R::Counts& c = robot.c;
    auto take = [&](int size) { return next += size, next - size; };
    value = take(c.values), position = take(3 * c.bodies), rotation = take(9 * c.bodies), linear = take(3 * c.full);
    angular = take(3 * c.full), anchor = take(3 * c.full), motion = take(6 * wide), masks = take(c.bodies * wide);
    point = take(3 * c.places), turned = take(36), line = take(wide), close = take(2 * c.pairs);
    spheres = take(4 * c.capsules), rows[0] = take(most * N), rows[1] = take(most * N);
    for (int e = 0; e < 6 * wide; ++e) motion[e] = 0.0;
    for (int j = 0; j < wide; ++j) line[j] = 0.0;
    for (int body = 0; body < c.bodies; ++body)
      for (int j = 0; j < wide; ++j) masks[body * wide + j] = j < c.full && robot.moves[body * c.full + j] ? 1.0 : 0.0;
  }

  // ---- the robot
  V point_at(int k) const { return V::of(point + 3 * k); }
  V root() const { return V::of(position + 3 * robot.c.root); }
  V center_of(int body) const {
    return V::of(position + 3 * body) + M::of(rotation + 9 * body) * V::of(robot.center + 3 * body);
  }
  static V axis(int i) { return {i == 0 ? 1.0 : 0.0, i == 1 ? 1.0 : 0.0, i == 2 ? 1.0 : 0.0}; }
  void place(const double* q) {
    const R::Counts& c = robot.c;
    for (int i = 0; i < c.values; ++i) value[i] = robot.coefficient[i] * q[robot.source[i]] + robot.offset[i];
    place_bodies(robot.tree(), value, Placed<double*>{position, rotation, linear, angular, anchor});
    for (int dof = 0; dof < c.full; ++dof) {
      const V turn = V::of(angular + 3 * dof);
      const V speed = V::of(linear + 3 * dof) + cross(V::of(anchor + 3 * dof) - root(), turn);
      double* to = motion + dof;
      for (double a : {speed.x, speed.y, speed.z, turn.x, turn.y, turn.z}) *to = a, to += wide;
    }
    for (int k = 0; k < c.places; ++k) {
      const int body = robot.places[k];
      (V::of(position + 3 * body) + M::of(rotation + 9 * body) * V::of(robot.points + 3 * k)).put(point + 3 * k);
    }
    for (int k = 0; k < 4; ++k)
      (M::of(rotation + 9 * robot.places[c.keys + k]) * M::of(robot.turns + 9 * k)).put(turned + 9 * k);
  }

  // ---- rows
  // Add the rates along d of a point of a body whose moment about the root is m.
  void add_rates(int body, V d, V m) {
    const double by[6] = {d.x, d.y, d.z, m.x, m.y, m.z};
    t.columns(0, robot.c.full, [&](auto c) {
      auto total = Algebra::weighted_sum(c, by, motion, wide, 0, 6);
      total *= c.load(masks + body * wide);
      c.store(line, total += c.load(line));
    });
  }
  void add_point_of(int body, V p, V d) { add_rates(body, d, cross(p - root(), d)); }
  void add_point(int k, V d) { add_point_of(robot.places[k], point_at(k), d); }
  // The line becomes a row of `to` [., N] in the independent dofs, with its residual in column n; the line becomes 0.
  void put_row(double* to, double scale, double residual) {
    if (robot.c.straight) {
      for (int j = 0; j < n; ++j) to[j] = scale * line[j];
    } else {
      for (int j = 0; j < n; ++j) to[j] = 0.0;
      for (int dof = 0; dof < robot.c.full; ++dof)
        if (robot.columns[dof] >= 0) to[robot.columns[dof]] += scale * robot.factors[dof] * line[dof];
    }
    to[n] = scale * residual;
    for (int j = n + 1; j < N; ++j) to[j] = 0.0;
    for (int j = 0; j < wide; ++j) line[j] = 0.0;
  }
  void add_row(double scale, double residual) { put_row(J + row++ * N, scale, residual); }

  // ---- goals
  // Directions of limbs. A direction d changes across it by (I - d d') / length times what the segment changes by: two
  // rows do for the three. A limb shorter than what counts as a length has no row. A reach is the segment itself, in
  // units of its length; `held` is its weight relative to a limb's.
  double ask_limbs(const double* wanted, const double* held) {
    double cost = 0.0;
    const int directed = robot.c.limbs - robot.c.reaches;
    for (int limb = 0; limb < robot.c.limbs; ++limb) {
      const int a = robot.limbs[2 * limb], b = robot.limbs[2 * limb + 1];
      const double weight = limb < directed ? w[R::LIMB] : w[R::LIMB] * held[limb - directed];
      if (weight == 0.0) continue;
      const V segment = point_at(b) - point_at(a);
      const double length = limb < directed ? std::sqrt(inner(segment, segment)) : robot.reach[limb - directed];
      const double inverse = 1.0 / larger(length, w[R::SHORTEST]);
      const V d = inverse * segment, off = d - V::of(wanted + 3 * limb);
      cost += 0.5 * weight * inner(off, off);
      if (limb >= directed) {
        for (int k = 0; k < 3; ++k) {
          add_point(b, inverse * axis(k)), add_point(a, -inverse * axis(k));
          add_row(std::sqrt(weight), inner(axis(k), off));
        }
        continue;
      }
      if (length < w[R::SHORTEST]) continue;
      const V first = capsules::across(segment, segment, segment);
      for (const V side : {first, cross(d, first)}) {
        add_point(b, inverse * side), add_point(a, -inverse * side);
        add_row(std::sqrt(weight), inner(side, off));
      }
    }
    return cost;
  }
  // Rotation of pelvis (0), torso (1) or a foot (2, 3).
  double ask_rotation(int i, const double* wanted, double weight) {
    const M goal = M::of(wanted) * M::of(robot.home + 9 * i);
    const V off = rotation_log(M::of(turned + 9 * i) * goal.transposed());
    const double residual[3] = {off.x, off.y, off.z};
    for (int k = 0; k < 3; ++k) {
      add_rates(robot.places[robot.c.keys + i], {0, 0, 0}, axis(k));
      add_row(std::sqrt(weight), residual[k]);
    }
    return 0.5 * weight * inner(off, off);
  }
  // Midpoint of the hips, or of what stands for them.
  double ask_root(const double* wanted) {
    if (!robot.c.roots) return 0.0;
    const int left = robot.roots[0], right = robot.roots[1];
    const V off = 0.5 * (point_at(left) + point_at(right)) - V::of(wanted);
    const double residual[3] = {off.x, off.y, off.z};
    double cost = 0.0;
    for (int i = 0; i < 3; ++i) {
      const double weight = w[R::ROOT_X + i];
      add_point(left, 0.5 * axis(i)), add_point(right, 0.5 * axis(i));
      add_row(std::sqrt(weight), residual[i]);
      cost += 0.5 * weight * residual[i] * residual[i];
    }
    return cost;
  }
  double ask_height(int k, double gap, double weight) {
    if (weight == 0.0) return 0.0;
    add_point(k, {0, 0, 1});
    add_row(std::sqrt(w[R::STIFFNESS] * weight), gap);
    return 0.5 * weight * gap * gap;
  }
  // Soles that stand, and soles and capsules that are below their clearance.
  double ask_floor(const double* contact) {
    const int sole = robot.c.keys + 4, first = first_capsule();
    double cost = 0.0;
    for (int corner = 0; corner < robot.c.corners; ++corner) {
      const bool stands = contact[corner / 2] > 0.5;
      const double gap = point_at(sole + corner).z - robot.rise[corner] - (stands ? 0.0 : w[R::CLEARANCE]);
      cost += ask_height(sole + corner, gap, stands ? w[R::STANCE] : gap < 0.0 ? w[R::SWINGING] * w[R::STANCE] : 0.0);
    }
    for (int a = 0; a < robot.c.above; ++a)
      for (int end = 0; end < 2; ++end) {
        const int capsule = robot.above[a], k = first + 2 * capsule + end;
        const double gap = point_at(k).z - robot.radii[capsule] - w[R::CLEARANCE];
        cost += ask_height(k, gap, gap < 0.0 ? w[R::SWINGING] * w[R::STANCE] : 0.0);
      }
    return cost;
  }
  int first_capsule() const { return robot.c.keys + 4 + robot.c.corners; }
  Capsule capsule(int i) const {
    const int first = first_capsule() + 2 * i;
    return {point_at(first), point_at(first + 1) - point_at(first), robot.radii[i]};
  }
  Nearest nearest_of(int pair) const { return nearest(capsule(robot.pairs[2 * pair]), capsule(robot.pairs[2 * pair + 1])); }
  // The pairs of capsules that are nearer than the margin, the nearest ones: `close`. Returns how many.
  int find_close() {
    const double margin = w[R::MARGIN];
    int found = 0;
    for (int i = 0; i < robot.c.capsules; ++i) {
      const Capsule own = capsule(i);
      (own.start + 0.5 * own.along).put(spheres + 4 * i);
      spheres[4 * i + 3] = 0.5 * std::sqrt(inner(own.along, own.along)) + own.radius + 0.5 * margin;
    }
    for (int p = 0; p < robot.c.pairs; ++p) {
      const double *a = spheres + 4 * robot.pairs[2 * p], *b = spheres + 4 * robot.pairs[2 * p + 1];
      const V between = V::of(b) - V::of(a);
      if (!(inner(between, between) < (a[3] + b[3]) * (a[3] + b[3]))) continue;
      const double distance = nearest_of(p).distance;
      if (distance < margin) close[2 * found] = p, close[2 * found + 1] = distance, ++found;
    }
    for (; found > robot.c.most_pairs; --found) {
      int farthest = 0;
      for (int i = 1; i < found; ++i)
        if (close[2 * i + 1] > close[2 * farthest + 1]) farthest = i;
      close[2 * farthest] = close[2 * found - 2], close[2 * farthest + 1] = close[2 * found - 1];
    }
    return found;
  }
  double ask_apart() {
    const double root_weight = std::sqrt(w[R::STIFFNESS] * w[R::APART]);
    const int found = find_close(), first = first_capsule();
    double cost = 0.0;
    for (int i = 0; i < found; ++i) {
      const int p = int(close[2 * i]);
      const Nearest pair = nearest_of(p);
      add_point_of(robot.places[first + 2 * robot.pairs[2 * p + 1]], pair.on_b, pair.normal);
      add_point_of(robot.places[first + 2 * robot.pairs[2 * p]], pair.on_a, -1.0 * pair.normal);
      const double gap = pair.distance - w[R::MARGIN];
      add_row(root_weight, gap);
      cost += 0.5 * w[R::APART] * gap * gap;
    }
    return cost;
  }

  // ---- balance: the centre of mass over the feet, as retargeting/_balance.py says
  struct Overhang {
    double distance, width;  // of the centre of mass beyond the support polygon; width of the polygon
    V direction;
    int a, b;  // corners of the nearest edge, and the ratio of the nearest point along it
    double ratio;
  };
  // the largest d . corner of the standing corners
  double support(const double* contact, V d) const {
    double farthest = -INFINITE;
    for (int k = 0; k < robot.c.corners; ++k)
      if (contact[k / 2] > 0.5) farthest = larger(farthest, inner(d, point_at(robot.c.keys + 4 + k)));
    return farthest;
  }
  Overhang find_overhang(const double* contact, V center) const {
    const int first = robot.c.keys + 4;
    Overhang o{-INFINITE, INFINITE, {0, 0, 0}, 0, 0, 0.0};
    for (int i = 0; i < robot.c.corners; ++i) {
      if (!(contact[i / 2] > 0.5)) continue;
      const V start = point_at(first + i), off{center.x - start.x, center.y - start.y, 0.0};
      const double away = std::sqrt(inner(off, off));
      if (away > w[R::SHORTEST]) {
        const V d = (1.0 / away) * off;
        const double distance = inner(d, center) - support(contact, d);
        if (distance > o.distance) o.distance = distance, o.direction = d, o.a = o.b = i, o.ratio = 0.0;
      }
      for (int j = i + 1; j < robot.c.corners; ++j) {
        const V end = point_at(first + j), edge{end.x - start.x, end.y - start.y, 0.0};
        const double length = std::sqrt(inner(edge, edge));
        if (!(contact[j / 2] > 0.5) || !(length > w[R::SHORTEST])) continue;
        const V along = (1.0 / length) * edge, across{along.y, -along.x, 0.0};
        const double one = support(contact, across), other = support(contact, -1.0 * across);
        o.width = one + other < o.width ? one + other : o.width;
        for (int side = 0; side < 2; ++side) {
          const V d = side == 0 ? across : -1.0 * across;
          const double distance = inner(d, center) - (side == 0 ? one : other);
          if (distance > o.distance)
            o.distance = distance, o.direction = d, o.a = i, o.b = j, o.ratio = clip(inner(along, off) / length, 0.0, 1.0);
        }
      }
    }
    return o;
  }
  double ask_balance(const double* contact) {
    const double weight = w[R::BALANCE];
    if (weight == 0.0 || !(larger(contact[0], contact[1]) > 0.5 && larger(contact[2], contact[3]) > 0.5)) return 0.0;
    V center{0, 0, 0};
    for (int body = 0; body < robot.c.bodies; ++body)
      if (robot.mass[body] != 0.0) center = center + robot.mass[body] * center_of(body);
    const Overhang o = find_overhang(contact, center);
    const double third = o.width / 3.0, gap = o.distance + (w[R::INSIDE] < third ? w[R::INSIDE] : third);
    if (!(gap > 0.0)) return 0.0;
    for (int body = 0; body < robot.c.bodies; ++body)
      if (robot.mass[body] != 0.0) add_point_of(body, center_of(body), robot.mass[body] * o.direction);
    add_point(robot.c.keys + 4 + o.a, (o.ratio - 1.0) * o.direction);
    add_point(robot.c.keys + 4 + o.b, -o.ratio * o.direction);
    add_row(std::sqrt(w[R::STIFFNESS] * weight), gap);
    return 0.5 * weight * gap * gap;
  }

  // ---- frames
  // Where the middles of heels and toes are, x and y in turn, and how dofs move them.
  void stand(double* moving, double* points) {
    const int first = robot.c.keys + 4;
    for (int i = 0; i < robot.c.corners / 2; ++i) {
      const V middle = 0.5 * (point_at(first + 2 * i) + point_at(first + 2 * i + 1));
      for (int k = 0; k < 2; ++k) {
        add_point_of(robot.places[first + 2 * i], middle, axis(k));
        put_row(moving + (2 * i + k) * N, 1.0, 0.0);
      }
      points[2 * i] = middle.x, points[2 * i + 1] = middle.y;
    }
  }
  // x inside its bounds; NaN where one of the three is
  static double inside(double x, double low, double high) { return !(x >= low) ? low : x <= high ? x : high; }
  Cost ask_joints(const double* q, double* alone, double* gradient) const {
    Cost cost;
    for (int j = 0; j < n; ++j) {
      if (robot.joints[j] < 0) continue;
      const double now = q[robot.joints[j]], off = now - robot.rest[j];
      const double outside = now - inside(now, robot.lower[j], robot.upper[j]), limit = outside != 0.0 ? w[R::LIMIT] : 0.0;
      alone[j] = w[R::POSTURE] + w[R::STIFFNESS] * limit;
      gradient[j] = w[R::POSTURE] * off + w[R::STIFFNESS] * limit * outside;
      cost += {0.5 * w[R::POSTURE] * off * off, 0.5 * limit * outside * outside};
    }
    return cost;
  }
  Cost ask(int frame) {  // all rows of a frame with a weight
    row = 0;
    Cost cost;
    auto turned = [&](int i) { return robot.c.turned >> i & 1; };
    cost.soft += ask_limbs(goals.directions + size_t(3) * robot.c.limbs * frame,
                           goals.held + size_t(robot.c.reaches) * frame) +
                 ask_root(goals.root + 3 * frame);
    if (turned(0)) cost.soft += ask_rotation(0, goals.pelvis + 9 * frame, w[R::PELVIS]);
    for (int i = 0; i < 2; ++i)
      if (turned(2 + i)) cost.soft += ask_rotation(2 + i, goals.feet + 18 * frame + 9 * i, w[R::FOOT]);
    if (turned(1)) cost.soft += ask_rotation(1, goals.torso + 9 * frame, w[R::TORSO]);
    const double* contact = goals.contact + 4 * frame;
    cost.penalty += ask_floor(contact) + ask_apart() + ask_balance(contact);
    return cost;
  }
  // Tie the standing points of a frame to those of its neighbours, and make its matrix and gradient. `following`: where
  // those of the next frame are.
  void finish(const ClipSystem& out, int frame, int following) {
    const int own = frame % 2;
    double *rows_of_frame = rows[own], *block = out.blocks + size_t(frame) * N * N;
    int total = count[own];
    for (int k = 0; k < POINTS; ++k) {
      const double weight = tie_weight[own][k], next = tie_weight[following][k];
      if (!(weight + next > 0.0)) continue;
      const double root_weight = std::sqrt(weight + next), *moving = out.moving + (frame * POINTS + k) * N;
      double* to = rows_of_frame + total++ * N;
      for (int j = 0; j < N; ++j) to[j] = j < n ? root_weight * moving[j] : 0.0;
      to[n] = (weight * tie_move[own][k] - next * tie_move[following][k]) / root_weight;
    }
    Algebra::product(t, rows_of_frame, 1, N, rows_of_frame, N, block, N, n, total, N, true);
    for (int i = 0; i < n; ++i) out.gradient[frame * n + i] += block[i * N + n];
  }
  // Gauss-Newton's system of all frames at the configurations q [F, nq], and its cost.
  Cost ask_clip(const double* q, int frames, int nq, const ClipSystem& out) {
    Cost cost;
    for (int k = 0; k < POINTS; ++k) tie_weight[2][k] = tie_move[2][k] = at[0][k] = at[1][k] = 0.0;
    if (!robot.c.corners)
      for (int e = 0; e < frames * POINTS * N; ++e) out.moving[e] = 0.0;
    for (int f = 0; f < frames; ++f) {
      const int now = f % 2, last = 1 - now;
      const bool there = goals.present[f] != 0.0;
      const double* contact = goals.contact + 4 * f;
      for (int j = 0; j < n; ++j) out.alone[f * n + j] = out.gradient[f * n + j] = 0.0;
      count[now] = 0;
      if (there || contact[0] != 0.0 || contact[1] != 0.0 || contact[2] != 0.0 || contact[3] != 0.0) {
        place(q + f * nq);
        stand(out.moving + f * POINTS * N, at[now]);
      }
      for (int k = 0; k < POINTS; ++k) {
        const double weight = f > 0 ? w[R::TIED] * w[R::STANCE] * contact[k / 2] * contact[k / 2 - 4] : 0.0;
        const double move = weight != 0.0 ? at[now][k] - at[last][k] : 0.0;
        out.weight[f * POINTS + k] = tie_weight[now][k] = w[R::STIFFNESS] * weight, tie_move[now][k] = move;
        cost.penalty += 0.5 * weight * move * move;
      }
      if (f > 0) finish(out, f - 1, now);
      if (!there) continue;
      cost += ask_joints(q + f * nq, out.alone + f * n, out.gradient + f * n);
      J = rows[now];
      cost += ask(f);
      count[now] = row;
    }
    finish(out, frames - 1, 2);
    return cost;
  }
};

}  // namespace osik
