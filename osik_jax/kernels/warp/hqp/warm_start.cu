// The working set of the warm start, corrected where its solution shows that it is wrong, all rows at once (M.
// Hintermueller, K. Ito, K. Kunisch, "The primal-dual active set strategy as a semismooth Newton method", 2003).

// the usable part of the guess, to `active`, `row_active` and `own`: bounds that exist, of rows that may block
auto take_guess = [&](int* own, bool row_may_block) {
#pragma unroll
  for (int h = 0; h < H; ++h) {
    int at = exists[h] ? guess_hard.data[here * HARD + lane + 32 * h] : 0;
    at = at > 0 ? 1 : at < 0 ? -1 : 0;
    active[h] = !frozen[h] && at != 0 && is_finite(at < 0 ? low[h] : high[h]) ? at : 0;
  }
  row_active = 0;
  if (row_may_block) {
    int at = guess_hard.data[here * HARD + N + lane];
    at = at > 0 ? 1 : at < 0 ? -1 : 0;
    row_active = at != 0 && is_finite(at < 0 ? row_low : row_high) ? at : 0;
  }
#pragma unroll
  for (int g = 0; g < G; ++g) {
    int at = in_level[g] ? guess_own.data[here * M + lane + 32 * g] : 0;
    at = at > 0 ? 1 : at < 0 ? -1 : 0;
    if (!is_finite(at < 0 ? level_lower[g] : level_upper[g])) at = 0;
    own[g] = equal[g] ? 2 : at;
  }
};
// x becomes the solution on the working set, twice, so that the second solve is a refinement of the first
auto solve_on_working_set = [&](const double* start, const int* own, const double* goal) {
  double d[H];
#pragma unroll
  for (int g = 0; g < G; ++g) in_cost[g] = own[g] != 0;
#pragma unroll
  for (int h = 0; h < H; ++h) x[h] = start[h];
  rotate_active_rows();
  factor_least_squares();
  for (int round = 0; round < 2; ++round) {
    double off[G];
    restoring_step(d);
#pragma unroll
    for (int h = 0; h < H; ++h) x[h] += d[h];
    to_point(x);
#pragma unroll
    for (int g = 0; g < G; ++g) off[g] = in_cost[g] ? row_times(lane + 32 * g, point) - goal[g] : 0.0;
    least_squares_step(off, d);
#pragma unroll
    for (int h = 0; h < H; ++h) x[h] += d[h];
  }
};
// whether own rows are on the side of their bounds that `own` says, and to `corrected` where they are; the slack and the
// root of the cost become those of the working set
auto check_own_rows = [&](const int* own, const double* goal, int* corrected) {
  double square = 0.0, own_size = 0.0;
  bool consistent = true;
#pragma unroll
  for (int g = 0; g < G; ++g) {
    corrected[g] = own[g];
    if (in_level[g]) {
      const double near = feasibility_tol * (length[g] * x_max + fabs(value[g]));
      const double under = level_lower[g] - value[g], over = value[g] - level_upper[g];
      const bool right =
          own[g] == 2 || (own[g] == 0 ? fmax(under, over) <= near : (own[g] < 0 ? under : over) >= -near);
      if (!right) corrected[g] = own[g] != 0 ? 0 : under > over ? -1 : 1;
      consistent = consistent && right;
      slack[g] = in_cost[g] ? value[g] - goal[g] : 0.0;
      square += slack[g] * slack[g];
    }
  }
#pragma unroll
  for (int h = 0; h < H; ++h) own_size += exists[h] ? x[h] * x[h] : 0.0;
  root_cost = sqrt(warp_sum(square) + damping * warp_sum(own_size));
  return consistent;
};
auto try_warm_start = [&]() {                         // returns whether x is feasible; sets `optimal`
  double start[H], at_row = 0.0;
  int inherited[H], own[G], row_inherited = row_active;
  const bool row_may_block = has_row && !row_frozen && row_level < level;
  bool feasible = false;
#pragma unroll
  for (int h = 0; h < H; ++h) start[h] = x[h], inherited[h] = active[h];
  take_guess(own, row_may_block);
  for (int attempt = 1;; ++attempt) {
    double goal[G];
    int corrected[G];                                 // in the cost, or at which bound, as the values have it
#pragma unroll
    for (int g = 0; g < G; ++g) goal[g] = own[g] == 1 ? level_upper[g] : level_lower[g];
    solve_on_working_set(start, own, goal);
    evaluate();
    const bool consistent = check_own_rows(own, goal, corrected);
    if (has_row) at_row = hard_row_times(point);
    bool outside[H], row_outside = false, inside = true;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      outside[h] = exists[h] && !frozen[h] && active[h] == 0 &&
                   !(fmax(low[h] - x[h], x[h] - high[h]) <= feasibility_tol * (x_max + fabs(x[h])));
      inside = inside && !outside[h];
    }
    if (row_may_block && row_active == 0) {
      row_outside =
          !(fmax(row_low - at_row, at_row - row_high) <= feasibility_tol * (row_length * x_max + fabs(at_row)));
      inside = inside && !row_outside;
    }
    if (!is_finite(x_max)) {
      feasible = false;
      break;
    }
    feasible = !any(!inside);
    compute_multipliers(slack);
    const double floor = sign_tolerance();
    bool wrong[H];
    bool row_wrong = has_row && row_active != 0 && wrong_force(row_multiplier, row_active, row_length) > floor;
    bool signs_right = consistent && !row_wrong;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      wrong[h] = active[h] != 0 && wrong_force(multiplier[h], active[h], 1.0) > floor;
      signs_right = signs_right && !wrong[h];
    }
    optimal = feasible && !any(!signs_right) && is_stationary();
    if (optimal || attempt == MAX_ATTEMPTS) break;
    int changed = 0;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      if (outside[h]) active[h] = x[h] < low[h] ? -1 : 1;
      else if (wrong[h]) active[h] = 0;
      changed += __popc(__ballot_sync(ALL, outside[h] || wrong[h]));
    }
    if (row_outside) row_active = at_row < row_low ? -1 : 1;
    else if (row_wrong) row_active = 0;
    changed += __popc(__ballot_sync(ALL, row_outside || row_wrong));
#pragma unroll
    for (int g = 0; g < G; ++g) {
      changed += __popc(__ballot_sync(ALL, corrected[g] != own[g]));
      own[g] = corrected[g];
    }
    if (changed == 0) break;
    changes += changed;
  }
  if (feasible) largest = fmax(largest, x_max);
  if (!feasible) {
#pragma unroll
    for (int h = 0; h < H; ++h) x[h] = start[h], active[h] = inherited[h];
    row_active = row_inherited;
  }
  return feasible;
};
