// What a level has determined (_freeze.py): frozen rows, the trust region of the levels below, and the space left to them.

// active rows with a multiplier, and own rows in the cost, become equalities
auto freeze = [&]() {
  evaluate();
  double far_x = 0.0;
#pragma unroll
  for (int h = 0; h < H; ++h) far_x += exists[h] ? x[h] * x[h] : 0.0;
  // a multiplier that the damping alone explains leaves the levels below room on the face that the level has reached
  const double floor = sign_tolerance() + damping * sqrt(warp_sum(far_x));
  bool same = true, all_freeze = true;
  bool row_freezes = has_row && row_active != 0 && fabs(row_multiplier) * row_length > floor;
  bool now_in_cost[G], freezes[H];
#pragma unroll
  for (int g = 0; g < G; ++g) {
    const double small = multiplier_tol * (length[g] * x_max + root_cost);
    now_in_cost[g] = in_level[g] && (equal[g] || fabs(slack[g]) > small);
    same = same && now_in_cost[g] == in_cost[g];
  }
#pragma unroll
  for (int h = 0; h < H; ++h) {
    freezes[h] = exists[h] && active[h] != 0 && fabs(multiplier[h]) > floor;
    all_freeze = all_freeze && freezes[h] == (active[h] != 0);
  }
  all_freeze = !any(!all_freeze || row_freezes != (row_active != 0));
  same = !any(!same);
  const int rank_at_optimum = rank;
  int active_at_end[H], row_active_at_end = row_active;
#pragma unroll
  for (int h = 0; h < H; ++h) active_at_end[h] = active[h];
  if (!(same && all_freeze)) {
#pragma unroll
    for (int h = 0; h < H; ++h) active[h] = freezes[h] ? active[h] : 0;
    row_active = row_freezes ? row_active : 0;
#pragma unroll
    for (int g = 0; g < G; ++g) in_cost[g] = now_in_cost[g];
    rotate_active_rows();
    factor_least_squares();
  }
  const bool tie = same && rank != rank_at_optimum && damping == 0.0;

#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) {
      const size_t at = here * HARD + lane + 32 * h;
      active_rows.data[at] = active_at_end[h];
      frozen_rows.data[at] = freezes[h] || tie ? active_at_end[h] : 0;
      multipliers.data[at] = multiplier[h];
      bound_label[h] = active_at_end[h] != 0 ? active_at_end[h] : frozen[h] ? bound_label[h] : 0;
      frozen[h] = frozen[h] || freezes[h];
      active[h] = freezes[h] ? 0 : active_at_end[h];
    }
#pragma unroll
  for (int g = 0; g < G; ++g) {
    const int a = lane + 32 * g;
    const int miss = now_in_cost[g] ? slack[g] > 0.0 ? 1 : -1 : 0;
    if (a < M) {
      rows_in_cost.data[here * M + a] = miss;
      own_rows.data[here * M + a] = equal[g] ? 2 : miss;
    }
    if (in_level[g]) in_cost_flags[a] = now_in_cost[g];
  }
  __syncwarp();
  if (has_row) {
    const size_t at = here * HARD + N + lane;
    active_rows.data[at] = row_active_at_end;
    frozen_rows.data[at] = row_freezes || tie ? row_active_at_end : 0;
    multipliers.data[at] = row_multiplier;
    row_frozen = row_frozen || row_freezes;
    row_active = row_freezes ? 0 : row_active_at_end;
    if (row_level == level) {
      const double at_x = hard_row_times(point);
      row_low = fmin(row_low, at_x), row_high = fmax(row_high, at_x);
      row_frozen = row_frozen || in_cost_flags[ROW[lane] - OFFSET[level]] != 0;
    }
  }
  if (lane == 0) {
    ranks.data[here] = tie ? rank_at_optimum : rank;
    slack_norms.data[here] = slack_norm, level_dampings.data[here] = damping;
  }
};
// the trust region of the levels below (narrow_box of _damping.py)
auto narrow_box = [&]() {
  const double residual_norm = fmin(slack_norm, demand);
  const bool is_narrowed = unmet * (residual_norm / (demand > 0.0 ? demand : 1.0)) > NEGLIGIBLE_DAMPING * longest;
  double cost[H], most = 0.0;
  int count_restricted = 0;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    const double own_curvature = exists[h] ? bends.data[here * N + lane + 32 * h] : 0.0;
    curvature[h] = fmax(curvature[h], own_curvature / (frobenius > 0.0 ? frobenius : 1.0));
    cost[h] = residual_norm * frobenius * curvature[h];
    most = fmax(most, cost[h]);
  }
  most = NEGLIGIBLE_CURVATURE * warp_max(most);
#pragma unroll
  for (int h = 0; h < H; ++h) count_restricted += __popc(__ballot_sync(ALL, cost[h] > most));
  const double gain = COST_FRACTION * (demand - residual_norm) * (demand + residual_norm);
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (is_narrowed && cost[h] > most) {
      const double radius = sqrt(gain / (count_restricted * cost[h])) + MIN_RADIUS;
      low[h] = fmax(low[h], x[h] - radius), high[h] = fmin(high[h], x[h] + radius);
    }
};
// the row space of the factor is rotated to the front of Z, after the frozen rows, and both are removed
auto remove_determined = [&]() {
  for (int k = 0; k < rank; ++k) {
    const int at = active_count + k;
    const double weight = make_reflector(R + k * ZD, at);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (exists[h]) apply_reflector(Z + (lane + 32 * h) * ZD, at, weight);
    for (int row = lane; row < rank; row += 32)
      if (row > k) apply_reflector(R + row * ZD, at, weight);
    __syncwarp();
  }
  const int removed = active_count + rank;
  width -= removed;
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) {
      double* const row = Z + (lane + 32 * h) * ZD;
      for (int j = 0; j < width; ++j) row[j] = row[j + removed];
      for (int j = width; j < width + removed; ++j) row[j] = 0.0;
    }
  __syncwarp();
};
