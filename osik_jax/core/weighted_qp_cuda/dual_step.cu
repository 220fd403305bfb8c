// A dual step of Goldfarb and Idnani (GI), as in _goldfarb_idnani.py; its numbers are those of their paper.

// step 1: the violated constraint whose activation raises the dual objective most enters
auto choose_entering = [&]() {
  float gain = row_gain;
  int which = N + lane;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    float inverse = 0.f;
    for (int k = 32 * h; k < N; ++k) inverse += inverse_factor[k * LD + index[h]] * inverse_factor[k * LD + index[h]];
    float gap = fmaxf(low[h] - x[h], x[h] - high[h]);
    float own_gain = gap * gap / fmaxf(inverse * unit[h] * unit[h], 1e-37f);
    if (label[h] == FREE && next[h] != FREE && own_gain > gain) gain = own_gain, which = lane + 32 * h;
  }
  unsigned first = __ballot_sync(ALL, gain == warp_max(gain));
  entering = __shfl_sync(ALL, which, __ffs(first) - 1);
  entering_multiplier = 0.f;
};
// step 2a: x moves along the primal direction H^-1 normal, the multipliers of the active constraints with it at these
// rates (those of rows are in `residuals`); `gap_low`, `gap_high` and `gain` are the entering constraint's, how far it is
// from its bounds and how fast it comes nearer
auto dual_direction = [&](float* rate, float& gap_low, float& gap_high, float& gain) {
  const int entering_lane = entering < N ? entering & 31 : entering - N;
  const int entering_slot = entering < N ? entering >> 5 : -1;  // -1 for a row
  float normal[H], direction[H];
#pragma unroll
  for (int h = 0; h < H; ++h)
    normal[h] = !exists[h]          ? 0.f
                : entering_slot < 0 ? S[(M + entering_lane) * LD + index[h]]
                                    : lane + 32 * h == entering ? 1.f : 0.f;
  solve(normal, unit, direction);
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (lane + 32 * h < 4 * NG) point[lane + 32 * h] = direction[h];
  float value = has_row ? row_values[lane] : 0.f;
  __syncwarp();
  for (int r = lane; r < ROWS; r += 32) {
    float change = dot(S + r * LD, point, NG);
    residuals[r] = row_weights[r] * change;
    if (r >= M) row_values[r - M] = change;
  }
  __syncwarp();
  gap_low = row_low - value - row_compliance * entering_multiplier;
  gap_high = value + row_compliance * entering_multiplier - row_high;
  gain = row_compliance + (has_row ? row_values[lane] : 0.f);
#pragma unroll
  for (int h = 0; h < H; ++h) {
    rate[h] = dot_column(S + index[h], residuals, 0, ROWS) + damping_of[h] * direction[h] - normal[h];
    if (entering_slot == h) gap_low = low[h] - x[h], gap_high = x[h] - high[h], gain = direction[h];
  }
  gap_low = __shfl_sync(ALL, gap_low, entering_lane), gap_high = __shfl_sync(ALL, gap_high, entering_lane);
  gain = __shfl_sync(ALL, gain, entering_lane);
};
// of the active multipliers that fall the first to reach 0; returns the step at which it does
auto step_to_leaving = [&](const float* rate, float sign_of_bound, int& leaving, float& shortest_step) {
#pragma unroll
  for (int h = 0; h < H; ++h) {
    float sign = label[h] == AT_LOWER ? 1.f : label[h] == AT_UPPER ? -1.f : 0.f;
    float decrease = -sign * sign_of_bound * rate[h], length = fmaxf(-sign * gradient[h], 0.f) / decrease;
    if (exists[h] && decrease > 0.f && length < shortest_step) shortest_step = length, leaving = lane + 32 * h;
  }
  if (has_row) {
    float sign = row_label == AT_LOWER ? 1.f : row_label == AT_UPPER ? -1.f : 0.f;
    float decrease = sign * sign_of_bound * residuals[M + lane], length = fmaxf(sign * row_multiplier, 0.f) / decrease;
    if (decrease > 0.f && length < shortest_step) shortest_step = length, leaving = N + lane;
  }
  return -warp_max(-shortest_step);
};
auto dual_step = [&]() {
  float rate[H], gap_low, gap_high, gain, shortest_step = INFINITY;
  int leaving = -1;
  if (entering < 0) choose_entering();
  dual_direction(rate, gap_low, gap_high, gain);
  const float sign_of_bound = entering_multiplier > 0.f   ? 1.f
                              : entering_multiplier < 0.f ? -1.f
                                                          : gap_low > gap_high ? 1.f : -1.f;
  // GI, step 2b: the full step makes the entering constraint hold, the partial step takes a multiplier to 0
  const float full_step = fmaxf(sign_of_bound > 0.f ? gap_low : gap_high, 0.f) / fmaxf(gain, 1e-37f);
  const float length = step_to_leaving(rate, sign_of_bound, leaving, shortest_step);
  ++changes;
  if (full_step <= length) {  // GI, step 2c: the full step, the constraint becomes active
    int new_label = sign_of_bound > 0.f ? AT_LOWER : AT_UPPER;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h == entering) label[h] = new_label;
    if (has_row && N + lane == entering) row_label = new_label;
    entering = -1, entering_multiplier = 0.f;
  } else {                    // the partial step, the blocking constraint becomes inactive
    unsigned first = __ballot_sync(ALL, shortest_step == length);
    leaving = __shfl_sync(ALL, leaving, __ffs(first) - 1);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h == leaving) label[h] = FREE;
    if (has_row && N + lane == leaving) row_label = FREE;
    entering_multiplier += sign_of_bound * length;
  }
};
