// The damping of a level (level_damping of _damping.py): the fixed point of the ratio of its demand that the damped step,
// clipped into the box, misses.
auto distance = [&](int g) {                          // of row lane + 32 g, in V, to its interval, at `point`
  double at = 0.0;
#pragma unroll 4
  for (int i = 0; i < N; ++i) at += V[i * VD + lane + 32 * g] * point[i];
  return equal[g] ? at - level_lower[g] : at - clip(at, level_lower[g], level_upper[g]);
};
// x without what the level may change, what its rows miss there, and the Gram matrix of these rows; returns its trace
auto prepare_damping = [&](double* base, double* goal) {
  double d[H], squares[H], trace = 0.0, far = 0.0;
  bool all[G];
#pragma unroll
  for (int g = 0; g < G; ++g) all[g] = true;
  load_rows(all);
  to_point(x);
  for (int j = lane; j < N; j += 32) {
    double total = 0.0;
    if (j < width)
      for (int i = 0; i < N; ++i) total += Z[i * ZD + j] * point[i];
    reflector[j] = total;
  }
  __syncwarp();
  from_basis(0, width, d);
#pragma unroll
  for (int h = 0; h < H; ++h) base[h] = x[h] - d[h], far = fmax(far, exists[h] ? fabs(x[h]) : 0.0);
  far = warp_max(far);
  to_point(base);
#pragma unroll
  for (int g = 0; g < G; ++g) {
    goal[g] = in_level[g] ? -distance(g) : 0.0;
    // where a row stands on its bound, roundoff must not decide whether the step has to keep it there
    if (!equal[g] && !(fabs(goal[g]) > TIE_ROUNDOFF * length[g] * far)) goal[g] = 0.0;
    if (in_level[g]) work_b[lane + 32 * g] = equal[g] || goal[g] != 0.0 ? 1.0 : 0.0;
  }
  __syncwarp();
  rows_in_basis(0, squares);
  for (int j = lane; j < width; j += 32)
    for (int a = 0; a < m; ++a) level_rows[a * ZD + j] *= work_b[a];
  __syncwarp();
  for (int e = lane; e < m * m; e += 32) {
    const int a = e / m, b = e % m;
    if (b < a) continue;
    double total = 0.0;
    for (int j = 0; j < width; ++j) total += level_rows[a * ZD + j] * level_rows[b * ZD + j];
    gram[a * VD + b] = total;
    if (b == a) trace += total;
  }
  trace = warp_sum(trace);
  __syncwarp();
  return trace;
};
// the ratio that the damped step J' (J J' + damping I)^-1 goal of a ratio misses
auto missed_ratio = [&](const double* base, const double* goal, double ridge) {
  double y[G], d[H], residual_norm = 0.0;
  cholesky(m, ridge > 0.0 ? ridge : 1.0);
#pragma unroll
  for (int g = 0; g < G; ++g) y[g] = goal[g];
  cholesky_solve(m, y);
  __syncwarp();
#pragma unroll
  for (int g = 0; g < G; ++g)
    if (in_level[g]) work_b[lane + 32 * g] = y[g];
  __syncwarp();
  for (int j = lane; j < N; j += 32) {
    double total = 0.0;
    if (j < width)
      for (int a = 0; a < m; ++a) total += level_rows[a * ZD + j] * work_b[a];
    reflector[j] = total;
  }
  __syncwarp();
  from_basis(0, width, d);
#pragma unroll
  for (int h = 0; h < H; ++h) d[h] = exists[h] ? clip(base[h] + d[h], low[h], high[h]) : 0.0;
  to_point(d);
#pragma unroll
  for (int g = 0; g < G; ++g) {
    const double off = in_level[g] ? distance(g) : 0.0;
    residual_norm += off * off;
  }
  return fmin(sqrt(warp_sum(residual_norm)) / (demand > 0.0 ? demand : 1.0), 1.0);
};
auto compute_damping = [&]() {
  const double* const given = dampings.data + problem * (LEVELS * 3) + level;
  const double constant = given[0], least = NEGLIGIBLE_DAMPING * longest;
  unmet = given[LEVELS], demand = given[2 * LEVELS], damping = constant;
  if (unmet > least) {
    double base[H], goal[G], ratio = 1.0, before = 0.0;
    const double trace = prepare_damping(base, goal);
    // the fixed point is reached where the ratio stays
    for (int pass = 0; pass < DAMPING_ITERATIONS && ratio != before && unmet * ratio > least; ++pass) {
      before = ratio;
      ratio = missed_ratio(base, goal, constant + unmet * ratio + DAMPING_RIDGE * trace);
    }
    damping = constant + unmet * ratio;
  }
  if (!(damping > least)) damping = 0.0;              // its gradient would be roundoff
  size = fmax(size, sqrt(damping));
};
