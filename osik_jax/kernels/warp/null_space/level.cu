// One level: its numbers, its rows at a point and in the coordinates that are left.
int level = 0, m = 0, rank = 0;                       // m: rows before those that only fill up
size_t here = 0;                                      // of the level, among those of all problems
const double* A = matrix.data;                        // column i of its rows is at A + i * M
double constant = 0.0, unmet = 0.0, demand = 0.0, damping = 0.0;  // as in _damping.py
double longest = 0.0, frobenius = 0.0;                // the longest row, squared; the Frobenius norm of the rows

// `v` times column i of the coordinates from `from` on
auto column_times = [&](const double* v, int i, int from, int to) {
  double total = 0.0;
#pragma unroll 4
  for (int j = from; j < to; ++j) total += v[j] * turned[j * D + i];
  return total;
};
auto coordinate_times = [&](int j, const double* v) { // coordinate j of v, of the joints
  double total = 0.0;
#pragma unroll 4
  for (int i = 0; i < N; ++i) total += turned[j * D + i] * v[i];
  return total;
};
auto row_times = [&](int a, const double* v) {        // row a of the level times v, of the joints
  double total = 0.0;
#pragma unroll 4
  for (int i = 0; i < N; ++i) total += A[i * M + a] * v[i];
  return total;
};
auto distance = [&](int a, double at) {               // from a value of row a to its interval
  const double least = rows_lower.data[here * M + a], most = rows_upper.data[here * M + a];
  return (rows_equal.data[here * M + a] != 0 ? least : clip(at, least, most)) - at;
};
auto load_level = [&]() {
  int count = 0;
  double total = 0.0;
  longest = 0.0;
  for (int a = lane; a < M; a += 32) {
    row_square[a] = 0.0;
#pragma unroll 4
    for (int i = 0; i < N; ++i) row_square[a] += A[i * M + a] * A[i * M + a];
    const size_t at = here * M + a;
    const bool is_bounded = rows_lower.data[at] > -INFINITY || rows_upper.data[at] < INFINITY;
    if (rows_equal.data[at] != 0 || row_square[a] > 0.0 || is_bounded) count = a + 1;
    total += row_square[a], longest = fmax(longest, row_square[a]);
  }
  m = (int)warp_max(count);
  longest = warp_max(longest), frobenius = sqrt(warp_sum(total));
  const double* const given = dampings.data + problem * (3 * LEVELS) + level;
  constant = given[0], unmet = given[LEVELS], demand = given[2 * LEVELS];
  __syncwarp();
};
auto look = [&](const double* at) {                   // what the rows are at a point and ask for
  __syncwarp();
  for (int a = lane; a < m; a += 32) {
    value[a] = row_times(a, at), wanted[a] = distance(a, value[a]);
    counts[a] = rows_equal.data[here * M + a] != 0 || wanted[a] != 0.0;
  }
  __syncwarp();
};
auto missed_at = [&](const double* at) {              // norm of what the rows miss there
  double total = 0.0;
  __syncwarp();
  for (int a = lane; a < m; a += 32) {
    const double off = distance(a, row_times(a, at));
    total += off * off;
  }
  return sqrt(warp_sum(total));
};
auto set_beside = [&]() {                             // the rows in the coordinates that are left
  for (int e = lane; e < (N - first) * m; e += 32) {
    const int j = first + e / m, a = e % m;
    beside[j * BD + a] = row_times(a, turned + j * D);
  }
  __syncwarp();
};
