// Saturation in the null space: each level gets the largest scale of its motion that a box allows. The problem is the one
// that solvers/null_space/_saturation.py states, and the search is solve_scaled_motion (_scaled_motion.py) by another
// method. A problem without an answer here is searched there.
//
//   min 1/2 |point - target|^2   over   point = x + scale motion + Z'u,   low <= point <= high
//
// for the largest scale <= 1 for which there is such a point, with Z the free rows of the basis (null_space.hpp).
//
// At a given scale it is the dual method of D. Goldfarb and A. Idnani ("A numerically stable dual method for solving
// strictly convex quadratic programs", Mathematical Programming 27, 1983). It begins at the minimiser without bounds.
// Joints that are violated are put on their bounds one after another, and saturated joints whose multiplier becomes 0
// meanwhile are released. The cost never falls, so that no set of joints returns. Where the column of a joint in Z is
// sum_a rate_a column_a of saturated joints, and none of these can be released,
//
//   normal . point = point_k - sum_a rate_a point_a
//
// is what the null space does not change, and no point in the box has the value that the scale needs. The scale is then
// lowered to where all of these joints are on their bounds; no larger one is possible, and 0 is, for x is in the box.
// These joints stop the motion. They stay where they are: with enough of the normal added all their multipliers have the
// right sign. Where a further combination releases one of them, the free joint among them takes its place. The search
// goes on at the new scale and first releases those that push in the wrong direction there. The scale falls with each
// cut, so that there are finitely many.
//
// The first `count` free coordinates have all of the saturated joints (an orthogonal factorisation): what rounding does
// is then in proportion to how dependent the joints are, and not to its square.
#pragma once
#include "null_space.hpp"

namespace osik {

// The data of one problem. Levels are padded to m rows.
struct SaturationProblem {
  const double *matrix, *lower, *upper;                      // [L, m, n], [L, m], [L, m] weights multiplied in
  const double *constant, *unmet, *demand, *bends, *targets;  // [L] three times, [L, n], [L, n]
  const double *low, *high;                                  // [n] the box
  const int* equality;                                       // [L, m] flags
  double rank_tol;
  int max_changes;  // limit on the changes of the active set, for each level
  int L, m;         // levels, rows of each
  int row, column;  // entry i of row a of level k is at matrix[k m n + a row + i column]
};

// The results of one problem. Sides are -1 (lower), 1 (upper) or 2 (pinned), 0 for none.
struct SaturationAnswer {
  double *x, *projector, *scales;                        // [n], [n, n] or null, [L]
  int *ended, *sides, *blocking, *blockers, *active, *report;  // [L], [L, n], [L, n], [L], [n], [2] done, changes
};

template <class Team> struct Saturation : NullSpace<Team> {
  using Base = NullSpace<Team>;
  using Base::t, Base::n, Base::ld, Base::lb, Base::first, Base::rows, Base::damping, Base::free;
  using Base::Z, Base::B, Base::X, Base::LOW, Base::HIGH, Base::MOTION, Base::COORDINATES, Base::WANTED, Base::IN_COST,
      Base::MISSING;
  using typename Base::Algebra, typename Base::Int;
  enum Step { CHOOSE, REPLACE, STOP };  // a joint leaves or enters; one enters in place of another; one stops the motion
  using typename Base::Space;

  // The search's numbers are in the place of those from which the level's damping and motion were computed. WANTED,
  // MISSING, COORDINATES and IN_COST stay, which the search reads.

  // coordinates of the saturated joints, each with 1 along its own joint's column and 0 along the others'. [n, lb]
  OSIK_PLACED(Matrix, 2, DUALS);
  double* BEFORE;        // [n, ld] the free rows of the basis before the search
  const double* target;  // [n]
  // joints: the point of the search; the target's part in it; a direction; the combination that stops the motion; the
  // point at scale 0; the last point that was accepted
  OSIK_PLACED(Numbers, 8, POINT, TARGET_PART, DIRECTION, NORMAL, START, KEPT);
  OSIK_PLACED(Matrix, 0, COLUMN);  // coordinates of a joint
  // saturated joints, in the order of their coordinates: multipliers, their part of a column, way to their bounds
  OSIK_PLACED(Numbers, 14, MULTIPLIER, RATE, GAP);
  // joints; PASSED: free ones that saturated ones put on their bounds. The last two: saturated joints, whether they stop
  // the motion
  OSIK_PLACED(Labels, 3, SIDE, PASSED, BLOCKING, FIXED, KEPT_SIDE, JOINT, STOPS);
  int count, stop;  // number of saturated joints; the joint that stops the motion, -1 for none
  double scale;
  // the search: changes of the active set, and their limit
  int changes, most_changes;
  Step step;
  int entering, joint, side;          // the joint that enters, the joint of this step, the bound that it goes to
  int leaving, released, released_side;  // the saturated joint that leaves; which it was, and its bound
  int crossings, passes;              // exchanges of this joint at this scale; how often to settle
  double sign, push, stop_rate;       // of the entering joint, its multiplier so far; of the scale
  bool dropping, crossing, is_known;

  static constexpr OSIK_HOST int bytes(const NullSpaceSizes& s) { return Base::bytes(s, 10); }
  OSIK_FN Saturation(const NullSpaceSizes& s, char* space, double* outside = nullptr)
      : Base(s, space, outside), BEFORE(this->V) {}

  OSIK_FN double bound(int i) const { return SIDE[i] > 0 ? HIGH[i] : LOW[i]; }
  OSIK_FN double bound_passed(int i) const { return PASSED[i] < 0 ? LOW[i] : HIGH[i]; }
  // the dual of a saturated joint times a vector of coordinates
  OSIK_FN double dual_times(int a, const double* v) const { return t.own_dot(DUALS + a * lb + first, v + first, 0, count); }
  // out = Z'v over the rows [start, stop) of Z
  OSIK_FN void from_basis(const double* v, int start, int stop, double* out, bool add = false) {
    Algebra::combine(t, Z + start * ld, v + start, out, ld, stop - start, 0, n, add);
  }

  // ---- the saturated joints
  // POINT at the scale with the saturated joints on their bounds, and their multipliers; refined once
  OSIK_METHOD void settle() {
    t.each(0, n, [&](int i) { POINT[i] = X[i] + scale * MOTION[i] + TARGET_PART[i]; });
    t.each(0, count, [&](int a) { MULTIPLIER[a] = 0.0; });
    for (int again = 0; again < 2 && count > 0; ++again) {
      t.each(0, count, [&](int a) { GAP[a] = bound(JOINT[a]) - POINT[JOINT[a]]; });
      Algebra::combine(t, DUALS + first, GAP, COORDINATES + first, lb, count, 0, count, false);
      from_basis(COORDINATES, first, first + count, POINT, true);
      t.each(0, count, [&](int a) { MULTIPLIER[a] += dual_times(a, COORDINATES); });
    }
  }
  // RATE = the saturated joints' part of joint k's column, DIRECTION = how joints move along the rest; returns the
  // squared length of the rest
  OSIK_METHOD double look_along(int k) {
    const int end = first + count;
    t.each(first, n, [&](int j) { COLUMN[j] = Z[j * ld + k]; });
    t.each(0, count, [&](int a) { RATE[a] = dual_times(a, COLUMN); });
    from_basis(COLUMN, end, n, DIRECTION);
    return t.dot(COLUMN, COLUMN, end, n);
  }
  // Reflect the rows [start, stop) of Z so that COLUMN, of this norm, is along row `head` alone. DIRECTION is Z'COLUMN.
  // COLUMN becomes the vector of the reflection, whose scale is returned.
  OSIK_FN double reflect_column(int head, double norm, int start, int end) {
    const double top = COLUMN[head], by = top < 0.0 ? -norm : norm, weight = 1.0 / (norm * (norm + fabs(top)));
    t.axpy(DIRECTION, by, Z + head * ld, 0, n);
    t.once([&] { COLUMN[head] = top + by; });
    t.columns(0, n, [&](auto c) {
      const auto along = c.load(DIRECTION);
      for (int j = start; j < end; ++j) {
        auto x = c.load(Z + j * ld);
        c.store(Z + j * ld, x.fma(-weight * COLUMN[j], along));
      }
    });
    this->identity = false;
    return weight;
  }
  // make joint k the last of the saturated ones, after look_along
  OSIK_METHOD void saturate(int k, double square, int its_side, double multiplier, bool stops) {
    const int head = first + count;
    reflect_column(head, sqrt(square), head, n);
    const double by = 1.0 / Z[head * ld + k];
    t.each(head + 1, n, [&](int j) { Z[j * ld + k] = 0.0; });
    t.each(0, count, [&](int a) { DUALS[a * lb + head] = -RATE[a] * by; });
    t.each(first, head + 1, [&](int j) { DUALS[count * lb + j] = j == head ? by : 0.0; });
    t.once([&] { JOINT[count] = k, STOPS[count] = stops, MULTIPLIER[count] = multiplier, SIDE[k] = its_side; });
    ++count;
  }
  // release a saturated joint; where `moves`, to where it has no multiplier
  OSIK_METHOD void release(int a, bool moves) {
    const int end = first + count, last = end - 1;
    double *own = DUALS + a * lb, *last_dual = DUALS + (count - 1) * lb;
    from_basis(own, first, end, DIRECTION);
    t.each(0, count, [&](int b) { RATE[b] = (b == a ? 1.0 : 0.0) - DIRECTION[JOINT[b]]; });
    Algebra::combine(t, DUALS + first, RATE, COLUMN + first, lb, count, 0, count, false);  // once more, for rounding
    t.each(first, end, [&](int j) { COLUMN[j] = own[j] += COLUMN[j]; });
    from_basis(own, first, end, DIRECTION);
    const double square = t.dot(COLUMN, COLUMN, first, end), by = moves ? MULTIPLIER[a] / square : 0.0;
    if (by != 0.0) {
      t.axpy(POINT, -by, DIRECTION, 0, n);
      t.each(0, count, [&](int b) { RATE[b] = dual_times(b, own); });
      t.axpy(MULTIPLIER, -by, RATE, 0, count);
    }
    const double weight = reflect_column(last, sqrt(square), first, end);
    t.each(first, end, [&](int j) { own[j] = last_dual[j]; });
    t.once([&] {
      SIDE[JOINT[a]] = 0;
      JOINT[a] = JOINT[count - 1], STOPS[a] = STOPS[count - 1], MULTIPLIER[a] = MULTIPLIER[count - 1];
    });
    t.each(0, count - 1, [&](int b) {
      t.own_axpy(DUALS + b * lb, -weight * dual_times(b, COLUMN), COLUMN, first, end);
      DUALS[b * lb + last] = Z[last * ld + JOINT[b]] = 0.0;
    });
    --count;
  }

  // ---- the joints that stop the motion
  // the scale at which joint k, whose column saturated joints make up, is on its bound with them; and the rate of its gap
  OSIK_METHOD double scale_of(int k, int its_side, double least, double& its_rate) {
    t.each(first, first + count, [&](int j) {  // the rates once more, for rounding
      double total = 0.0;
      for (int a = 0; a < count; ++a) total += RATE[a] * Z[j * ld + JOINT[a]];
      COLUMN[j] -= total;
    });
    t.each(0, count, [&](int a) { RATE[a] += dual_times(a, COLUMN); });
    const double largest = largest_rate();
    t.each(0, count, [&](int a) { RATE[a] = fabs(RATE[a]) > least * largest ? RATE[a] : 0.0; });
    const double gap = (its_side < 0 ? LOW[k] : HIGH[k]) - X[k] - t.sum(0, count, [&](int a) {
      const int i = JOINT[a];
      return RATE[a] != 0.0 ? RATE[a] * (bound(i) - X[i]) : 0.0;
    });
    its_rate = MOTION[k] - t.sum(0, count, [&](int a) { return RATE[a] * MOTION[JOINT[a]]; });
    return its_rate != 0.0 ? clip(gap / its_rate, 0.0, 1.0) : 1.0;
  }
  // joint k and those that its column is made of stop the motion: no other one is outside of its bounds or released
  OSIK_METHOD void stop_by(int k, int its_side) {
    t.each(0, n, [&](int i) { NORMAL[i] = i == k, PASSED[i] = i == k ? its_side : 0; });
    t.each(0, count, [&](int a) { STOPS[a] = RATE[a] != 0.0, NORMAL[JOINT[a]] = -RATE[a]; });
    stop = k;
  }
  // settle, at the scale near this one that puts the joint that stops the motion on its bound; so many times at most
  OSIK_METHOD void settle_stopped() {
    while (passes > 0) {
      settle();
      const double off = stop < 0 ? 0.0 : bound_passed(stop) - POINT[stop];
      if (off == 0.0 || --passes == 0) break;
      scale = clip(scale + off / stop_rate, 0.0, 1.0);
    }
    passes = 0;
  }

  // ---- which joint enters or leaves next; -1 for none
  OSIK_FN double largest_rate() const {
    return t.most(1.0, 0, count, [&](int a, double) { return fabs(RATE[a]); });
  }
  // the size of the numbers that POINT is made of
  OSIK_METHOD double size_of_numbers() {
    const double most = t.most(0.0, 0, n,
                               [&](int i, double) { return fabs(X[i]) + scale * fabs(MOTION[i]) + fabs(target[i]); });
    return t.most(most, 0, count, [&](int a, double) { return fabs(bound(JOINT[a])); });
  }
  // the saturated joint with the largest multiplier of the wrong sign
  OSIK_METHOD int most_wrong(double roundoff) {
    return t.best(roundoff, 0, count, [&](int a) { return STOPS[a] ? 0.0 : SIDE[JOINT[a]] * MULTIPLIER[a]; }).which;
  }
  // how far a saturated joint would go that is released: 0 where all multipliers have the right sign
  OSIK_METHOD double step_left() {
    return t.most(0.0, 0, count, [&](int a, double) {
      const double wrong = SIDE[JOINT[a]] * MULTIPLIER[a];
      return STOPS[a] || !(wrong > 0.0) ? 0.0 : wrong / sqrt(dual_times(a, DUALS + a * lb));
    });
  }
  // the free joint that is furthest outside of its bounds
  OSIK_METHOD int most_violated(double roundoff) {
    return t
        .best(roundoff, 0, n, [&](int i) {
      return SIDE[i] || PASSED[i] ? 0.0 : larger(LOW[i] - POINT[i], POINT[i] - HIGH[i]);
    }).which;
  }
  // the saturated joint whose multiplier is the first to become 0, and the dual step there, infinite for none
  OSIK_METHOD int first_to_leave(double negligible, double& length) {
    const Best<double> b = t.best(-INFINITE, 0, count, [&](int a) {
      const int its_side = SIDE[JOINT[a]];
      const double falls = -its_side * sign * RATE[a];
      return !STOPS[a] && falls > negligible ? -larger(0.0, -its_side * MULTIPLIER[a]) / falls : -INFINITE;
    });
    length = -b.value;
    return b.which;
  }
  // the saturated joint among those that stop the motion which a further combination releases
  OSIK_METHOD int first_to_cross(double negligible) {
    return t
        .best(0.0, 0, count, [&](int a) {
      const double falls = -SIDE[JOINT[a]] * sign * RATE[a];
      return STOPS[a] && falls > negligible ? falls / fabs(NORMAL[JOINT[a]]) : 0.0;
    }).which;
  }

  // ---- the search. One loop goes from step to step, so that each method that changes the basis has one place in the
  // program: a joint that is exchanged for another one leaves in one step, and the other follows in the next.
  // Begin at a scale with the joints that are saturated.
  OSIK_METHOD void go_on(double its_scale) {
    stop = -1, scale = its_scale, changes = 0, step = CHOOSE, entering = leaving = -1, passes = 1, crossings = 0;
    dropping = count > 0, crossing = is_known = false, push = stop_rate = 0.0, sign = 1.0;
    t.each(0, n, [&](int i) { STOPS[i] = PASSED[i] = 0; });
  }
  // Begin at a scale with no saturated joint, and with the target's part in the null space.
  OSIK_METHOD void begin_search(double its_scale) {
    count = 0;
    go_on(its_scale);
    t.each(0, n, [&](int i) { DIRECTION[i] = target[i] - X[i], SIDE[i] = 0; });
    t.each(first, n, [&](int j) { COORDINATES[j] = t.own_dot(Z + j * ld, DIRECTION, 0, n); });
    from_basis(COORDINATES, first, n, TARGET_PART);
  }
  // Choose the joint that leaves, else the one that enters; false where there is none.
  OSIK_METHOD bool choose(double roundoff) {
    leaving = dropping ? most_wrong(roundoff) : -1;
    dropping = leaving >= 0;
    if (!dropping && entering < 0) {
      entering = most_violated(roundoff);
      if (entering < 0) return false;
      sign = LOW[entering] - POINT[entering] >= POINT[entering] - HIGH[entering] ? 1.0 : -1.0;
      push = 0.0, crossings = 0;
    }
    joint = entering, side = sign > 0.0 ? -1 : 1;
    ++changes;
    return true;
  }
  // After look_along: move until a multiplier is 0, or the joint on its bound, which is returned. Where neither can be, a
  // joint that stops the motion is exchanged, or this one stops it.
  OSIK_METHOD bool move(double square, double least) {
    const double outside = larger(0.0, sign > 0.0 ? LOW[joint] - POINT[joint] : POINT[joint] - HIGH[joint]);
    const double full = square > least * least ? outside / square : INFINITE, largest = largest_rate();
    double length;
    leaving = first_to_leave((full < INFINITE ? SATURATION_ROUNDOFF : least) * largest, length);
    if (leaving < 0 && full == INFINITE) {
      leaving = first_to_cross(least * largest);
      crossing = leaving >= 0;
      if (crossing) ++crossings, ++changes, joint = stop, step = REPLACE;
      else entering = -1, step = STOP;
      return false;
    }
    const double by = sign * (length < full ? length : full);
    t.axpy(POINT, by, DIRECTION, 0, n);
    t.axpy(MULTIPLIER, -by, RATE, 0, count);
    push += by;
    if (length < full) return false;
    leaving = -1;
    return true;
  }
  // After look_along: the joint stops the motion, or is exchanged for the one with the largest rate, which then does.
  OSIK_METHOD void stop_or_exchange(double least) {
    double its_rate;
    const double its_scale = scale_of(joint, side, least, its_rate);
    step = CHOOSE;
    if (!is_known) {
      t.once([&] { PASSED[joint] = side; });
      if (!(its_scale < scale - SATURATION_ROUNDOFF)) return;  // but for rounding it is where the others put it
      leaving = t.best(LARGEST_RATE, 0, count, [&](int a) { return fabs(RATE[a]); }).which;
      if (leaving >= 0) {
        changes += 2, step = REPLACE;
        return;
      }
    }
    stop_by(joint, side);
    stop_rate = its_rate, scale = its_scale < scale ? its_scale : scale;
    dropping = true, is_known = false, passes = 3;
  }
  // Saturate the joint: the one that enters, or one that stops the motion in place of the one that was released.
  OSIK_METHOD void enter(double square) {
    const bool replaces = step == REPLACE;
    saturate(joint, square, replaces ? int(PASSED[joint]) : side, replaces ? 0.0 : push, replaces);
    if (replaces) {
      t.once([&] { PASSED[joint] = 0, PASSED[released] = released_side; });
      if (crossing) stop = released, push = 0.0, passes = 1, step = CHOOSE;
      else joint = released, side = released_side, is_known = true, step = STOP;
      crossing = false;
    } else {
      t.once([&] { POINT[joint] = bound(joint); });
      entering = -1;
    }
  }
  // After begin_search or go_on: find POINT in its box, at a scale of at most the one that it began with; false where
  // that fails. A part of a combination below `least` counts as none.
  OSIK_METHOD bool search(double least) {
    double size = 0.0;
    int checks = 0;
    for (bool done = false, ended = false;;) {
      if (passes > 0) {
        settle_stopped();
        size = size_of_numbers();
      }
      if (ended) {  // multipliers that are huge may have turned the sign of another one by rounding
        const bool right = done && step_left() <= SATURATION_LOSS * size;
        dropping = done && !right && checks++ < SIGN_CHECKS;
        if (!dropping) return right;
        done = false;
      }
      ended = step == CHOOSE && (changes >= most_changes || crossings > n);  // more exchanges repeat, by rounding
      if (step == CHOOSE && !ended) ended = done = !choose(SATURATION_ROUNDOFF * size);
      if (ended) {
        passes = count > 0 ? 3 : 0;
        continue;
      }
      bool enters = step == REPLACE;
      const double square = dropping ? 0.0 : look_along(joint);
      if (step == CHOOSE && !dropping) enters = move(square, least);
      if (step == STOP) stop_or_exchange(least);
      if (leaving >= 0) {
        released = JOINT[leaving], released_side = SIDE[released];
        release(leaving, dropping);
        leaving = -1;
      } else if (enters) {
        enter(square);
        size = larger(size, fabs(POINT[joint]));
      }
    }
  }

  // ---- the judge: a search whose answer does not hold leaves the basis as it was
  // Put joints on their bounds, where they are up to roundoff; returns that roundoff, infinite where POINT is NaN.
  OSIK_METHOD double put_on_bounds() {
    return t.most(0.0, 0, n, [&](int i, double) {
      const double before = POINT[i], at = SIDE[i] ? bound(i) : i == stop ? bound_passed(i) : before;
      POINT[i] = clip(at, LOW[i], HIGH[i]);
      const double moved = fabs(POINT[i] - before);
      return moved < INFINITE ? moved : INFINITE;
    });
  }
  // How much larger the scale may be: what is left of the combination that stops the motion, or wrong in it. By as much
  // of it as the null space changes, other joints may make room, each by about `size`. So do joints whose bound is not
  // the one at which the combination is largest.
  OSIK_METHOD double scale_left(double size) {
    const double square = t.sum(first, n, [&](int j) {
      const double changed = t.own_dot(Z + j * ld, NORMAL, 0, n);
      return changed * changed;
    });
    const double rate = t.dot(NORMAL, MOTION, 0, n), way = rate > 0.0 ? 1.0 : -1.0;
    const double wrong = t.sum(0, n, [&](int i) {
      const int its_side = i == stop ? PASSED[i] : SIDE[i];
      return larger(0.0, -its_side * NORMAL[i] * way);
    });
    return rate != 0.0 ? (sqrt(square) + wrong) * size / fabs(rate) : INFINITE;
  }
  // Whether joints are in their box, and no larger scale is possible.
  OSIK_FN bool holds(double size) {
    const double off = put_on_bounds();
    if (!(off < INFINITE && off <= SATURATION_RESIDUAL * size)) return false;
    return stop < 0 || scale_left(size) <= SATURATION_LOSS;
  }
  // After a search that may miss the motion in part: the scale at which it ended, and the joint that stops the motion.
  // The multipliers are the combination of joints that stops it: the missing part pulls at it with nearly all.
  OSIK_METHOD void find_stop() {
    const double square = t.dot(MOTION, MOTION, 0, n);
    const double moved = t.sum(0, n, [&](int i) { return MOTION[i] * (POINT[i] - X[i] - TARGET_PART[i]); });
    scale = square > 0.0 ? clip(moved / square, 0.0, 1.0) : 1.0;
    stop = -1;
    t.each(0, n, [&](int i) { NORMAL[i] = 0.0; });
    if (scale >= 1.0 - PATH_STEP) return;
    const Best<double> b = t.best(0.0, 0, count, [&](int a) { return fabs(MULTIPLIER[a]); });
    if (b.which < 0) return;
    t.each(0, count, [&](int a) { NORMAL[JOINT[a]] = MULTIPLIER[a] / b.value; });
    stop = JOINT[b.which];
    t.once([&] { PASSED[stop] = SIDE[stop]; });
  }
  // Search from the joints that are saturated (`goes_on`) or from none; returns whether the answer is accepted. With a
  // compliance the motion may be missed in part: the missing part is a short coordinate before the free ones, moves along
  // it cost less. Any scale then has an answer, and joints that nearly depend on each other need no decision.
  OSIK_METHOD bool attempt(double its_scale, double least, double compliance, bool goes_on) {
    const bool soft = compliance > 0.0;
    const int start = first - soft;
    if (goes_on) go_on(its_scale);
    else copy_rows(Z, BEFORE, start), begin_search(its_scale);
    if (soft) {
      const double square = t.dot(MOTION, MOTION, 0, n), root = square > 0.0 ? sqrt(compliance / square) : 0.0;
      t.each(0, n, [&](int i) { Z[start * ld + i] = root * MOTION[i]; });
    }
    first = start;
    bool done = search(least);
    const double size = size_of_numbers();
    first += soft;
    if (soft) {
      done = done && stop < 0;
      find_stop();
      copy_rows(BEFORE, Z, start);
    }
    done = done && holds(size);
    if (soft) t.each(0, n, [&](int i) { NORMAL[i] = fabs(NORMAL[i]) > NEGLIGIBLE_ENTRY ? NORMAL[i] : 0.0; });
    else if (!done) copy_rows(BEFORE, Z, start);
    return done;
  }
  OSIK_FN void copy_rows(const double* from, double* to, int start) {  // from row `start` on
    t.each(start, n, [&](int j) {
      for (int i = 0; i < n; ++i) to[j * ld + i] = from[j * ld + i];
    });
  }

  // ---- the end of the level's motion, or what comes before it where that has the least damped cost
  // the part of the step from x to POINT at which the damped cost of the level is least
  OSIK_METHOD double damped_part() {
    if (!(damping > 0.0)) return 1.0;
    t.each(0, n, [&](int i) { DIRECTION[i] = POINT[i] - X[i]; });
    const double square = t.dot(DIRECTION, DIRECTION, 0, n);
    if (!(square > NEGLIGIBLE_STEP * NEGLIGIBLE_STEP * t.dot(X, X, 0, n))) return 1.0;
    double cost = damping * square;
    const double gain = gain_along(DIRECTION, cost), part = gain / (cost > 0.0 ? cost : 1.0);
    return cost > 0.0 && part < FULL_STEP ? larger(0.0, part) : 1.0;
  }
  // what the rows in the cost gain along a direction at first order; half of what they cost at second order is added
  OSIK_METHOD double gain_along(const double* direction, double& cost) {
    this->evaluate(direction, MISSING);
    cost += t.sum(0, rows, [&](int a) { return IN_COST[a] ? MISSING[a] * MISSING[a] : 0.0; });
    return t.sum(0, rows, [&](int a) { return IN_COST[a] ? MISSING[a] * WANTED[a] : 0.0; });
  }
  // the scale at which the damped cost of the level is least, with the saturated joints on their bounds
  OSIK_METHOD double best_scale() {
    for (int end = 0; end < 2; ++end) {
      scale = end;
      settle();
      if (end == 0) t.each(0, n, [&](int i) { START[i] = POINT[i]; });
    }
    double cost = damping * t.sum(0, n, [&](int i) {
      const double forward = POINT[i] - START[i];
      return forward * forward;
    });
    const double gain = -damping * t.sum(0, n, [&](int i) { return START[i] * (POINT[i] - START[i]) - X[i] * MOTION[i]; }) +
                        gain_along(MOTION, cost);
    return cost > 0.0 ? gain / cost : 1.0;
  }
  // BLOCKING = sides of the joints that stop the motion; returns the one with the largest entry in their combination
  OSIK_METHOD int find_blocking() {
    t.each(0, n, [&](int i) { BLOCKING[i] = stop < 0 || NORMAL[i] == 0.0 ? 0 : i == stop ? PASSED[i] : SIDE[i]; });
    const int blocker = stop < 0 ? -1 : t.best(0.0, 0, n, [&](int i) { return fabs(NORMAL[i]); }).which;
    return blocker < 0 ? 0 : blocker;
  }
  // Keep a part of the way from X to a point. The joint that stops the motion is on its bound in place of the blocker.
  OSIK_METHOD void keep(const double* point, double part, int blocker) {
    t.each(0, n, [&](int i) {
      KEPT[i] = part == 1.0 ? point[i] : X[i] + part * (point[i] - X[i]);
      KEPT_SIDE[i] = stop >= 0 && i == blocker ? 0 : i == stop ? PASSED[i] : SIDE[i];
    });
  }
  // Find the end of the level's motion (KEPT, KEPT_SIDE), or a point before it: on the straight way to the end or, from
  // there on, on the path of the scales. Returns the scale. A search for the end has up to three attempts, the second and
  // the third with a compliance. `ended`: STRAIGHT, PART or WHOLE, 0 where there is no answer.
  OSIK_METHOD double go_along(int max_changes, int& ended, int& blocker, int& all_changes) {
    double at = 1.0, below = 0.0, above = 1.0, whole = 1.0, its_scale = 0.0;
    int number = 0;        // of the attempt at this scale
    bool goes_on = false;  // from the joints that the last attempt saturated
    ended = blocker = all_changes = 0;
    for (int searches = 0; searches <= PATH_SEARCHES && all_changes < max_changes;) {
      most_changes = max_changes - all_changes;
      if (number == 0) most_changes = Base::smaller(most_changes, MAX_SATURATION_CHANGES * n);
      const double least = number == 0 ? SATURATION_RANK : SOFT_SATURATION_RANK;
      const double compliance = number == 0 ? 0.0 : number == 1 ? SATURATION_COMPLIANCE : STIFFER_SATURATION_COMPLIANCE;
      const bool went_on = goes_on, done = attempt(at, least, compliance, goes_on);
      all_changes += changes;
      goes_on = done && number == 0 && count > 0;
      if (!done && went_on) continue;  // once more, from none
      if (!done && number < 2 && at == 1.0 && first > 0) {
        ++number;
        continue;
      }
      number = 0;
      if (!done || (ended != 0 && at != 1.0 && stop >= 0)) break;
      if (ended == 0) {  // the end of the path
        blocker = find_blocking(), ended = STRAIGHT, above = whole = scale;
        const double part = damped_part();
        at = its_scale = part * scale;
        keep(POINT, part, blocker);
        if (part == 1.0) ended = WHOLE;
        if (ended == WHOLE || !(at > 0.0)) break;
        continue;
      }
      if (at == 1.0) {  // the end once more
        blocker = find_blocking(), ended = WHOLE, its_scale = scale;
        keep(POINT, 1.0, blocker);
        break;
      }
      ++searches;
      const double tried = scale;
      t.each(0, n, [&](int i) { DIRECTION[i] = POINT[i]; });
      const double best = best_scale();
      if (ended == STRAIGHT || best >= at * (1.0 - PATH_STEP)) {  // beyond the least cost the path costs much
        ended = PART, its_scale = tried;
        keep(DIRECTION, 1.0, -1);
      }
      if (best >= whole * (1.0 - PATH_STEP) && above == whole) {
        below = at;
        at = at > whole * (1.0 - PATH_END) ? 1.0 : whole * (1.0 - 0.5 * PATH_END);
        continue;
      }
      if (fabs(best - at) <= PATH_STEP * at) break;
      if (best > at) below = at;
      else above = at;
      at = below < best && best < above ? best : 0.5 * (below + above);
    }
    return its_scale;
  }

  // ---- the levels
  // Remove the joints that stop the level from the free coordinates.
  OSIK_METHOD void remove_blocking() {
    int columns = 0;
    for (int i = 0; i < n; ++i) {
      if (!BLOCKING[i]) continue;
      t.each(first, n, [&](int j) { B[j * lb + columns] = Z[j * ld + i]; });
      ++columns;
    }
    if (columns == 0) return;
    this->rank = this->reflect_rows(columns, BLOCKING_RANK);
    this->reflect_basis();
    this->identity = false, first += this->rank;
    t.each(0, n, [&](int i) {
      if (BLOCKING[i])
        for (int j = first; j < n; ++j) Z[j * ld + i] = 0.0;
    });
  }
  // The point of the box that is nearest to 0, and the joints that can move in coordinates of their own.
  OSIK_METHOD void begin(const SaturationProblem& p) {
    t.each(0, n, [&](int i) {
      LOW[i] = p.low[i], HIGH[i] = p.high[i], this->CURVATURE[i] = 0.0, X[i] = clip(0.0, LOW[i], HIGH[i]);
      FIXED[i] = LOW[i] == HIGH[i] ? 2 : 0, SIDE[i] = 0;
      for (int j = 0; j < n; ++j) Z[j * ld + i] = 0.0;
    });
    first = t.count(0, n, [&](int i) { return FIXED[i] != 0; });
    this->identity = first == 0, this->rank_tol = p.rank_tol;
    t.once([&] {
      for (int i = 0, fixed = 0; i < n; ++i) {
        Z[(FIXED[i] ? fixed : first + i - fixed) * ld + i] = 1.0;
        fixed += FIXED[i] != 0;
      }
    });
  }
  // Move X as level k asks, and write what it did; returns whether there is an answer. Its rows and the joints that stop
  // it are then among those before `first`.
  OSIK_METHOD bool solve_level(const SaturationProblem& p, const SaturationAnswer& to, int k, int& all_changes) {
    const int at = k * p.m;
    this->begin_level({p.matrix + at * n, p.lower + at, p.upper + at, p.bends + k * n, p.equality + at, p.constant[k],
                       p.unmet[k], p.demand[k], p.m, p.row, p.column});
    target = p.targets + k * n;
    this->compute_damping(true);
    this->find_motion();
    first += this->rank;
    int ended, blocker, its_changes;
    const double its_scale = go_along(p.max_changes, ended, blocker, its_changes);
    t.each(0, n, [&](int i) {
      if (ended == 0) BLOCKING[i] = 0;
      else X[i] = KEPT[i];
      SIDE[i] = ended == 0 ? Int(0) : KEPT_SIDE[i];
      to.sides[k * n + i] = SIDE[i], to.blocking[k * n + i] = BLOCKING[i];
      FIXED[i] = FIXED[i] ? FIXED[i] : BLOCKING[i];
    });
    t.once([&] { to.scales[k] = its_scale, to.ended[k] = ended, to.blockers[k] = blocker; });
    this->narrow_box();
    if (ended != 0) remove_blocking();
    all_changes += its_changes;
    return ended != 0;
  }
  OSIK_METHOD void solve(const SaturationProblem& p, const SaturationAnswer& to) {
    bool done = true;
    int all_changes = 0;
    begin(p);
    for (int k = 0; k < p.L; ++k) done = solve_level(p, to, k, all_changes) && done;
    t.each(0, n, [&](int i) {
      // a joint may have stopped at the trust region of its level, or damped on its way to the bound
      const int at = FIXED[i] ? FIXED[i] : SIDE[i];
      const double its_bound = at < 0 ? p.low[i] : p.high[i];
      const bool away = at * at == 1 && fabs(X[i] - its_bound) > BOUND_DISTANCE * (1.0 + fabs(its_bound));
      to.x[i] = X[i], to.active[i] = away ? 0 : at;
    });
    if (to.projector) this->write_projector(to.projector);
    t.once([&] { to.report[0] = done, to.report[1] = all_changes; });
  }
};

}  // namespace osik
