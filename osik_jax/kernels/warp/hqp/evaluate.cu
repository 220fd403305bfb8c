// A level at x: what its rows miss, and what counts as zero there.
auto evaluate = [&]() {                             // slack, its norm, and the root of the cost at x
  to_point(x);
  double far = 0.0, square = 0.0;
#pragma unroll
  for (int h = 0; h < H; ++h) far = fmax(far, exists[h] ? fabs(x[h]) : 0.0);
  x_max = warp_max(far);
#pragma unroll
  for (int g = 0; g < G; ++g) {
    value[g] = in_level[g] ? row_times(lane + 32 * g, point) : 0.0;
    slack[g] = in_level[g] ? value[g] - clip(value[g], level_lower[g], level_upper[g]) : 0.0;
    if (equal[g]) slack[g] = value[g] - level_lower[g];
    square += slack[g] * slack[g];
  }
  square = warp_sum(square);
  slack_norm = sqrt(square);
  double own = 0.0;
#pragma unroll
  for (int h = 0; h < H; ++h) own += exists[h] ? x[h] * x[h] : 0.0;
  root_cost = sqrt(square + damping * warp_sum(own));
};
auto wrong_force = [&](double force, int at, double longest) { return -force * at * longest; };
auto roundoff = [&]() { return size * step_tol * (size * x_max + root_cost); };
auto sign_tolerance = [&]() { return multiplier_tol * gradient_norm + roundoff(); };
auto is_stationary = [&]() { return residual <= STATIONARITY_TOL * (multiplier_tol * size * root_cost + roundoff()); };
