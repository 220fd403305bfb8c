// One level: its numbers, and products with its rows.
int level = 0, m = 0, active_count = 0, rank = 0, factorizations = 0, changes = 0;
size_t here = 0;                                      // of the level, among those of all problems
const double* B = A;                                  // its first row
bool has_inequalities = false;
double level_lower[G], level_upper[G], length[G], size = 0.0, damping = 0.0;
double longest = 0.0, frobenius = 0.0;                // the longest row, squared; the Frobenius norm of the rows
double unmet = 0.0, demand = 0.0;                     // of the damping, as in _damping.py
bool equal[G], in_cost[G], in_level[G];
// at x: products of the rows, what they miss, and its norm; the largest |x|; the root of the level's cost
double value[G], slack[G], x_max = 0.0, root_cost = 0.0, slack_norm = 0.0;
bool optimal = false;                                 // whether x is the level's optimum

auto entry = [&](int a, int i) { return B[i * ROWS + a]; };
auto row_times = [&](int a, const double* d) {        // row a of the level times d, in shared memory
  double total = 0.0;
#pragma unroll 8
  for (int i = 0; i < N; ++i) total += B[i * ROWS + a] * d[i];
  return total;
};
auto hard_row_times = [&](const double* d) {          // the lane's hard row beside the box
  double total = 0.0;
#pragma unroll 8
  for (int i = 0; i < N; ++i) total += row_of_lane[i * ROWS] * d[i];
  return total;
};
auto to_point = [&](const double* a) {                // copies a number of each variable to `point`
  __syncwarp();
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) point[lane + 32 * h] = a[h];
  __syncwarp();
};

auto load_level = [&]() {                             // bounds, lengths and sizes of the rows
#pragma unroll
  for (int g = 0; g < G; ++g) {
    const int a = lane + 32 * g;
    in_level[g] = a < m;
    level_lower[g] = level_upper[g] = length[g] = 0.0;
    equal[g] = in_cost[g] = false;
    if (in_level[g]) {
      const size_t at = problem * ROWS + OFFSET[level] + a;
      level_lower[g] = rows_lower.data[at];
      level_upper[g] = rows_upper.data[at];
      equal[g] = rows_equal.data[at] != 0;
      double square = 0.0;
#pragma unroll 8
      for (int i = 0; i < N; ++i) square += B[i * ROWS + a] * B[i * ROWS + a];
      length[g] = sqrt(square);
    }
  }
  size = length[0];
#pragma unroll
  for (int g = 1; g < G; ++g) size = fmax(size, length[g]);
  size = warp_max(size);
  longest = size * size;
  double sum = 0.0;
#pragma unroll
  for (int g = 0; g < G; ++g) sum += length[g] * length[g];
  frobenius = sqrt(warp_sum(sum));
};
