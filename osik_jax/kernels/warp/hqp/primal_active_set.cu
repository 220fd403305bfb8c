// The primal active-set method of a level (_primal_active_set.py), from a feasible point.

// the damped step d along what the rank tolerance left out, as XLA's guess of a working set would take it
auto weak_step = [&](double* d) {
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) reflector[lane + 32 * h] = downhill[h] / (EXTRA_DAMPING * size * size + damping);
  __syncwarp();
  from_basis(active_count, width, d);
};
// of the active rows with a multiplier of the wrong sign the worst, or the first where steps had no length; HARD for none
auto wrong_active_row = [&](bool first) {
  const double floor = sign_tolerance();
  double worst = -1.0;
  int which = HARD;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    const double by = wrong_force(multiplier[h], active[h], 1.0);
    if (active[h] != 0 && by > floor && (first ? 1.0 : by) > worst)
      worst = first ? 1.0 : by, which = lane + 32 * h;
  }
  if (has_row && row_active != 0) {
    const double by = wrong_force(row_multiplier, row_active, row_length);
    if (by > floor && (first ? 1.0 : by) > worst)
      worst = first ? 1.0 : by, which = N + lane;
  }
  warp_argmax(worst, which);
  return worst < 0.0 ? HARD : which;
};
// the step length at which the first inactive row comes to its bound; with d in `point`, which becomes x
auto step_to_blocking_row = [&](const double* d, int& blocking, int& blocking_bound) {
  double far = 0.0, shortest = INFINITY;
#pragma unroll
  for (int h = 0; h < H; ++h) far += exists[h] ? d[h] * d[h] : 0.0;
  const double step_norm = sqrt(warp_sum(far));
#pragma unroll
  for (int h = 0; h < H; ++h) {
    if (!exists[h] || frozen[h] || active[h] != 0 || fabs(d[h]) <= rank_tol * step_norm) continue;
    const double gap = (d[h] > 0.0 ? high[h] : low[h]) - x[h], time = fmax(gap / d[h], 0.0);
    if (time < shortest) shortest = time, blocking = lane + 32 * h, blocking_bound = d[h] > 0.0 ? 1 : -1;
  }
  if (P) {
    const double here_rate = has_row ? hard_row_times(point) : 0.0;
    to_point(x);
    if (has_row && !row_frozen && row_level < level && row_active == 0 &&
        fabs(here_rate) > rank_tol * step_norm * row_length) {
      const double bound = here_rate > 0.0 ? row_high : row_low;
      const double time = is_finite(bound) ? fmax((bound - hard_row_times(point)) / here_rate, 0.0) : INFINITY;
      if (time < shortest) shortest = time, blocking = N + lane, blocking_bound = here_rate > 0.0 ? 1 : -1;
    }
  }
  double negative_limit = -shortest;
  warp_argmax(negative_limit, blocking);
  return -negative_limit;
};
// exact line search where rows of the cost enter and leave their intervals: the step length of least cost
auto exact_line_search = [&](const double* rate, double along_x, double along_d) {
  __syncwarp();
#pragma unroll
  for (int g = 0; g < G; ++g)
    if (in_level[g]) work_a[lane + 32 * g] = value[g], work_b[lane + 32 * g] = rate[g];
  __syncwarp();
  auto derivative = [&](double t) {
    double total = along_x + t * along_d;
    for (int a = 0; a < m; ++a) {
      const size_t at = problem * ROWS + OFFSET[level] + a;
      const double v = work_a[a] + t * work_b[a];
      const bool same = rows_equal.data[at] != 0;
      total += work_b[a] * (v - (same ? rows_lower.data[at] : clip(v, rows_lower.data[at], rows_upper.data[at])));
    }
    return total;
  };
  double breakpoint[2 * G + 1], before = 0.0, after = INFINITY;
#pragma unroll
  for (int g = 0; g < G; ++g) {
    const bool moving = in_level[g] && rate[g] != 0.0;
    breakpoint[2 * g] =
        moving && is_finite(level_lower[g]) ? fmax((level_lower[g] - value[g]) / rate[g], 0.0) : 1.0;
    breakpoint[2 * g + 1] =
        moving && is_finite(level_upper[g]) ? fmax((level_upper[g] - value[g]) / rate[g], 0.0) : 1.0;
  }
  breakpoint[2 * G] = lane == 0 ? 0.0 : 1.0;
#pragma unroll
  for (int e = 0; e < 2 * G + 1; ++e)
    if (derivative(breakpoint[e]) < 0.0) before = fmax(before, breakpoint[e]);
  before = warp_max(before);
#pragma unroll
  for (int e = 0; e < 2 * G + 1; ++e)
    if (breakpoint[e] > before) after = fmin(after, breakpoint[e]);
  after = -warp_max(-after);
  const double trial = is_finite(after) ? 0.5 * (before + after) : before + 1.0;
  const double at_first = derivative(before), at_last = derivative(trial);
  const bool rising = at_last > at_first;
  return rising ? fmax(before - at_first * (trial - before) / (at_last - at_first), 0.0) : before;
};
auto primal_active_set = [&](bool needs_rotation, bool needs_factors) {
  int stalled = 0, rounds = 0;
  bool tried_weak = false;                            // a step along directions under the rank tolerance
  while (!optimal && rounds++ < max_iterations) {
    evaluate();
    if (needs_rotation) rotate_active_rows();
    bool changed = needs_rotation || needs_factors;
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const bool now = in_level[g] && (equal[g] || slack[g] != 0.0);
      changed = changed || now != in_cost[g];
      in_cost[g] = now;
    }
    if (any(changed)) factor_least_squares();
    needs_rotation = needs_factors = false;
    double d[H], rate[G], square = 0.0;
    least_squares_step(slack, d);
    to_point(d);
#pragma unroll
    for (int g = 0; g < G; ++g) {
      rate[g] = in_level[g] ? row_times(lane + 32 * g, point) : 0.0;
      square += in_cost[g] ? rate[g] * rate[g] : 0.0;
    }
    double along_x = 0.0, along_d = 0.0;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (exists[h]) along_x += x[h] * d[h], along_d += d[h] * d[h];
    along_x = damping * warp_sum(along_x), along_d = damping * warp_sum(along_d);
    const bool step_vanishes = sqrt(warp_sum(square) + along_d) <= step_tol * (size * x_max + root_cost);
    bool is_weak = false;
    if (step_vanishes) {
      compute_multipliers(slack);
      is_weak = !tried_weak && !is_stationary();
    }
    if (is_weak) {
      tried_weak = true;
      weak_step(d);
      to_point(d);
    } else if (step_vanishes) {
      const int which = wrong_active_row(stalled > MAX_STALLED);
      optimal = which == HARD;
      if (optimal) break;
#pragma unroll
      for (int h = 0; h < H; ++h)
        if (is(h, which)) active[h] = 0;
      if (N + lane == which) row_active = 0;
      needs_rotation = true;
      ++changes;
      continue;
    }
    int blocking = HARD, blocking_bound = 0;
    const double limit = step_to_blocking_row(d, blocking, blocking_bound);
    const double line_minimum = has_inequalities && !is_weak ? exact_line_search(rate, along_x, along_d) : 1.0;
    const bool blocked = limit <= line_minimum;
    const double step_length = blocked ? limit : line_minimum;
    double moved = 0.0;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      if (exists[h]) x[h] += step_length * d[h], moved = fmax(moved, step_length * fabs(d[h]));
      if (blocked && is(h, blocking)) active[h] = blocking_bound;
    }
    if (blocked && N + lane == blocking) row_active = blocking_bound;
    stalled = warp_max(moved) > 0.0 ? 0 : stalled + 1;
    needs_rotation = blocked;
    tried_weak = tried_weak && !blocked;
    changes += blocked;
  }
};
