// Labels that are wrong: violated constraints that are inactive, multipliers of the wrong sign.
auto find_wrong_variables = [&](float x_size, float x_max) {  // to `next`; returns how many are wrong
  int wrong_count = 0;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    float roundoff = relative_tol * (fminf(x_size / root[h], x_max) + fabsf(x[h]) + nearest_bound(low[h], high[h]));
    float multiplier_tol = roundoff * root[h] * root[h], violation_tol = VIOLATION_TOL * roundoff;
    next[h] = label[h];
    if (label[h] == FREE)
      next[h] = x[h] < low[h] - violation_tol ? AT_LOWER : x[h] > high[h] + violation_tol ? AT_UPPER : FREE;
    if (label[h] == AT_LOWER && gradient[h] > multiplier_tol) next[h] = FREE;
    if (label[h] == AT_UPPER && gradient[h] < -multiplier_tol) next[h] = FREE;
    wrong_count += __popc(__ballot_sync(ALL, next[h] != label[h]));
  }
  return wrong_count;
};
auto find_wrong_rows = [&](float x_size, float x_max) {       // to `next_row_label`; returns how many are wrong
  next_row_label = row_label, row_multiplier = 0.f, row_gain = -1.f;
  if (has_row) {
    float row_reach = 0.f, row_sum = 0.f, value = row_values[lane];
    for (int k = 0; k < N; ++k) {
      float a = fabsf(S[(M + lane) * LD + k]);
      row_reach += a * work[k], row_sum += a;
    }
    float scale = fminf(x_size * row_reach, x_max * row_sum) + fabsf(value) + nearest_bound(row_low, row_high);
    float roundoff = relative_tol * scale;
    float multiplier_tol = roundoff / fmaxf(row_reach * row_reach, 1e-37f), violation_tol = VIOLATION_TOL * roundoff;
    if (row_label == FREE)
      next_row_label = value < row_low - violation_tol ? AT_LOWER : value > row_high + violation_tol ? AT_UPPER : FREE;
    else
      row_multiplier = row_weights[M + lane] * (row_targets[M + lane] - value);
    if (row_label == AT_LOWER && row_multiplier < -multiplier_tol) next_row_label = FREE;
    if (row_label == AT_UPPER && row_multiplier > multiplier_tol) next_row_label = FREE;
    float gap = fmaxf(row_low - value, value - row_high);
    if (row_label == FREE && next_row_label != FREE) row_gain = gap * gap / (row_compliance + row_reach * row_reach);
  }
  return __popc(__ballot_sync(ALL, next_row_label != row_label));
};
auto find_wrong_labels = [&]() {
  float x_size = 0.f, x_max = 0.f;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    x_size = fmaxf(x_size, fabsf(x[h] * root[h]));
    x_max = fmaxf(x_max, fabsf(x[h]));
    if (lane + 32 * h < 4 * NG) work[lane + 32 * h] = exists[h] ? 1.f / root[h] : 0.f;
  }
  x_size = warp_max(x_size), x_max = warp_max(x_max);
  __syncwarp();
  const int wrong_variables = find_wrong_variables(x_size, x_max);
  return wrong_variables + find_wrong_rows(x_size, x_max);
};
// all wrong labels change at once; with `only_release` those alone whose constraint becomes inactive
auto exchange_labels = [&](bool only_release) {
#pragma unroll
  for (int h = 0; h < H; ++h) {
    bool changes_label = next[h] != label[h] && (!only_release || next[h] == FREE);
    changes += __popc(__ballot_sync(ALL, changes_label));
    if (changes_label) label[h] = next[h];
  }
  bool changes_label = next_row_label != row_label && (!only_release || next_row_label == FREE);
  changes += __popc(__ballot_sync(ALL, changes_label));
  if (changes_label) row_label = next_row_label;
};
auto releases_any = [&]() {
  bool releases = has_row && row_label != FREE && next_row_label == FREE;
#pragma unroll
  for (int h = 0; h < H; ++h) releases = releases || (label[h] != FREE && next[h] == FREE);
  return __any_sync(ALL, releases) != 0;
};
