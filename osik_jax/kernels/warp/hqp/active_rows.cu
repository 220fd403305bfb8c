// The active hard rows, factored inside the null space (_active_rows.py).
auto rotate_active_rows = [&]() {                     // pivoted QR of the active rows: to the front of Z
  bool remaining[H], row_remaining = row_active != 0, some = row_remaining;
#pragma unroll
  for (int h = 0; h < H; ++h) remaining[h] = active[h] != 0, some = some || remaining[h];
  active_count = 0;
  if (P) {
    for (int j = lane; j < width; j += 32)
      for (int q = 0; q < P; ++q) {
        double total = 0.0;
#pragma unroll 8
        for (int i = 0; i < N; ++i) total += A[i * ROWS + ROW[q]] * Z[i * ZD + j];
        E[q * ZD + j] = total;
      }
    __syncwarp();
  }
  if (!any(some)) return;
  while (active_count < width) {
    double best = -1.0;
    int which = HARD;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (remaining[h]) {
        const double square = norm_squared(Z + (lane + 32 * h) * ZD, active_count, width);
        if (square > best) best = square, which = lane + 32 * h;
      }
    if (P && row_remaining) {
      double square = norm_squared(E + lane * ZD, active_count, width);
      square /= row_length > 0.0 ? row_length * row_length : 1.0;
      if (square > best) best = square, which = N + lane;
    }
    warp_argmax(best, which);
    if (!(best > rank_tol * rank_tol)) break;
    const double weight = make_reflector(which < N ? Z + which * ZD : E + (which - N) * ZD, active_count);
#pragma unroll
    for (int h = 0; h < H; ++h) {
      if (exists[h]) apply_reflector(Z + (lane + 32 * h) * ZD, active_count, weight);
      if (is(h, which)) remaining[h] = false;
    }
    if (has_row) {
      apply_reflector(E + lane * ZD, active_count, weight);
      if (N + lane == which) row_remaining = false;
    }
    if (lane == 0) active_index[active_count] = which;
    ++active_count;
    __syncwarp();
  }
#pragma unroll
  for (int h = 0; h < H; ++h) {
    if (remaining[h]) active[h] = 0;
  }
  if (row_remaining) row_active = 0;
  __syncwarp();
};

auto restoring_step = [&](double* d) {                // the shortest step of the active rows to their bounds
  to_point(x);
  double gap[H];
  if (P) {
    if (has_row) work_a[lane] = (row_active < 0 ? row_low : row_high) - hard_row_times(point);
    __syncwarp();
  }
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) work_b[lane + 32 * h] = (active[h] < 0 ? low[h] : high[h]) - x[h];
  __syncwarp();
#pragma unroll
  for (int h = 0; h < H; ++h) {
    const int k = lane + 32 * h;
    gap[h] = k < active_count ? active_index[k] < N ? work_b[active_index[k]] : work_a[active_index[k] - N] : 0.0;
  }
  for (int k = 0; k < active_count; ++k) {
    double mine = gap[0];
#pragma unroll
    for (int h = 1; h < H; ++h) mine = k >> 5 == h ? gap[h] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) / entry_in_basis(active_index[k], k);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h > k && lane + 32 * h < active_count)
        gap[h] -= entry_in_basis(active_index[lane + 32 * h], k) * y;
    if (lane == 0) reflector[k] = y;
  }
  __syncwarp();
  from_basis(0, active_count, d);
  __syncwarp();
};
