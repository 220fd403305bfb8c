// The saturated joints and the largest scale of a level's motion, by the dual method that
// core/saturation.hpp describes. One loop goes from step to step, so that each function that changes
// the coordinates has one place in the program: a joint that is exchanged for another leaves in one step and is followed
// in the next.
constexpr int CHOOSE = 0, REPLACE = 1, STOP = 2;      // a joint that leaves or enters; one in place of another; a stop
int changes = 0, most_changes = 0, step = CHOOSE;     // changes of the active set in this attempt, and its limit
int entering = -1, joint = -1, label = 0;             // the joint that enters, the one of this step, and its bound
int leaving = -1, left = -1, left_label = 0;          // the saturated joint that goes; who it was, and at what bound
int crossings = 0, passes = 0;                        // exchanges of this joint at this scale; how often to settle
double sign = 1.0, push = 0.0, stop_rate = 0.0;       // of the entering joint, its multiplier; of the scale
bool dropping = false, crossing = false, is_known = false;

// a search at this scale at most, from the joints that the one before has saturated
auto go_on = [&](double most) {
  stop = -1, scale = most;
  changes = 0, step = CHOOSE, entering = -1, leaving = -1, passes = 1;
  crossings = 0, dropping = count > 0, crossing = is_known = false;
  __syncwarp();
  for (int i = lane; i < N; i += 32) stays[i] = passed[i] = 0;
  __syncwarp();
};
// the same with no joint saturated; what the null space makes of the target
auto begin_search = [&](const double* target, double most) {
  count = 0;
  go_on(most);
  for (int i = lane; i < N; i += 32) along[i] = target[i] - x[i], at_bound[i] = 0;
  __syncwarp();
  for (int j = first + lane; j < N; j += 32) place[j] = coordinate_times(j, along);
  __syncwarp();
  for (int i = lane; i < N; i += 32) target_part[i] = column_times(place, i, first, N);
};
// chooses the joint that leaves, else the one that enters; returns whether there is one
auto choose = [&](double roundoff) {
  leaving = dropping ? most_wrong(roundoff) : -1;
  dropping = leaving >= 0;
  if (!dropping && entering < 0) {
    entering = most_violated(roundoff);
    if (entering < 0) return false;
    sign = low[entering] - now[entering] >= now[entering] - high[entering] ? 1.0 : -1.0;
    push = 0.0, crossings = 0;
  }
  joint = entering, label = sign > 0.0 ? -1 : 1;
  ++changes;
  return true;
};
// after `look_along`: moves until a multiplier is 0 or the joint on its bound, and returns whether it is. Where neither
// can be, a joint that stops the motion is exchanged, or this one stops it
auto move = [&](double length_squared, double least) {
  const double beyond = fmax(sign > 0.0 ? low[joint] - now[joint] : now[joint] - high[joint], 0.0);
  const double full = length_squared > least * least ? beyond / length_squared : INFINITY;
  double largest = 1.0, length;
  for (int a = lane; a < count; a += 32) largest = fmax(largest, fabs(rate[a]));
  largest = warp_max(largest);
  leaving = first_to_leave(sign, (full < INFINITY ? SATURATION_ROUNDOFF : least) * largest, length);
  if (leaving < 0 && full == INFINITY) {
    leaving = first_to_cross(sign, least * largest);
    crossing = leaving >= 0;
    if (crossing) ++crossings, ++changes, joint = stop, step = REPLACE;
    else entering = -1, step = STOP;
    return false;
  }
  const double by = sign * fmin(length, full);
  __syncwarp();
  for (int i = lane; i < N; i += 32) now[i] += by * along[i];
  for (int a = lane; a < count; a += 32) y[a] -= by * rate[a];
  push += by;
  if (length < full) return false;
  leaving = -1;
  return true;
};
// after `look_along`: lets the joint stop the motion, or first exchanges it for the one that the others say most about
auto stop_or_exchange = [&](double least) {
  double its_rate;
  const double lower_scale = scale_of(joint, label, least, its_rate);
  step = CHOOSE;
  if (!is_known) {
    if (lane == 0) passed[joint] = label;
    __syncwarp();
    if (!(lower_scale < scale - SATURATION_ROUNDOFF)) return;  // but for rounding it is where the others put it
    leaving = largest_rate(LARGEST_RATE);
    if (leaving >= 0) {
      changes += 2, step = REPLACE;
      return;
    }
  }
  stop_by(joint, label);
  stop_rate = its_rate, scale = fmin(lower_scale, scale);
  dropping = true, is_known = false, passes = 3;
};
// saturates the joint: the one that enters, or one that stops the motion, beside those, in place of the one that left
auto enter = [&](double length_squared) {
  const bool replaces = step == REPLACE;
  saturate(joint, length_squared, replaces ? passed[joint] : label, replaces ? 0.0 : push, replaces);
  if (replaces) {
    if (lane == 0) passed[joint] = 0, passed[left] = left_label;
    if (crossing) stop = left, push = 0.0, passes = 1, step = CHOOSE;
    else joint = left, label = left_label, is_known = true, step = STOP;
    crossing = false;
  } else {
    if (lane == 0) now[joint] = bound(joint);
    entering = -1;
  }
  __syncwarp();
};
// after `begin_search` or `go_on`: finds `now`, inside its box and at a scale of at most the one it began with, and
// returns whether it has; a combination with parts below `least` depends on others
auto search = [&](const double* target, double least) {
  double whole = 0.0;
  int checks = 0;                                     // of signs at the end
  bool done = false, ended = false;
  for (;;) {
    if (passes > 0) {
      settle_stopped(passes, stop_rate);
      whole = size_of_numbers(target);
      passes = 0;
    }
    if (ended) {  // beside multipliers that are huge, rounding may have turned the sign of another: the search goes on
      const bool are_right = done && step_left() <= SATURATION_LOSS * whole;
      dropping = done && !are_right && checks++ < SIGN_CHECKS;
      if (!dropping) return are_right;
      done = false;
    }
    ended = step == CHOOSE && (changes >= most_changes || crossings > N);  // more exchanges go round, by rounding
    if (step == CHOOSE && !ended) ended = done = !choose(SATURATION_ROUNDOFF * whole);
    if (ended) {
      passes = count > 0 ? 3 : 0;
      continue;
    }
    bool enters = step == REPLACE;
    const double length_squared = dropping ? 0.0 : look_along(joint);
    if (step == CHOOSE && !dropping) enters = move(length_squared, least);
    if (step == STOP) stop_or_exchange(least);
    if (leaving >= 0) {
      left = who[leaving], left_label = at_bound[left];
      release(leaving, dropping);
      leaving = -1;
    } else if (enters) {
      enter(length_squared);
      whole = fmax(whole, fabs(now[joint]));
    }
  }
};
