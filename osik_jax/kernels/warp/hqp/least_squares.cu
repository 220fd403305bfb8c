// The least-squares problem of the rows in the cost, in the columns of Z after those of the active rows.
// the rows of the level that are wanted go to V: entry i of row a at V[i * VD + a]
auto load_rows = [&](const bool* wanted) {
#pragma unroll
  for (int g = 0; g < G; ++g)
    if (in_level[g])
#pragma unroll 8
      for (int i = 0; i < N; ++i) V[i * VD + lane + 32 * g] = wanted[g] ? entry(lane + 32 * g, i) : 0.0;
  __syncwarp();
};
// these rows in the basis, from a column on, go to R; and the squares of its columns
auto rows_in_basis = [&](int from, double* square) {
#pragma unroll
  for (int h = 0; h < H; ++h) {
    const int j = lane + 32 * h;
    square[h] = 0.0;
    for (int first = 0; first < m; first += 4) {      // four rows at a time, so that sums do not wait for each other
      double total[4] = {0.0, 0.0, 0.0, 0.0};
      if (j >= from && j < width)
#pragma unroll 2
        for (int i = 0; i < N; ++i) {
          const double z = Z[i * ZD + j];
#pragma unroll
          for (int b = 0; b < 4; ++b)
            if (first + b < m) total[b] += V[i * VD + first + b] * z;
        }
#pragma unroll
      for (int b = 0; b < 4; ++b)
        if (first + b < m && exists[h]) R[(first + b) * ZD + j] = total[b], square[h] += total[b] * total[b];
    }
  }
  __syncwarp();
};

auto factor_damped = [&]() {                          // Cholesky factor of R R' + damping I
  for (int e = lane; e < rank * rank; e += 32) {
    const int k = e / rank, l = e % rank;
    if (l < k) continue;
    double total = 0.0;
    for (int j = active_count; j < width; ++j) total += R[k * ZD + j] * R[l * ZD + j];
    gram[k * VD + l] = total;
  }
  __syncwarp();
  cholesky(rank, damping + FACTOR_RIDGE * size * size);
};

auto factor_least_squares = [&]() {                   // pivoted QR of the rows in the cost, in the columns left
  ++factorizations;
  double square[H];                                   // of a column, from row `rank` on
  bool remaining[H];
#pragma unroll
  for (int h = 0; h < H; ++h) remaining[h] = lane + 32 * h >= active_count && lane + 32 * h < width;
  load_rows(in_cost);
  rows_in_basis(active_count, square);
  const int most = width - active_count < m ? width - active_count : m;
  for (rank = 0; rank < most; ++rank) {
    double best = -1.0;
    int which = N;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (remaining[h] && square[h] > best) best = square[h], which = lane + 32 * h;
    warp_argmax(best, which);
    const double norm = sqrt(best);
    if (!(norm > rank_tol * size)) break;
    double* const v = V + rank * VD;
    const double head = R[rank * ZD + which], weight = 1.0 / (norm * (norm + fabs(head)));
    for (int a = lane; a < m; a += 32) {
      const double own = a >= rank ? R[a * ZD + which] : 0.0;
      v[a] = a == rank ? head + (head < 0.0 ? -norm : norm) : own;
    }
    if (lane == 0) reflector_scale[rank] = weight, pivot[rank] = which;
    __syncwarp();
#pragma unroll
    for (int h = 0; h < H; ++h) {
      const int j = lane + 32 * h;
      if (j < active_count || j >= width) continue;
      double even = 0.0, odd = 0.0, left = 0.0;
      int a = rank;
      for (; a + 1 < m; a += 2) even += R[a * ZD + j] * v[a], odd += R[(a + 1) * ZD + j] * v[a + 1];
      if (a < m) even += R[a * ZD + j] * v[a];
      const double by = weight * (even + odd);
      R[rank * ZD + j] -= by * v[rank];
      for (a = rank + 1; a < m; ++a) {
        const double now = R[a * ZD + j] - by * v[a];
        R[a * ZD + j] = now, left += now * now;
      }
      square[h] = left;
      if (j == which) remaining[h] = false;
    }
    __syncwarp();
  }
  if (damping > 0.0) factor_damped();
};

// the step d that minimises 1/2 |slack + A d|^2 + 1/2 damping |x + d|^2; x has to be in `point`
auto least_squares_step = [&](const double* slack, double* d) {
  double right[G];
#pragma unroll
  for (int g = 0; g < G; ++g) right[g] = in_level[g] && in_cost[g] ? -slack[g] : 0.0;
  for (int k = 0; k < rank; ++k) {
    double total = 0.0;
#pragma unroll
    for (int g = 0; g < G; ++g) total += in_level[g] ? V[k * VD + lane + 32 * g] * right[g] : 0.0;
    total = warp_sum(total) * reflector_scale[k];
#pragma unroll
    for (int g = 0; g < G; ++g) right[g] -= in_level[g] ? V[k * VD + lane + 32 * g] * total : 0.0;
  }
  if (damping > 0.0) {                                // x + d = R' (R R' + damping I)^-1 (R x - Q' slack)
    for (int j = lane; j < width; j += 32) {
      double total = 0.0;
      for (int i = 0; i < N; ++i) total += Z[i * ZD + j] * point[i];
      work_b[j] = j >= active_count ? total : 0.0;
    }
    __syncwarp();
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int k = lane + 32 * g;
      if (k >= rank) right[g] = 0.0;
      else
        for (int j = active_count; j < width; ++j) right[g] += R[k * ZD + j] * work_b[j];
    }
    cholesky_solve(rank, right);
    __syncwarp();
#pragma unroll
    for (int g = 0; g < G; ++g)
      if (lane + 32 * g < rank) work_a[lane + 32 * g] = right[g];
    __syncwarp();
    for (int j = lane; j < N; j += 32) {
      double total = 0.0;
      if (j >= active_count && j < width) {
        for (int k = 0; k < rank; ++k) total += R[k * ZD + j] * work_a[k];
        total -= work_b[j];
      }
      reflector[j] = total;
    }
    __syncwarp();
    from_basis(active_count, width, d);
    __syncwarp();
    return;
  }
  for (int j = lane; j < N; j += 32) reflector[j] = 0.0;
  __syncwarp();
  for (int k = rank - 1; k >= 0; --k) {
    double mine = right[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? right[g] : mine;
    const double z = __shfl_sync(ALL, mine, k & 31) / R[k * ZD + pivot[k]];
#pragma unroll
    for (int g = 0; g < G; ++g)
      if (lane + 32 * g < k) right[g] -= R[(lane + 32 * g) * ZD + pivot[k]] * z;
    if (lane == 0) reflector[pivot[k]] = z;
  }
  __syncwarp();
  from_basis(active_count, width, d);
  __syncwarp();
};
