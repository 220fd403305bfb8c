// The damping of a level (level_damping of _damping.py): its constant part, and its other part by the ratio of the
// demand that the step with this very damping misses, at what of x the null space can not move.

// the Gram matrix of the rows that take part, ones for the others; returns its trace
auto set_gram = [&]() {
  double trace = 0.0;
  for (int e = lane; e < m * m; e += 32) {
    const int a = e / m, b = e % m;
    if (b < a) continue;
    double total = 0.0;
    if (counts[a] != 0 && counts[b] != 0) {
#pragma unroll 4
      for (int j = first; j < N; ++j) total += beside[j * BD + a] * beside[j * BD + b];
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
  for (int g = 0; g < G; ++g) part[g] = lane + 32 * g < m ? wanted[lane + 32 * g] : 0.0;
  cholesky_solve(m, part);
  __syncwarp();
#pragma unroll
  for (int g = 0; g < G; ++g)
    if (lane + 32 * g < m) right[lane + 32 * g] = counts[lane + 32 * g] != 0 ? part[g] : 0.0;
  __syncwarp();
  for (int j = first + lane; j < N; j += 32) {
    place[j] = 0.0;
    for (int a = 0; a < m; ++a) place[j] += beside[j * BD + a] * right[a];
  }
  __syncwarp();
  for (int a = lane; a < m; a += 32) {
    double after = value[a];
#pragma unroll 4
    for (int j = first; j < N; ++j) after += beside[j * BD + a] * place[j];
    const double off = distance(a, after);
    total += off * off;
  }
  return sqrt(warp_sum(total));
};
auto compute_damping = [&]() {
  damping = constant;
  if (unmet != 0.0) {
    for (int j = first + lane; j < N; j += 32) place[j] = coordinate_times(j, x);
    __syncwarp();
    for (int i = lane; i < N; i += 32) now[i] = x[i] - column_times(place, i, first, N);
    look(now);
    const double trace = set_gram();
    double ratio = 1.0;
    for (int pass = 0; pass < DAMPING_ITERATIONS; ++pass) {
      const double missed = missed_with(constant + unmet * ratio + DAMPING_RIDGE * trace);
      ratio = fmin(missed / (demand > 0.0 ? demand : 1.0), 1.0);
    }
    damping += unmet * ratio;
  }
  if (!(damping > NEGLIGIBLE_DAMPING * longest)) damping = 0.0;  // its gradient would be roundoff
};
