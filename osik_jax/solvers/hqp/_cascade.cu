// Body of one function: a hierarchy, solved by one warp in double precision. _kernel.py names the arguments; the
// problem and the conditions by which a level is judged are those of _cascade.py, _working_set_solve.py and
// _primal_active_set.py.
//
// Z, an orthonormal basis of the null space of what the levels so far have frozen, gets narrower from level to level.
// At each level, active hard rows are rotated into its first columns by Householder reflections from the right; the
// level's rows, in the columns that are left, are factored by reflections from the left with column pivoting. The
// working set of the warm start is tried first. Where its solution is not optimal, violated rows become active, rows
// whose multiplier has the wrong sign inactive, and it is solved again, a few times (M. Hintermueller, K. Ito, K.
// Kunisch, "The primal-dual active set strategy as a semismooth Newton method", 2003). Where that fails, or there is
// no warm start, a primal active-set method begins where the level above ended. Where that is stationary but for
// directions that the rank tolerance left out, it takes one damped step along them. Rows that the optimum freezes, and
// the row space of the level's factor, are rotated to the front of Z and removed.
//
// A level may have damping (_damping.py): its cost is 1/2 |slack|^2 + 1/2 damping |x|^2. The last level has no rows
// and damping 1: the smallest norm.
//
// Variable i belongs to lane i % 32, and so do row i of the level and column i of Z. Constants from _kernel.py: N
// variables, LEVELS, M rows of the longest level, ROWS of all levels, P hard rows beside the box (at most 32), WARPS
// of a block; DAMPING_ITERATIONS, NEGLIGIBLE_DAMPING, COST_FRACTION, MIN_RADIUS, NEGLIGIBLE_CURVATURE of
// numerics/_constants.py; COUNT, OFFSET and HAS_INEQUALITIES of each level; of each hard row beside the box its ROW
// among those of all levels, and its LEVEL.

constexpr int H = (N + 31) / 32, G = (M + 31) / 32;   // variables and rows of a lane
constexpr int ZD = N | 1, VD = M | 1;                 // row lengths in shared memory: odd, to meet every bank
constexpr int MAX_RANK = N < M ? N : M;
constexpr int MAX_LENGTH = (N > M ? N : M) > P ? (N > M ? N : M) : P;
constexpr int HARD = N + P;
constexpr int FACTORS = N * VD + M * ZD;              // the level's rows, then their reflectors; the triangle
constexpr int MAX_ATTEMPTS = 4;                       // solves on a guessed working set and its corrections
constexpr int MAX_STALLED = 20;                       // steps of zero length, before the least index decides
constexpr double WEAK_DAMPING = 1e-9;                 // of the longest row, squared, as in _working_set_guess.py
constexpr unsigned ALL = 0xffffffffu;

__shared__ double shared_doubles[WARPS][N * ZD + FACTORS + (P ? P : 1) * ZD + 4 * MAX_LENGTH + MAX_RANK + M * VD + M];
__shared__ int shared_ints[WARPS][N + MAX_RANK + M];

const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
bool exists[H];
#pragma unroll
for (int h = 0; h < H; ++h) exists[h] = lane + 32 * h < N;
double* const Z = shared_doubles[warp];               // row i: variable i
double* const V = Z + N * ZD;                         // row k: reflector k of the level's factor, over its rows
double* const R = V + N * VD;                         // row k: row k of the triangle, over the columns of Z
double* const E = Z + N * ZD + FACTORS;               // hard rows beside the box, in the basis
double* const point = E + (P ? P : 1) * ZD;
double* const reflector = point + MAX_LENGTH;         // a reflector, or coefficients of a step in the basis
double* const work_a = reflector + MAX_LENGTH;
double* const work_b = work_a + MAX_LENGTH;
double* const reflector_scale = work_b + MAX_LENGTH;  // of the reflectors
double* const gram = reflector_scale + MAX_RANK;      // Gram matrix above, its Cholesky factor below the diagonal
double* const inverse_diagonal = gram + M * VD;       // 1 / diagonal of that factor
double* const level_rows = R;                         // before it is a triangle: the level's rows in the basis
int* const active_index = shared_ints[warp];          // the hard row that column k of the basis belongs to
int* const pivot = active_index + N;
int* const in_cost_flags = pivot + MAX_RANK;

auto warp_sum = [&](double a) {
  for (int distance = 16; distance; distance /= 2) a += __shfl_xor_sync(ALL, a, distance);
  return a;
};
auto warp_max = [&](double a) {
  for (int distance = 16; distance; distance /= 2) a = fmax(a, __shfl_xor_sync(ALL, a, distance));
  return a;
};
auto warp_argmax = [&](double& a, int& which) {       // in all lanes, with the least index among equals
  for (int distance = 16; distance; distance /= 2) {
    double other = __shfl_xor_sync(ALL, a, distance);
    int index = __shfl_xor_sync(ALL, which, distance);
    if (other > a || (other == a && index < which)) a = other, which = index;
  }
};
auto any = [&](bool a) { return __any_sync(ALL, a) != 0; };
auto is = [&](int h, int row) { return exists[h] && lane + 32 * h == row; };  // a row of the box, of this lane
auto is_finite = [](double a) { return fabs(a) <= 1.7e308; };
auto clip = [](double a, double low, double high) { return fmin(fmax(a, low), high); };

const size_t problem = pid;
const double* const A = matrix.data + problem * (size_t)(N * ROWS);  // column i of all rows is at A + i * ROWS
const double rank_tol = tolerances.data[problem * 4], step_tol = tolerances.data[problem * 4 + 1];
const double multiplier_tol = tolerances.data[problem * 4 + 2], feasibility_tol = tolerances.data[problem * 4 + 3];

// ---- the variables
double x[H], low[H], high[H];
double curvature[H];                                  // of the levels so far along each variable
int active[H], bound_label[H];                        // active: -1 at the lower bound, 1 at the upper, 0 inactive
bool frozen[H];
int width = 0;                                        // number of columns of Z
#pragma unroll
for (int h = 0; h < H; ++h) {
  const int i = lane + 32 * h;
  low[h] = exists[h] ? hard_lower.data[problem * HARD + i] : 0.0;
  high[h] = exists[h] ? hard_upper.data[problem * HARD + i] : 0.0;
  frozen[h] = !exists[h] || hard_equal.data[problem * HARD + i] != 0;
  bound_label[h] = exists[h] && frozen[h] ? 2 : 0;
  active[h] = 0, curvature[h] = 0.0;
  x[h] = clip(0.0, low[h], high[h]);
  const unsigned loose = __ballot_sync(ALL, !frozen[h]);
  if (exists[h]) {
    for (int j = 0; j < ZD; ++j) Z[i * ZD + j] = 0.0;
    if (!frozen[h]) Z[i * ZD + width + __popc(loose & ((1u << lane) - 1u))] = 1.0;
  }
  width += __popc(loose);
}

// ---- hard rows beside the box: row q belongs to lane q
const bool has_row = lane < P;
double row_low = -INFINITY, row_high = INFINITY, row_length = 1.0;
int row_active = 0, row_level = LEVELS;
bool row_frozen = true;
const double* const row_of_lane = A + (P ? ROW[lane < P ? lane : 0] : 0);
if (has_row) {
  row_low = hard_lower.data[problem * HARD + N + lane];
  row_high = hard_upper.data[problem * HARD + N + lane];
  row_level = LEVEL[lane];
  row_frozen = false;
  double square = 0.0;
#pragma unroll 8
  for (int i = 0; i < N; ++i) square += row_of_lane[i * ROWS] * row_of_lane[i * ROWS];
  row_length = sqrt(square);
}

int known = 0;                                        // 0 where there is no warm start
for (int e = lane; e < LEVELS * M; e += 32) known |= guess_own.data[problem * (LEVELS * M) + e];
const bool warm = any(known != 0);

// ---- one level: its numbers, and the factors that it works with
int level = 0, m = 0, active_count = 0, rank = 0, factorizations = 0, changes = 0;
const double* B = A;                                  // its first row
bool has_inequalities = false;
double level_lower[G], level_upper[G], length[G], size = 0.0, damping = 0.0;
bool equal[G], in_cost[G], in_level[G];

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
auto entry_in_basis = [&](int row, int column) {      // of a hard row in the basis
  return row < N ? Z[row * ZD + column] : E[(row - N) * ZD + column];
};
auto from_basis = [&](int from, int to, double* d) {  // sum of columns of Z times `reflector`
#pragma unroll
  for (int h = 0; h < H; ++h) {
    d[h] = 0.0;
    if (exists[h])
      for (int j = from; j < to; ++j) d[h] += Z[(lane + 32 * h) * ZD + j] * reflector[j];
  }
};
// the sum of the squares of a row's entries
auto norm_squared = [&](const double* row, int from, int to) {
  double even = 0.0, odd = 0.0;
  int j = from;
  for (; j + 1 < to; j += 2) even += row[j] * row[j], odd += row[j + 1] * row[j + 1];
  return j < to ? even + odd + row[j] * row[j] : even + odd;
};
// `reflector` becomes the Householder vector v that takes a row's entries from `at` on to entry `at`; returns 2 / v'v
auto make_reflector = [&](const double* row, int at) {
  double square = 0.0;
  __syncwarp();
  for (int j = lane; j < N; j += 32) {
    reflector[j] = j >= at && j < width ? row[j] : 0.0;
    square += reflector[j] * reflector[j];
  }
  const double norm = sqrt(warp_sum(square));
  __syncwarp();
  const double head = reflector[at];
  __syncwarp();
  if (lane == 0) reflector[at] = head + (head < 0.0 ? -norm : norm);
  __syncwarp();
  return 1.0 / (norm * (norm + fabs(head)));
};
// applies I - weight v v' from the right to a row of this lane
auto apply_reflector = [&](double* row, int at, double weight) {
  double even = 0.0, odd = 0.0;
  int j = at;
  for (; j + 1 < width; j += 2) even += row[j] * reflector[j], odd += row[j + 1] * reflector[j + 1];
  if (j < width) even += row[j] * reflector[j];
  const double by = weight * (even + odd);
  for (int i = at; i < width; ++i) row[i] -= by * reflector[i];
};

// Cholesky factor of the first `count` rows of `gram`, whose upper triangle with the diagonal is the matrix, plus
// `ridge` on the diagonal; the factor goes below the diagonal, the inverse of its own to `inverse_diagonal`
auto cholesky = [&](int count, double ridge) {
  for (int k = 0; k < count; ++k) {
    double value[G];
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int a = lane + 32 * g;
      value[g] = a >= k && a < count ? gram[k * VD + a] + (a == k ? ridge : 0.0) : 0.0;
      if (a >= k && a < count)
        for (int j = 0; j < k; ++j) value[g] -= gram[a * VD + j] * gram[k * VD + j];
    }
    double mine = value[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? value[g] : mine;
    const double inverse = 1.0 / sqrt(fmax(__shfl_sync(ALL, mine, k & 31), 1e-300));
    __syncwarp();
#pragma unroll
    for (int g = 0; g < G; ++g)
      if (lane + 32 * g > k && lane + 32 * g < count) gram[(lane + 32 * g) * VD + k] = value[g] * inverse;
    if (lane == 0) inverse_diagonal[k] = inverse;
    __syncwarp();
  }
};
auto cholesky_solve = [&](int count, double* right) { // entry a of lane a % 32
  for (int k = 0; k < count; ++k) {
    double mine = right[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? right[g] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) * inverse_diagonal[k];
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int a = lane + 32 * g;
      if (a == k) right[g] = y;
      if (a > k && a < count) right[g] -= gram[a * VD + k] * y;
    }
  }
  for (int k = count - 1; k >= 0; --k) {
    double mine = right[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? right[g] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) * inverse_diagonal[k];
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int a = lane + 32 * g;
      if (a == k) right[g] = y;
      if (a < k) right[g] -= gram[k * VD + a] * y;
    }
  }
};

auto rotate_active_rows = [&]() {                     // pivoted QR of the active rows: to the front of Z
  bool remaining[H], row_remaining = row_active != 0, some = row_remaining;
#pragma unroll
  for (int h = 0; h < H; ++h) remaining[h] = active[h] != 0, some = some || remaining[h];
  active_count = 0;
  if (P) {
    for (int j = lane; j < width; j += 32)
      for (int q = 0; q < P; ++q) {
        double total = 0.0;
#pragma unroll 8
        for (int i = 0; i < N; ++i) total += A[i * ROWS + ROW[q]] * Z[i * ZD + j];
        E[q * ZD + j] = total;
      }
    __syncwarp();
  }
  if (!any(some)) return;
  while (active_count < width) {
    double best = -1.0;
    int which = HARD;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (remaining[h]) {
        const double square = norm_squared(Z + (lane + 32 * h) * ZD, active_count, width);
        if (square > best) best = square, which = lane + 32 * h;
      }
    if (P && row_remaining) {
      double square = norm_squared(E + lane * ZD, active_count, width);
      square /= row_length > 0.0 ? row_length * row_length : 1.0;
      if (square > best) best = square, which = N + lane;
    }
    warp_argmax(best, which);
    if (!(best > rank_tol * rank_tol)) break;
    const double weight = make_reflector(which < N ? Z + which * ZD : E + (which - N) * ZD, active_count);
#pragma unroll
    for (int h = 0; h < H; ++h) {
      if (exists[h]) apply_reflector(Z + (lane + 32 * h) * ZD, active_count, weight);
      if (is(h, which)) remaining[h] = false;
    }
    if (has_row) {
      apply_reflector(E + lane * ZD, active_count, weight);
      if (N + lane == which) row_remaining = false;
    }
    if (lane == 0) active_index[active_count] = which;
    ++active_count;
    __syncwarp();
  }
#pragma unroll
  for (int h = 0; h < H; ++h) {
    if (remaining[h]) active[h] = 0;
  }
  if (row_remaining) row_active = 0;
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
  cholesky(rank, damping + 1e-14 * size * size);
};

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

auto restoring_step = [&](double* d) {                // the shortest step of the active rows to their bounds
  to_point(x);
  double gap[H];
  if (P) {
    if (has_row) work_a[lane] = (row_active < 0 ? row_low : row_high) - hard_row_times(point);
    __syncwarp();
  }
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) work_b[lane + 32 * h] = (active[h] < 0 ? low[h] : high[h]) - x[h];
  __syncwarp();
#pragma unroll
  for (int h = 0; h < H; ++h) {
    const int k = lane + 32 * h;
    gap[h] = k < active_count ? active_index[k] < N ? work_b[active_index[k]] : work_a[active_index[k] - N] : 0.0;
  }
  for (int k = 0; k < active_count; ++k) {
    double mine = gap[0];
#pragma unroll
    for (int h = 1; h < H; ++h) mine = k >> 5 == h ? gap[h] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) / entry_in_basis(active_index[k], k);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h > k && lane + 32 * h < active_count)
        gap[h] -= entry_in_basis(active_index[lane + 32 * h], k) * y;
    if (lane == 0) reflector[k] = y;
  }
  __syncwarp();
  from_basis(0, active_count, d);
  __syncwarp();
};

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

bool all_done = true;
double worst_residual = 0.0;
for (level = 0; level < LEVELS; ++level) {
  const size_t here = problem * LEVELS + level;
  m = COUNT[level], has_inequalities = HAS_INEQUALITIES[level] != 0;
  B = A + OFFSET[level];
  if (width == 0) {                                   // no freedom is left: the level is skipped
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (exists[h]) {
        active_rows.data[here * HARD + lane + 32 * h] = 0, frozen_rows.data[here * HARD + lane + 32 * h] = 0;
        multipliers.data[here * HARD + lane + 32 * h] = 0.0;
      }
    if (has_row) {
      active_rows.data[here * HARD + N + lane] = 0, frozen_rows.data[here * HARD + N + lane] = 0;
      multipliers.data[here * HARD + N + lane] = 0.0;
    }
    for (int a = lane; a < M; a += 32) rows_in_cost.data[here * M + a] = 0, own_rows.data[here * M + a] = 0;
    if (lane == 0) ranks.data[here] = 0, slack_norms.data[here] = INFINITY, level_dampings.data[here] = 0.0;
    continue;
  }
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
  const double longest = size * size;
  double frobenius = 0.0;                             // Frobenius norm of the rows
#pragma unroll
  for (int g = 0; g < G; ++g) frobenius += length[g] * length[g];
  frobenius = sqrt(warp_sum(frobenius));

  // ---- its damping, a fixed point: the ratio of the demand that the damped step, clipped into the box, misses
  const double* const given_damping = dampings.data + problem * (LEVELS * 3) + level;
  const double constant = given_damping[0], unmet = given_damping[LEVELS], demand = given_damping[2 * LEVELS];
  damping = constant;
  if (unmet > NEGLIGIBLE_DAMPING * longest) {
    double base[H], goal[G], d[H], squares[H], trace = 0.0, ratio = 1.0;
    bool all[G];
#pragma unroll
    for (int g = 0; g < G; ++g) all[g] = true;
    load_rows(all);
    auto distance = [&](int g) {                      // of row lane + 32 g to its interval, at `point`
      double at = 0.0;
#pragma unroll 4
      for (int i = 0; i < N; ++i) at += V[i * VD + lane + 32 * g] * point[i];
      return equal[g] ? at - level_lower[g] : at - clip(at, level_lower[g], level_upper[g]);
    };
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
    for (int h = 0; h < H; ++h) base[h] = x[h] - d[h];
    to_point(base);
#pragma unroll
    for (int g = 0; g < G; ++g) {
      goal[g] = in_level[g] ? -distance(g) : 0.0;
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
    double before = 0.0;                              // the fixed point is reached where the ratio stays
    const double least = NEGLIGIBLE_DAMPING * longest;
    for (int pass = 0; pass < DAMPING_ITERATIONS && ratio != before && unmet * ratio > least; ++pass) {
      before = ratio;
      double y[G], residual_norm = 0.0;
      const double ridge = constant + unmet * ratio + 1e-13 * trace;
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
      ratio = fmin(sqrt(warp_sum(residual_norm)) / (demand > 0.0 ? demand : 1.0), 1.0);
    }
    damping = constant + unmet * ratio;
  }
  if (!(damping > NEGLIGIBLE_DAMPING * longest)) damping = 0.0;  // its gradient would be roundoff
  size = fmax(size, sqrt(damping));

  double value[G], slack[G], x_max = 0.0, root_cost = 0.0, slack_norm = 0.0;
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
  auto is_stationary = [&]() { return residual <= 10.0 * (multiplier_tol * size * root_cost + roundoff()); };

  // ---- the working set of the warm start, corrected where its solution shows that it is wrong, all rows at once
  double start[H];
  int inherited[H], row_inherited = row_active;
  bool optimal = false, needs_rotation = true, needs_factors = true;
#pragma unroll
  for (int h = 0; h < H; ++h) start[h] = x[h], inherited[h] = active[h];
  if (warm) {
    int own[G];
    const bool row_may_block = has_row && !row_frozen && row_level < level;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      int at = exists[h] ? guess_hard.data[here * HARD + lane + 32 * h] : 0;
      at = at > 0 ? 1 : at < 0 ? -1 : 0;
      active[h] = !frozen[h] && at != 0 && is_finite(at < 0 ? low[h] : high[h]) ? at : 0;
    }
    row_active = 0;
    if (row_may_block) {
      int at = guess_hard.data[here * HARD + N + lane];
      at = at > 0 ? 1 : at < 0 ? -1 : 0;
      row_active = at != 0 && is_finite(at < 0 ? row_low : row_high) ? at : 0;
    }
#pragma unroll
    for (int g = 0; g < G; ++g) {
      int at = in_level[g] ? guess_own.data[here * M + lane + 32 * g] : 0;
      at = at > 0 ? 1 : at < 0 ? -1 : 0;
      if (!is_finite(at < 0 ? level_lower[g] : level_upper[g])) at = 0;
      own[g] = equal[g] ? 2 : at;
    }
    bool feasible = false;
    for (int attempt = 1;; ++attempt) {
      double goal[G], d[H];
#pragma unroll
      for (int g = 0; g < G; ++g) in_cost[g] = own[g] != 0, goal[g] = own[g] == 1 ? level_upper[g] : level_lower[g];
#pragma unroll
      for (int h = 0; h < H; ++h) x[h] = start[h];
      rotate_active_rows();
      factor_least_squares();
      for (int round = 0; round < 2; ++round) {
        double off[G];
        restoring_step(d);
#pragma unroll
        for (int h = 0; h < H; ++h) x[h] += d[h];
        to_point(x);
#pragma unroll
        for (int g = 0; g < G; ++g) off[g] = in_cost[g] ? row_times(lane + 32 * g, point) - goal[g] : 0.0;
        least_squares_step(off, d);
#pragma unroll
        for (int h = 0; h < H; ++h) x[h] += d[h];
      }
      evaluate();
      double square = 0.0, at_row = 0.0;
      int corrected[G];                               // in the cost, or at which bound, as the values have it
      bool consistent = true;
#pragma unroll
      for (int g = 0; g < G; ++g) {
        corrected[g] = own[g];
        if (in_level[g]) {
          const double near = feasibility_tol * (length[g] * x_max + fabs(value[g]));
          const double under = level_lower[g] - value[g], over = value[g] - level_upper[g];
          const bool right =
              own[g] == 2 || (own[g] == 0 ? fmax(under, over) <= near : (own[g] < 0 ? under : over) >= -near);
          if (!right) corrected[g] = own[g] != 0 ? 0 : under > over ? -1 : 1;
          consistent = consistent && right;
          slack[g] = in_cost[g] ? value[g] - goal[g] : 0.0;
          square += slack[g] * slack[g];
        }
      }
      double own_size = 0.0;
#pragma unroll
      for (int h = 0; h < H; ++h) own_size += exists[h] ? x[h] * x[h] : 0.0;
      root_cost = sqrt(warp_sum(square) + damping * warp_sum(own_size));
      if (has_row) at_row = hard_row_times(point);
      bool outside[H], row_outside = false, inside = true;
#pragma unroll
      for (int h = 0; h < H; ++h) {
        outside[h] = exists[h] && !frozen[h] && active[h] == 0 &&
                     !(fmax(low[h] - x[h], x[h] - high[h]) <= feasibility_tol * (x_max + fabs(x[h])));
        inside = inside && !outside[h];
      }
      if (row_may_block && row_active == 0) {
        row_outside =
            !(fmax(row_low - at_row, at_row - row_high) <= feasibility_tol * (row_length * x_max + fabs(at_row)));
        inside = inside && !row_outside;
      }
      if (!is_finite(x_max)) {
        feasible = false;
        break;
      }
      feasible = !any(!inside);
      compute_multipliers(slack);
      const double floor = sign_tolerance();
      bool wrong[H];
      bool row_wrong = has_row && row_active != 0 && wrong_force(row_multiplier, row_active, row_length) > floor;
      bool signs_right = consistent && !row_wrong;
#pragma unroll
      for (int h = 0; h < H; ++h) {
        wrong[h] = active[h] != 0 && wrong_force(multiplier[h], active[h], 1.0) > floor;
        signs_right = signs_right && !wrong[h];
      }
      optimal = feasible && !any(!signs_right) && is_stationary();
      if (optimal || attempt == MAX_ATTEMPTS) break;
      int changed = 0;
#pragma unroll
      for (int h = 0; h < H; ++h) {
        if (outside[h]) active[h] = x[h] < low[h] ? -1 : 1;
        else if (wrong[h]) active[h] = 0;
        changed += __popc(__ballot_sync(ALL, outside[h] || wrong[h]));
      }
      if (row_outside) row_active = at_row < row_low ? -1 : 1;
      else if (row_wrong) row_active = 0;
      changed += __popc(__ballot_sync(ALL, row_outside || row_wrong));
#pragma unroll
      for (int g = 0; g < G; ++g) {
        changed += __popc(__ballot_sync(ALL, corrected[g] != own[g]));
        own[g] = corrected[g];
      }
      if (changed == 0) break;
      changes += changed;
    }
    if (feasible) needs_rotation = false, needs_factors = false;
    else {
#pragma unroll
      for (int h = 0; h < H; ++h) x[h] = start[h], active[h] = inherited[h];
      row_active = row_inherited;
    }
  }

  // ---- the primal active-set method, from a feasible point
  int stalled = 0, rounds = 0;
  bool tried_weak = false;                            // a step along directions under the rank tolerance
  while (!optimal && rounds++ < max_iterations) {
    evaluate();
    if (needs_rotation) rotate_active_rows();
    bool changed = needs_rotation || needs_factors;
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const bool now = in_level[g] && (equal[g] || slack[g] != 0.0);
      changed = changed || now != in_cost[g];
      in_cost[g] = now;
    }
    if (any(changed)) factor_least_squares();
    needs_rotation = needs_factors = false;
    double d[H], rate[G], square = 0.0;
    least_squares_step(slack, d);
    to_point(d);
#pragma unroll
    for (int g = 0; g < G; ++g) {
      rate[g] = in_level[g] ? row_times(lane + 32 * g, point) : 0.0;
      square += in_cost[g] ? rate[g] * rate[g] : 0.0;
    }
    double along_x = 0.0, along_d = 0.0;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (exists[h]) along_x += x[h] * d[h], along_d += d[h] * d[h];
    along_x = damping * warp_sum(along_x), along_d = damping * warp_sum(along_d);
    const bool step_vanishes = sqrt(warp_sum(square) + along_d) <= step_tol * (size * x_max + root_cost);
    bool is_weak = false;
    if (step_vanishes) {
      compute_multipliers(slack);
      is_weak = !tried_weak && !is_stationary();
    }
    if (is_weak) {                                    // a damped step along what the rank tolerance left out
      tried_weak = true;
#pragma unroll
      for (int h = 0; h < H; ++h)
        if (exists[h]) reflector[lane + 32 * h] = downhill[h] / (WEAK_DAMPING * size * size + damping);
      __syncwarp();
      from_basis(active_count, width, d);
      to_point(d);
    } else if (step_vanishes) {
      const double floor = sign_tolerance();
      double worst = -1.0;
      int which = HARD;
#pragma unroll
      for (int h = 0; h < H; ++h) {
        const double by = wrong_force(multiplier[h], active[h], 1.0);
        if (active[h] != 0 && by > floor && (stalled > MAX_STALLED ? 1.0 : by) > worst)
          worst = stalled > MAX_STALLED ? 1.0 : by, which = lane + 32 * h;
      }
      if (has_row && row_active != 0) {
        const double by = wrong_force(row_multiplier, row_active, row_length);
        if (by > floor && (stalled > MAX_STALLED ? 1.0 : by) > worst)
          worst = stalled > MAX_STALLED ? 1.0 : by, which = N + lane;
      }
      warp_argmax(worst, which);
      optimal = worst < 0.0;
      if (optimal) break;
#pragma unroll
      for (int h = 0; h < H; ++h)
        if (is(h, which)) active[h] = 0;
      if (N + lane == which) row_active = 0;
      needs_rotation = true;
      ++changes;
      continue;
    }
    double far = 0.0, shortest = INFINITY;
    int blocking = HARD, blocking_bound = 0;
#pragma unroll
    for (int h = 0; h < H; ++h) far += exists[h] ? d[h] * d[h] : 0.0;
    const double step_norm = sqrt(warp_sum(far));
#pragma unroll
    for (int h = 0; h < H; ++h) {
      if (!exists[h] || frozen[h] || active[h] != 0 || fabs(d[h]) <= rank_tol * step_norm) continue;
      const double gap = (d[h] > 0.0 ? high[h] : low[h]) - x[h], time = fmax(gap / d[h], 0.0);
      if (time < shortest) shortest = time, blocking = lane + 32 * h, blocking_bound = d[h] > 0.0 ? 1 : -1;
    }
    if (P) {
      const double here_rate = has_row ? hard_row_times(point) : 0.0;
      to_point(x);
      if (has_row && !row_frozen && row_level < level && row_active == 0 &&
          fabs(here_rate) > rank_tol * step_norm * row_length) {
        const double bound = here_rate > 0.0 ? row_high : row_low;
        const double time = is_finite(bound) ? fmax((bound - hard_row_times(point)) / here_rate, 0.0) : INFINITY;
        if (time < shortest) shortest = time, blocking = N + lane, blocking_bound = here_rate > 0.0 ? 1 : -1;
      }
    }
    double negative_limit = -shortest;
    warp_argmax(negative_limit, blocking);
    const double limit = -negative_limit;
    double line_minimum = 1.0;
    if (has_inequalities && !is_weak) {               // exact line search: rows enter and leave their intervals
      __syncwarp();
#pragma unroll
      for (int g = 0; g < G; ++g)
        if (in_level[g]) work_a[lane + 32 * g] = value[g], work_b[lane + 32 * g] = rate[g];
      __syncwarp();
      auto slope = [&](double t) {
        double total = along_x + t * along_d;
        for (int a = 0; a < m; ++a) {
          const size_t at = problem * ROWS + OFFSET[level] + a;
          const double v = work_a[a] + t * work_b[a];
          const bool same = rows_equal.data[at] != 0;
          total += work_b[a] * (v - (same ? rows_lower.data[at] : clip(v, rows_lower.data[at], rows_upper.data[at])));
        }
        return total;
      };
      double breakpoint[2 * G + 1], before = 0.0, after = INFINITY;
#pragma unroll
      for (int g = 0; g < G; ++g) {
        const bool moving = in_level[g] && rate[g] != 0.0;
        breakpoint[2 * g] =
            moving && is_finite(level_lower[g]) ? fmax((level_lower[g] - value[g]) / rate[g], 0.0) : 1.0;
        breakpoint[2 * g + 1] =
            moving && is_finite(level_upper[g]) ? fmax((level_upper[g] - value[g]) / rate[g], 0.0) : 1.0;
      }
      breakpoint[2 * G] = lane == 0 ? 0.0 : 1.0;
#pragma unroll
      for (int e = 0; e < 2 * G + 1; ++e)
        if (slope(breakpoint[e]) < 0.0) before = fmax(before, breakpoint[e]);
      before = warp_max(before);
#pragma unroll
      for (int e = 0; e < 2 * G + 1; ++e)
        if (breakpoint[e] > before) after = fmin(after, breakpoint[e]);
      after = -warp_max(-after);
      const double trial = is_finite(after) ? 0.5 * (before + after) : before + 1.0;
      const double at_first = slope(before), at_last = slope(trial);
      const bool rising = at_last > at_first;
      line_minimum = rising ? fmax(before - at_first * (trial - before) / (at_last - at_first), 0.0) : before;
    }
    const bool blocked = limit <= line_minimum;
    const double step_length = blocked ? limit : line_minimum;
    double moved = 0.0;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      if (exists[h]) x[h] += step_length * d[h], moved = fmax(moved, step_length * fabs(d[h]));
      if (blocked && is(h, blocking)) active[h] = blocking_bound;
    }
    if (blocked && N + lane == blocking) row_active = blocking_bound;
    stalled = warp_max(moved) > 0.0 ? 0 : stalled + 1;
    needs_rotation = blocked;
    tried_weak = tried_weak && !blocked;
    changes += blocked;
  }
  all_done = all_done && optimal;
  worst_residual = fmax(worst_residual, residual);

  // ---- the freezing rule (_freeze.py): active rows with a multiplier, and own rows in the cost, become equalities
  evaluate();
  double far_x = 0.0;
#pragma unroll
  for (int h = 0; h < H; ++h) far_x += exists[h] ? x[h] * x[h] : 0.0;
  // a multiplier that the damping alone explains leaves the levels below room on the face that the level has reached
  const double floor = sign_tolerance() + damping * sqrt(warp_sum(far_x));
  bool same = true, all_freeze = true;
  bool row_freezes = has_row && row_active != 0 && fabs(row_multiplier) * row_length > floor;
  bool now_in_cost[G], freezes[H];
#pragma unroll
  for (int g = 0; g < G; ++g) {
    const double small = multiplier_tol * (length[g] * x_max + root_cost);
    now_in_cost[g] = in_level[g] && (equal[g] || fabs(slack[g]) > small);
    same = same && now_in_cost[g] == in_cost[g];
  }
#pragma unroll
  for (int h = 0; h < H; ++h) {
    freezes[h] = exists[h] && active[h] != 0 && fabs(multiplier[h]) > floor;
    all_freeze = all_freeze && freezes[h] == (active[h] != 0);
  }
  all_freeze = !any(!all_freeze || row_freezes != (row_active != 0));
  same = !any(!same);
  const int rank_at_optimum = rank;
  int active_at_end[H], row_active_at_end = row_active;
#pragma unroll
  for (int h = 0; h < H; ++h) active_at_end[h] = active[h];
  if (!(same && all_freeze)) {
#pragma unroll
    for (int h = 0; h < H; ++h) active[h] = freezes[h] ? active[h] : 0;
    row_active = row_freezes ? row_active : 0;
#pragma unroll
    for (int g = 0; g < G; ++g) in_cost[g] = now_in_cost[g];
    rotate_active_rows();
    factor_least_squares();
  }
  const bool tie = same && rank != rank_at_optimum && damping == 0.0;

#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) {
      const size_t at = here * HARD + lane + 32 * h;
      active_rows.data[at] = active_at_end[h];
      frozen_rows.data[at] = freezes[h] || tie ? active_at_end[h] : 0;
      multipliers.data[at] = multiplier[h];
      bound_label[h] = active_at_end[h] != 0 ? active_at_end[h] : frozen[h] ? bound_label[h] : 0;
      frozen[h] = frozen[h] || freezes[h];
      active[h] = freezes[h] ? 0 : active_at_end[h];
    }
#pragma unroll
  for (int g = 0; g < G; ++g) {
    const int a = lane + 32 * g;
    const int miss = now_in_cost[g] ? slack[g] > 0.0 ? 1 : -1 : 0;
    if (a < M) {
      rows_in_cost.data[here * M + a] = miss;
      own_rows.data[here * M + a] = equal[g] ? 2 : miss;
    }
    if (in_level[g]) in_cost_flags[a] = now_in_cost[g];
  }
  __syncwarp();
  if (has_row) {
    const size_t at = here * HARD + N + lane;
    active_rows.data[at] = row_active_at_end;
    frozen_rows.data[at] = row_freezes || tie ? row_active_at_end : 0;
    multipliers.data[at] = row_multiplier;
    row_frozen = row_frozen || row_freezes;
    row_active = row_freezes ? 0 : row_active_at_end;
    if (row_level == level) {
      const double at_x = hard_row_times(point);
      row_low = fmin(row_low, at_x), row_high = fmax(row_high, at_x);
      row_frozen = row_frozen || in_cost_flags[ROW[lane] - OFFSET[level]] != 0;
    }
  }
  if (lane == 0) {
    ranks.data[here] = tie ? rank_at_optimum : rank;
    slack_norms.data[here] = slack_norm, level_dampings.data[here] = damping;
  }

  // ---- the trust region of the levels below (narrow_box of _damping.py)
  {
    const double residual_norm = fmin(slack_norm, demand);
    const bool is_narrowed = unmet * (residual_norm / (demand > 0.0 ? demand : 1.0)) > NEGLIGIBLE_DAMPING * longest;
    double cost[H], most = 0.0;
    int count_restricted = 0;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      const double own_curvature = exists[h] ? bends.data[here * N + lane + 32 * h] : 0.0;
      curvature[h] = fmax(curvature[h], own_curvature / (frobenius > 0.0 ? frobenius : 1.0));
      cost[h] = residual_norm * frobenius * curvature[h];
      most = fmax(most, cost[h]);
    }
    most = NEGLIGIBLE_CURVATURE * warp_max(most);
#pragma unroll
    for (int h = 0; h < H; ++h) count_restricted += __popc(__ballot_sync(ALL, cost[h] > most));
    const double gain = COST_FRACTION * (demand - residual_norm) * (demand + residual_norm);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (is_narrowed && cost[h] > most) {
        const double radius = sqrt(gain / (count_restricted * cost[h])) + MIN_RADIUS;
        low[h] = fmax(low[h], x[h] - radius), high[h] = fmin(high[h], x[h] + radius);
      }
  }

  // ---- the row space of the factor is rotated to the front of Z, after the frozen rows, and both are removed
  {
    for (int k = 0; k < rank; ++k) {
      const int at = active_count + k;
      const double weight = make_reflector(R + k * ZD, at);
#pragma unroll
      for (int h = 0; h < H; ++h)
        if (exists[h]) apply_reflector(Z + (lane + 32 * h) * ZD, at, weight);
      for (int row = lane; row < rank; row += 32)
        if (row > k) apply_reflector(R + row * ZD, at, weight);
      __syncwarp();
    }
    const int removed = active_count + rank;
    width -= removed;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (exists[h]) {
        double* const row = Z + (lane + 32 * h) * ZD;
        for (int j = 0; j < width; ++j) row[j] = row[j + removed];
        for (int j = width; j < width + removed; ++j) row[j] = 0.0;
      }
    __syncwarp();
  }
}

#pragma unroll
for (int h = 0; h < H; ++h)
  if (exists[h]) {
    const size_t at = problem * HARD + lane + 32 * h;
    const bool narrowed = bound_label[h] < 0 ? low[h] > hard_lower.data[at] : high[h] < hard_upper.data[at];
    solution.data[problem * N + lane + 32 * h] = x[h];
    active_bounds.data[problem * N + lane + 32 * h] = narrowed ? 0 : bound_label[h];
  }
if (lane == 0) {
  residuals.data[problem] = worst_residual;
  report.data[problem * 3] = all_done;
  report.data[problem * 3 + 1] = changes;
  report.data[problem * 3 + 2] = factorizations;
}
