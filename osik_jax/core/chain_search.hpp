// Steps of a search for poses of frames that hinges and slides carry: ChainSearch.advance of inverse/_chain_search.py,
// with chain_kinematics and jacobian of inverse/_chain.py. Arguments and results as in inverse/_chain_kernel.py.
//
//   x <- clip(x - J' (J J' + damping I)^-1 e),   damping = share |e|^2 + least length^2
//
// J without the columns of joints at a limit beyond which the step would lead.
#pragma once
#include "kinematic_calls.hpp"

namespace osik {

// The larger one; NaN if one is.
template <class Real> OSIK_FN Real most(Real a, Real b) { return select((a != a) | (a > b), a, b); }

// Written for one search, and for a pack of them (lanes.hpp).
template <class Call> struct ChainSearch {
  using Real = typename Call::Real;
  using In = typename Call::In;
  using Numbers = typename Call::Numbers;  // a pointer
  using V = Vec3<Real>;
  using M = Mat3<Real>;
  struct Errors {
    Real position, orientation, score, cost;
  };
  int n, joints, frames, m, rows;                  // coordinates, joints, frames, rows of all frames and those that count
  bool near;                                       // whether what the frames leave free goes towards `start` in any
  const int *parent, *hinge, *coordinate, *end;    // [joints]: parent or `joints` for the world, ...; [frames] last joint
  const int *carries, *row;                        // [frames, joints] flags; [m] number among those that count or -1
  Numbers constant, first, second, offset, axis, anchor, tip, factor;  // [joints, 12] thrice, [joints], [joints, 3] twice,
  // [frames, 12], [joints]
  Numbers lower, upper, start, numbers;  // [n] thrice; length, tolerances, enough, share and least of damping
  Real pull, enough;  // 1 where it goes there, else 0; score at which a search ends, else
  Real *pose, *turned, *point, *e, *gram;  // [joints, 12]; [joints, 3] axes and points on them; [rows], [rows, rows]
  Real *tips, *J, *x, *home;  // [frames, 3] positions; [n, rows]; [n] coordinates and way to the start

  ChainSearch(const int* sizes, int n, int frames, Real* next) : n(n), frames(frames), m(6 * frames) {
    Reader<const int*> integers{sizes};
    joints = *integers.take(1), rows = *integers.take(1), near = *integers.take(1), pull = near ? 1 : 0;
    parent = integers.take(joints), hinge = integers.take(joints), coordinate = integers.take(joints);
    end = integers.take(frames), carries = integers.take(frames * joints), row = integers.take(m);
    Reader<Real*> space{next};
    pose = space.take(12 * joints), turned = space.take(3 * joints), point = space.take(3 * joints);
    tips = space.take(3 * frames), e = space.take(m), gram = space.take(m * m);
    J = space.take(n * m), x = space.take(n), home = space.take(n);
  }
  static constexpr OSIK_HOST int space_of(int n, int frames, int joints) {
    return 18 * joints + 3 * frames + 2 * n + 6 * frames * (6 * frames + n + 1);
  }
  void read(Numbers given) {
    Reader<Numbers> at{given};
    constant = at.take(12 * joints), first = at.take(12 * joints), second = at.take(12 * joints);
    offset = at.take(joints), axis = at.take(3 * joints), anchor = at.take(3 * joints), tip = at.take(12 * frames);
    factor = at.take(joints), lower = at.take(n), upper = at.take(n), start = at.take(n), numbers = at.at,
    enough = numbers[3];
  }

  // Rotation and position of a pose [3, 4].
  template <class At> static M turn_of(At a) { return {V::of(a), V::of(a + 4), V::of(a + 8)}; }
  template <class At> static V place_of(At a) { return {a[3], a[7], a[11]}; }
  M turn_of_joint(int joint) const { return joint < joints ? turn_of(pose + 12 * joint) : M::identity(); }
  V place_of_joint(int joint) const { return joint < joints ? place_of(pose + 12 * joint) : V{0, 0, 0}; }

  void place() {
    M turn = M::identity();  // of the joint before
    V at{0, 0, 0};
    for (int j = 0; j < joints; ++j) {
      const Real angle = (coordinate[j] < 0 ? Real(0) : x[coordinate[j]] * factor[j]) + offset[j];
      Real s, c;
      sine_and_cosine(Real(0.5) * angle, s, c);
      const Real f = hinge[j] ? Real(2) * s * c : angle, g = hinge[j] ? Real(2) * s * s : Real(0);
      Real local[12];
      OSIK_UNROLL
      for (int i = 0; i < 12; ++i) local[i] = constant[12 * j + i] + f * first[12 * j + i] + g * second[12 * j + i];
      const bool is_next = parent[j] == j - 1;
      const M before = is_next ? turn : turn_of_joint(parent[j]);
      at = before * place_of(local + 0) + (is_next ? at : place_of_joint(parent[j])), turn = before * turn_of(local + 0);
      Real* to = pose + 12 * j;
      turn.a.put(to), turn.b.put(to + 4), turn.c.put(to + 8);
      to[3] = at.x, to[7] = at.y, to[11] = at.z;
      (turn * V::of(axis + 3 * j)).put(turned + 3 * j), (turn * V::of(anchor + 3 * j) + at).put(point + 3 * j);
    }
  }
  // Errors of the frames, and e.
  Errors compare(In goal) {
    const Real length = numbers[0];
    Errors found{0, 0, 0, 0};
    for (int f = 0; f < frames; ++f) {
      const M carrier = turn_of_joint(end[f]), turn = carrier * turn_of(tip + 12 * f);
      const V at = carrier * place_of(tip + 12 * f) + place_of_joint(end[f]);
      at.put(tips + 3 * f);
      const V linear = at - V::of(goal + 12 * f), angular = rotation_log(turn * M::of(goal + (12 * f + 3)).transposed());
      const Real off[] = {linear.x, linear.y, linear.z, angular.x, angular.y, angular.z};
      Real squares[2] = {0, 0};
      for (int i = 0; i < 6; ++i) {
        const int own = row[6 * f + i];
        if (own < 0) continue;
        e[own] = off[i] * (i < 3 ? Real(1) : length);
        squares[i / 3] += off[i] * off[i], found.cost += e[own] * e[own];
      }
      found.position = most(found.position, sqrt(squares[0])), found.orientation = most(found.orientation, sqrt(squares[1]));
    }
    found.score = most(found.position / numbers[1], found.orientation / numbers[2]);
    return found;
  }
  // J, the derivative of e.
  void differentiate() {
    for (int k = 0; k < n * rows; ++k) J[k] = 0;
    for (int j = 0; j < joints; ++j) {
      if (coordinate[j] < 0) continue;
      Real* const column = J + coordinate[j] * rows;
      const V own = Real(factor[j]) * V::of(turned + 3 * j), at = V::of(point + 3 * j);
      for (int f = 0; f < frames; ++f) {
        if (!carries[f * joints + j]) continue;
        const V linear = hinge[j] ? cross(own, V::of(tips + 3 * f) - at) : own;
        const V angular = Real(hinge[j] ? numbers[0] : 0) * own;
        const Real off[] = {linear.x, linear.y, linear.z, angular.x, angular.y, angular.z};
        OSIK_UNROLL
        for (int i = 0; i < 6; ++i)
          if (row[6 * f + i] >= 0) column[row[6 * f + i]] += off[i];
      }
    }
  }
  // Solve gram y = e by elimination, of which the lower triangle is given; y in place of e. ROWS: 0 or known before.
  template <int ROWS> void eliminate(Real* gram, Real* e) const {
    const int rows = ROWS ? ROWS : this->rows;
    OSIK_UNROLL
    for (int k = 0; k < rows; ++k) {
      const Real inverse = Real(1) / gram[k * rows + k];
      OSIK_UNROLL
      for (int i = k + 1; i < rows; ++i) {
        const Real ratio = gram[i * rows + k] * inverse;
        OSIK_UNROLL
        for (int j = k + 1; j <= i; ++j) gram[i * rows + j] -= ratio * gram[j * rows + k];
        e[i] -= ratio * e[k];
      }
    }
    OSIK_UNROLL
    for (int k = rows - 1; k >= 0; --k) {
      OSIK_UNROLL
      for (int i = k + 1; i < rows; ++i) e[k] -= gram[i * rows + k] * e[i];
      e[k] = e[k] / gram[k * rows + k];
    }
  }
  // Whether a search with these errors is at its end. One towards `start` goes on.
  auto is_done(const Errors& found) const { return (found.score <= enough) & (pull == Real(0)); }
  // The errors at x, and the next point in its place.
  template <int ROWS> Errors step(In goal) {
    const int rows = ROWS ? ROWS : this->rows;
    Real registers[ROWS ? ROWS * (ROWS + 1) : 1];  // of a GPU, because every loop over them is unrolled
    Real *const gram = ROWS ? registers : this->gram, *const e = ROWS ? registers + ROWS * ROWS : this->e;
    place();
    const Errors found = compare(goal);
    const auto is_at_end = is_done(found);
    if (!any(!is_at_end)) return found;
    differentiate();
    const Real damping = numbers[4] * found.cost + numbers[5] * numbers[0] * numbers[0];
    OSIK_UNROLL
    for (int a = 0; a < rows; ++a) {
      e[a] = this->e[a];
      OSIK_UNROLL
      for (int b = 0; b <= a; ++b) gram[a * rows + b] = a == b ? damping : Real(0);
    }
    for (int j = 0; j < n; ++j) {
      Real *column = J + j * rows, gradient = 0;
      OSIK_UNROLL
      for (int a = 0; a < rows; ++a) gradient += column[a] * e[a];
      const Real zero = 0, low = lower[j], high = upper[j];
      const auto is_stopped = ((x[j] <= low) & (gradient > zero)) | ((high <= x[j]) & (gradient < zero));
      for (int a = 0; a < rows && any(is_stopped); ++a) column[a] = select(is_stopped, zero, column[a]);
      home[j] = near ? select(is_stopped, zero, pull * (start[j] - x[j])) : zero;
      OSIK_UNROLL
      for (int a = 0; a < rows; ++a) {
        OSIK_UNROLL
        for (int b = 0; b <= a; ++b) gram[a * rows + b] += column[a] * column[b];
      }
    }
    for (int j = 0; j < n && near; ++j) {
      OSIK_UNROLL
      for (int a = 0; a < rows; ++a) e[a] += J[j * rows + a] * home[j];
    }
    eliminate<ROWS>(gram, e);
    for (int j = 0; j < n; ++j) {
      Real to = x[j] + home[j];
      OSIK_UNROLL
      for (int a = 0; a < rows; ++a) to -= J[j * rows + a] * e[a];
      to = select(to < Real(lower[j]), Real(lower[j]), select(to > Real(upper[j]), Real(upper[j]), to));
      x[j] = select(is_at_end, x[j], to);
    }
    return found;
  }
  // Take steps from x to x; `here` becomes the start of the last one, whose errors are returned.
  template <class Out> Errors advance(int steps, In goal, Out here) {
    Errors found{};
    bool is_at_end = false;  // all of a pack
    for (int at = 0; at < steps && !is_at_end; ++at) {
      for (int j = 0; j < n; ++j) here[j] = x[j];
      found = rows == 6 ? step<6>(goal) : step<0>(goal);
      is_at_end = !any(!is_done(found));
    }
    return found;
  }
};

template <class Call> void advance_chain(const Call& call) {
  const int n = call.size(0, 1), frames = call.size(1, 1), *integers = call.integers(3);
  auto space = call.space();
  ChainSearch<Call> search(integers + 1, n, frames, space.data());
  call.each_lane([&](int lane) {
    search.read(call.numbers(2, lane));
    auto x = call.in(0, lane);
    auto here = call.out(0, lane), there = call.out(1, lane), errors = call.out(2, lane);
    for (int j = 0; j < n; ++j) search.x[j] = x[j];
    const auto found = search.advance(integers[0], call.in(1, lane), here);
    for (int j = 0; j < n; ++j) there[j] = search.x[j];
    errors[0] = found.position, errors[1] = found.orientation, errors[2] = found.score, errors[3] = found.cost;
  });
}
}  // namespace osik
