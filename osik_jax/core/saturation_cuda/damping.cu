// The damping of a level (level_damping of _damping.py): its constant part, and its other part by the ratio of the
// demand that the step with this very damping misses, at the base: what of x the null space can not move.
double* const value_at_base = square;                 // of the rows, as `value` and `wanted` at x
double* const wanted_at_base = right_below;

// after `look` and `set_beside`: what the rows are at the base and ask for
auto look_at_base = [&]() {
  for (int j = first + lane; j < N; j += 32) place[j] = coordinate_times(j, x);
  __syncwarp();
  for (int a = lane; a < m; a += 32) {
    value_at_base[a] = value[a] - dot(place + first, beside + a, MD, N - first);
    wanted_at_base[a] = distance(a, value_at_base[a]);
    if (rows_equal[here * M + a] != 0 || wanted_at_base[a] != 0.0) counts[a] |= AT_BASE;
  }
  __syncwarp();
};
// the Gram matrix of the rows that take part, ones for the others; returns its trace
auto set_gram = [&]() {
  double trace = 0.0;
  for (int e = lane; e < m * m; e += 32) {
    const int a = e / m, b = e % m;
    if (b < a) continue;
    double total = 0.0;
    if ((counts[a] & counts[b] & AT_BASE) != 0) {
#pragma unroll 4
      for (int j = 0; j < N - first; ++j) total += beside[j * MD + a] * beside[j * MD + b];
      if (a == b) trace += total;
    } else if (a == b) {
      total = 1.0;
    }
    gram[a * VD + b] = total;
  }
  trace = warp_sum(trace);
  __syncwarp();
  return trace;
};
auto missed_with = [&](double ridge) {                // norm of what the damped step leaves
  double part[G], total = 0.0;
  cholesky(m, ridge > 0.0 ? ridge : 1.0);
#pragma unroll
  for (int g = 0; g < G; ++g) part[g] = lane + 32 * g < m ? wanted_at_base[lane + 32 * g] : 0.0;
  cholesky_solve(m, part);
  __syncwarp();
#pragma unroll
  for (int g = 0; g < G; ++g)
    if (lane + 32 * g < m) right[lane + 32 * g] = (counts[lane + 32 * g] & AT_BASE) != 0 ? part[g] : 0.0;
  __syncwarp();
  for (int j = lane; j < N - first; j += 32) place[first + j] = dot(right, beside + j * MD, 1, m);
  __syncwarp();
  for (int a = lane; a < m; a += 32) {
    const double off = distance(a, value_at_base[a] + dot(place + first, beside + a, MD, N - first));
    total += off * off;
  }
  return sqrt(warp_sum(total));
};
auto compute_damping = [&]() {
  damping = constant;
  if (unmet != 0.0) {
    look_at_base();
    const double trace = set_gram();
    double ratio = 1.0, before = 0.0;
    for (int pass = 0; pass < DAMPING_ITERATIONS && ratio != before; ++pass) {
      before = ratio;
      const double missed = missed_with(constant + unmet * ratio + DAMPING_RIDGE * trace);
      ratio = fmin(missed / (demand > 0.0 ? demand : 1.0), 1.0);
    }
    damping += unmet * ratio;
  }
  if (!(damping > NEGLIGIBLE_DAMPING * longest)) damping = 0.0;  // its gradient would be roundoff
};
