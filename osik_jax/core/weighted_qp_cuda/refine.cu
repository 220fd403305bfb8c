// The minimiser on the working set: x on its active bounds, then iterative refinement against residuals of A itself.

// what the rows miss at x, weighted, and from it the gradient of the cost, downhill
auto compute_gradient = [&]() {
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (lane + 32 * h < 4 * NG) point[lane + 32 * h] = x[h];
  __syncwarp();
  for (int r = lane; r < ROWS; r += 32) {
    float value = dot(S + r * LD, point, NG);
    residuals[r] = r >= M && r - M + N == entering ? entering_multiplier : row_weights[r] * (row_targets[r] - value);
    if (r >= M) row_values[r - M] = value;
  }
  __syncwarp();
#pragma unroll
  for (int h = 0; h < H; ++h) {
    gradient[h] = dot_column(S + index[h], residuals, 0, ROWS) - damping_of[h] * (x[h] - center_of[h]);
    if (lane + 32 * h == entering) gradient[h] += entering_multiplier;
    if (!exists[h]) gradient[h] = 0.f;
  }
};
auto refine = [&]() {
  float relative = INFINITY, last_relative = INFINITY;
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (label[h] != FREE) x[h] = label[h] == AT_UPPER ? high[h] : low[h];
  for (int round = 0;; ++round) {
    compute_gradient();
    bool enough = relative * relative <= LAST_CORRECTION * last_relative || relative > MIN_DECREASE * last_relative;
    if (round == MAX_REFINEMENTS || (round > 1 && enough)) break;
    last_relative = relative;
    float step[H], step_size = 0.f, x_size = 0.f;
    solve(gradient, unit, step);
#pragma unroll
    for (int h = 0; h < H; ++h) {
      x[h] += step[h];
      step_size = fmaxf(step_size, fabsf(step[h] * root[h]));
      x_size = fmaxf(x_size, fabsf(x[h] * root[h]));
    }
    relative = warp_max(step_size) / fmaxf(warp_max(x_size), 1e-37f);
  }
};
