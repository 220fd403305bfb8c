// One level: its numbers, its rows at a point and in the coordinates that are left.
int level = 0, m = 0, rank = 0;                       // m: rows before those that only fill up
size_t here = 0;                                      // of the level, among those of all problems
const double* A = matrix;                        // column i of its rows is at A + i * M
double* gram = room;                                  // Gram matrix above, its Cholesky factor below the diagonal
int VD = 1;                                           // length of its rows
double constant = 0.0, unmet = 0.0, demand = 0.0, damping = 0.0;  // as in _damping.py
double longest = 0.0, frobenius = 0.0;                // the longest row, squared; the Frobenius norm of the rows

// `v` times column i of the coordinates from `from` on
auto column_times = [&](const double* v, int i, int from, int to) {
  return dot(v + from, turned + from * D + i, D, to - from);
};
auto coordinate_times = [&](int j, const double* v) { // coordinate j of v, of the joints
  return dot(v, turned + j * D, 1, N);
};
auto row_times = [&](int a, const double* v) {        // row a of the level times v, of the joints
  double total = 0.0;
#pragma unroll 4
  for (int i = 0; i < N; ++i) total += A[i * M + a] * v[i];
  return total;
};
auto squared_norm = [&](const double* w, int apart, int count) {
  double total = 0.0;
#pragma unroll 4
  for (int j = 0; j < count; ++j) total += w[j * apart] * w[j * apart];
  return total;
};
auto distance = [&](int a, double at) {               // from a value of row a to its interval
  const double least = rows_lower[here * M + a], most = rows_upper[here * M + a];
  return (rows_equal[here * M + a] != 0 ? least : clip(at, least, most)) - at;
};
// the level's numbers; `beside` becomes the columns of A
auto load_level = [&]() {
  int count = 0;
  double total = 0.0;
  longest = 0.0;
#pragma unroll 8
  for (int e = lane; e < N * M; e += 32) beside[e / M * MD + e % M] = A[e];
  __syncwarp();
  for (int a = lane; a < M; a += 32) {
    row_square[a] = squared_norm(beside + a, MD, N);
    const size_t at = here * M + a;
    const bool is_bounded = rows_lower[at] > -INFINITY || rows_upper[at] < INFINITY;
    if (rows_equal[at] != 0 || row_square[a] > 0.0 || is_bounded) count = a + 1;
    total += row_square[a], longest = fmax(longest, row_square[a]);
  }
  m = (int)warp_max(count);
  longest = warp_max(longest), frobenius = sqrt(warp_sum(total));
  const double* const given = dampings + problem * (3 * LEVELS) + level;
  constant = given[0], unmet = given[LEVELS], demand = given[2 * LEVELS];
  __syncwarp();
};
// after `load_level`: what the rows are at x and ask for
auto look = [&]() {
  for (int a = lane; a < m; a += 32) {
    value[a] = dot(x, beside + a, MD, N), wanted[a] = distance(a, value[a]);
    counts[a] = rows_equal[here * M + a] != 0 || wanted[a] != 0.0 ? AT_X : 0;
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
// after `load_level`: column j - first of `beside` becomes coordinate j of the rows, four rows at a time
auto set_beside = [&]() {
  for (int a = 0; a < m; a += 4) {
    double total[H][4];
#pragma unroll
    for (int h = 0; h < H; ++h) {
      const int j = first + lane + 32 * h;
#pragma unroll
      for (int k = 0; k < 4; ++k) total[h][k] = 0.0;
#pragma unroll 4
      for (int i = 0; i < (j < N ? N : 0); ++i) {
        const double part = turned[j * D + i];
#pragma unroll
        for (int k = 0; k < 4; ++k) total[h][k] += part * beside[i * MD + (a + k < m ? a + k : a)];
      }
    }
    __syncwarp();
#pragma unroll
    for (int h = 0; h < H; ++h)
#pragma unroll
      for (int k = 0; k < 4; ++k)
        if (first + lane + 32 * h < N && a + k < m) beside[(lane + 32 * h) * MD + a + k] = total[h][k];
    __syncwarp();
  }
  // where no damping has to be found, it is only the factor's
  const int side = unmet != 0.0 || m < N - first ? m : N - first;
  VD = side | 1;
  const bool fits = !HAS_ROOM_ELSEWHERE || (N - first) * MD + side * VD <= ROOM;
  gram = fits ? beside + (N - first) * MD : projectors + problem * (N * N);
};
