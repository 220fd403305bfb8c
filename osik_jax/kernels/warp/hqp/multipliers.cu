// Multipliers of the active rows, and what is left of the gradient.
double multiplier[H] = {}, downhill[H] = {}, row_multiplier = 0.0, gradient_norm = 0.0, residual = 0.0;
auto compute_multipliers = [&](const double* slack) { // multipliers, the gradient's norm, stationarity
#pragma unroll
  for (int g = 0; g < G; ++g)
    if (in_level[g]) work_a[lane + 32 * g] = in_cost[g] ? slack[g] : 0.0;
  __syncwarp();
  double gradient[H], square = 0.0;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    gradient[h] = 0.0;
    if (exists[h]) {
      gradient[h] = damping * x[h];
#pragma unroll 8
      for (int a = 0; a < m; ++a) gradient[h] += B[(lane + 32 * h) * ROWS + a] * work_a[a];
    }
    square += gradient[h] * gradient[h];
  }
  gradient_norm = sqrt(warp_sum(square));
  to_point(gradient);
  double coefficient[H], off = 0.0;                   // the negative gradient in the basis
#pragma unroll
  for (int h = 0; h < H; ++h) {
    const int j = lane + 32 * h;
    coefficient[h] = 0.0;
    if (j < width)
      for (int i = 0; i < N; ++i) coefficient[h] -= Z[i * ZD + j] * point[i];
    if (j >= active_count) off = fmax(off, fabs(coefficient[h]));
    downhill[h] = coefficient[h];
  }
  residual = warp_max(off);
  for (int k = active_count - 1; k >= 0; --k) {
    double mine = coefficient[0];
#pragma unroll
    for (int h = 1; h < H; ++h) mine = k >> 5 == h ? coefficient[h] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) / entry_in_basis(active_index[k], k);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h < k) coefficient[h] -= entry_in_basis(active_index[k], lane + 32 * h) * y;
    if (lane == 0) reflector[k] = y;
  }
#pragma unroll
  for (int h = 0; h < H; ++h) multiplier[h] = 0.0;
  row_multiplier = 0.0;
  __syncwarp();
  for (int k = 0; k < active_count; ++k) {
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (is(h, active_index[k])) multiplier[h] = reflector[k];
    if (N + lane == active_index[k]) row_multiplier = reflector[k];
  }
  __syncwarp();
};
