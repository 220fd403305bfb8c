// Body of one function: a hierarchy, solved by the warp that calls it, in double precision. _kernel.py names the
// arguments; what is solved and how a level is judged is that of _cascade.py, _primal.py and _landing.py.
//
// Z, an orthonormal basis of what the levels so far leave free, gets narrower from level to level. At each level, rows
// that are held at a bound are rotated into its first columns by reflections from the right; the level's rows, in the
// columns that are left, are factored by reflections from the left with pivoting. The working set of the warm start is
// tried first; where its landing is not the optimum, what it violates is held, what pulls is let go, and it is tried
// again (M. Hintermueller, K. Ito, K. Kunisch, "The primal-dual active set strategy as a semismooth Newton method",
// 2003), a few times. Else, and where there is none, a primal active set begins where the level above ended. Where it
// rests on a direction that the factor's tolerance left out, it takes one damped step along it. What is tight at the
// optimum, and the row space of the level's factor, are rotated to the front and cut off.
//
// A level may have damping (_damping.py): its cost is 1/2 |slack|^2 + 1/2 damping |x|^2. The last level has no rows and
// damping 1: the smallest norm.
//
// Variable i belongs to lane i % 32, and so do row i of the level and column i of Z. Constants from _kernel.py: N
// variables, LEVELS, M rows of the longest level, ROWS of all levels, PASSES to the fixed point of a damping and LEAST,
// SPENT, ROOM, BENDS of _damping.py, P hard
// rows beside the box (at most 32), WARPS a block; COUNT, OFFSET, MIXED of each level; PLACE of each hard row among all
// rows, and its LEVEL.

constexpr int H = (N + 31) / 32, G = (M + 31) / 32;   // variables and rows a lane
constexpr int ZD = N | 1, VD = M | 1;                 // lengths of rows in shared memory: odd, so that they meet every bank
constexpr int MOST_RANK = N < M ? N : M;
constexpr int LONGEST = (N > M ? N : M) > P ? (N > M ? N : M) : P;
constexpr int HARD = N + P;
constexpr int FACTORS = N * VD + M * ZD;               // reflections, before them the level's rows; then what they make
constexpr int ATTEMPTS = 4;                           // at a working set, before it is changed by hand
constexpr int PATIENCE = 20;                          // steps of no length, before the least index decides
constexpr double DAMPING = 1e-9;                      // of the longest row, squared, as in _proposal.py
constexpr unsigned ALL = 0xffffffffu;

__shared__ double shared_doubles[WARPS][N * ZD + FACTORS + (P ? P : 1) * ZD + 4 * LONGEST + MOST_RANK + M * VD + M];
__shared__ int shared_ints[WARPS][N + MOST_RANK + M];

const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
bool exists[H];
#pragma unroll
for (int h = 0; h < H; ++h) exists[h] = lane + 32 * h < N;
double* const Z = shared_doubles[warp];               // row i: variable i
double* const V = Z + N * ZD;                         // row k: reflection k of the level's factor, over its rows
double* const R = V + N * VD;                         // row k of the triangle, over the columns of Z
double* const E = Z + N * ZD + FACTORS;               // hard rows beside the box, in the basis
double* const point = E + (P ? P : 1) * ZD;
double* const turn = point + LONGEST;                 // a reflection, or what is worked out with it
double* const first_of = turn + LONGEST;
double* const second_of = first_of + LONGEST;
double* const strength = second_of + LONGEST;         // of the reflections
double* const square_of = strength + MOST_RANK;       // Cholesky factor below, what is factored above; rows of VD
double* const inverse_of = square_of + M * VD;        // of the diagonal of that factor
double* const rows_of = R;                            // before the triangle is: the level's rows in the basis
int* const held = shared_ints[warp];                  // the row that column k of the basis is for
int* const pivot = held + N;
int* const flags = pivot + MOST_RANK;

auto sum = [&](double a) {
  for (int far = 16; far; far /= 2) a += __shfl_xor_sync(ALL, a, far);
  return a;
};
auto largest = [&](double a) {
  for (int far = 16; far; far /= 2) a = fmax(a, __shfl_xor_sync(ALL, a, far));
  return a;
};
auto first_largest = [&](double& a, int& which) {     // everywhere, with the least index among equals
  for (int far = 16; far; far /= 2) {
    double other = __shfl_xor_sync(ALL, a, far);
    int index = __shfl_xor_sync(ALL, which, far);
    if (other > a || (other == a && index < which)) a = other, which = index;
  }
};
auto any = [&](bool a) { return __any_sync(ALL, a) != 0; };
auto is = [&](int h, int row) { return exists[h] && lane + 32 * h == row; };  // a row of the box, of this lane
auto is_finite = [](double a) { return fabs(a) <= 1.7e308; };
auto clip = [](double a, double low, double high) { return fmin(fmax(a, low), high); };

const size_t problem = pid;
const double* const A = matrix.data + problem * (size_t)(N * ROWS);  // column i of all rows is at A + i * ROWS
const double rank_share = tolerances.data[problem * 4], step_share = tolerances.data[problem * 4 + 1];
const double multiplier_share = tolerances.data[problem * 4 + 2], feasible_share = tolerances.data[problem * 4 + 3];

// ---- the variables
double x[H], low[H], high[H];
double bent[H];                                       // how much a variable bends the rows of the levels so far
int side[H], box_label[H];                            // side: held at the lower (-1) or upper (1) bound
bool frozen[H];
int width = 0;                                        // columns of Z
#pragma unroll
for (int h = 0; h < H; ++h) {
  const int i = lane + 32 * h;
  low[h] = exists[h] ? hard_lower.data[problem * HARD + i] : 0.0;
  high[h] = exists[h] ? hard_upper.data[problem * HARD + i] : 0.0;
  frozen[h] = !exists[h] || hard_equal.data[problem * HARD + i] != 0;
  box_label[h] = exists[h] && frozen[h] ? 2 : 0;
  side[h] = 0, bent[h] = 0.0;
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
int row_side = 0, row_level = LEVELS;
bool row_frozen = true;
const double* const row_of_lane = A + (P ? PLACE[lane < P ? lane : 0] : 0);
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

int known = 0;                                        // whether there is a warm start
for (int e = lane; e < LEVELS * M; e += 32) known |= guess_own.data[problem * (LEVELS * M) + e];
const bool warm = any(known != 0);

// ---- one level: its numbers, and the factors that it works with
int level = 0, m = 0, held_count = 0, rank = 0, factorizations = 0, changes = 0;
const double* B = A;                                  // its first row
bool mixed = false;
double below[G], above[G], length[G], size = 0.0, damping = 0.0;
bool equal[G], counts[G], in_level[G];

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
auto share_out = [&](const double* a) {               // a number of each variable, to `point`
  __syncwarp();
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) point[lane + 32 * h] = a[h];
  __syncwarp();
};
auto place_of = [&](int row, int column) {            // of a hard row, in the basis
  return row < N ? Z[row * ZD + column] : E[(row - N) * ZD + column];
};
auto along = [&](int from, int to, double* d) {       // sum of columns of Z, times what `turn` says
#pragma unroll
  for (int h = 0; h < H; ++h) {
    d[h] = 0.0;
    if (exists[h])
      for (int j = from; j < to; ++j) d[h] += Z[(lane + 32 * h) * ZD + j] * turn[j];
  }
};
// the sum of the squares of a row's columns
auto square_from = [&](const double* row, int from, int to) {
  double even = 0.0, odd = 0.0;
  int j = from;
  for (; j + 1 < to; j += 2) even += row[j] * row[j], odd += row[j + 1] * row[j + 1];
  return j < to ? even + odd + row[j] * row[j] : even + odd;
};
// `turn` becomes the reflection that takes a row's columns from `at` on to that column; its strength
auto reflection_of = [&](const double* row, int at) {
  double square = 0.0;
  __syncwarp();
  for (int j = lane; j < N; j += 32) {
    turn[j] = j >= at && j < width ? row[j] : 0.0;
    square += turn[j] * turn[j];
  }
  const double norm = sqrt(sum(square));
  __syncwarp();
  const double head = turn[at];
  __syncwarp();
  if (lane == 0) turn[at] = head + (head < 0.0 ? -norm : norm);
  __syncwarp();
  return 1.0 / (norm * (norm + fabs(head)));
};
auto reflect = [&](double* row, int at, double weight) {  // a row of this lane
  double even = 0.0, odd = 0.0;
  int j = at;
  for (; j + 1 < width; j += 2) even += row[j] * turn[j], odd += row[j + 1] * turn[j + 1];
  if (j < width) even += row[j] * turn[j];
  const double by = weight * (even + odd);
  for (int i = at; i < width; ++i) row[i] -= by * turn[i];
};

// Cholesky factor of the first `count` rows of `square_of`, whose upper triangle with the diagonal is the matrix, plus
// `ridge` on the diagonal; the factor goes below, its diagonal's inverse to `inverse_of`
auto cholesky = [&](int count, double ridge) {
  for (int k = 0; k < count; ++k) {
    double value[G];
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int a = lane + 32 * g;
      value[g] = a >= k && a < count ? square_of[k * VD + a] + (a == k ? ridge : 0.0) : 0.0;
      if (a >= k && a < count)
        for (int j = 0; j < k; ++j) value[g] -= square_of[a * VD + j] * square_of[k * VD + j];
    }
    double mine = value[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? value[g] : mine;
    const double inverse = 1.0 / sqrt(fmax(__shfl_sync(ALL, mine, k & 31), 1e-300));
    __syncwarp();
#pragma unroll
    for (int g = 0; g < G; ++g)
      if (lane + 32 * g > k && lane + 32 * g < count) square_of[(lane + 32 * g) * VD + k] = value[g] * inverse;
    if (lane == 0) inverse_of[k] = inverse;
    __syncwarp();
  }
};
auto cholesky_solve = [&](int count, double* right) { // entry a of lane a % 32
  for (int k = 0; k < count; ++k) {
    double mine = right[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? right[g] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) * inverse_of[k];
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int a = lane + 32 * g;
      if (a == k) right[g] = y;
      if (a > k && a < count) right[g] -= square_of[a * VD + k] * y;
    }
  }
  for (int k = count - 1; k >= 0; --k) {
    double mine = right[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? right[g] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) * inverse_of[k];
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int a = lane + 32 * g;
      if (a == k) right[g] = y;
      if (a < k) right[g] -= square_of[k * VD + a] * y;
    }
  }
};

auto hold = [&]() {                                   // rotates the held rows to the front; lets go of dependent ones
  bool waits[H], row_waits = row_side != 0, some = row_waits;
#pragma unroll
  for (int h = 0; h < H; ++h) waits[h] = side[h] != 0, some = some || waits[h];
  held_count = 0;
  if (P) {
    for (int j = lane; j < width; j += 32)
      for (int q = 0; q < P; ++q) {
        double total = 0.0;
#pragma unroll 8
        for (int i = 0; i < N; ++i) total += A[i * ROWS + PLACE[q]] * Z[i * ZD + j];
        E[q * ZD + j] = total;
      }
    __syncwarp();
  }
  if (!any(some)) return;
  while (held_count < width) {
    double best = -1.0;
    int which = HARD;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (waits[h]) {
        const double square = square_from(Z + (lane + 32 * h) * ZD, held_count, width);
        if (square > best) best = square, which = lane + 32 * h;
      }
    if (P && row_waits) {
      double square = square_from(E + lane * ZD, held_count, width);
      square /= row_length > 0.0 ? row_length * row_length : 1.0;
      if (square > best) best = square, which = N + lane;
    }
    first_largest(best, which);
    if (!(best > rank_share * rank_share)) break;
    const double weight = reflection_of(which < N ? Z + which * ZD : E + (which - N) * ZD, held_count);
#pragma unroll
    for (int h = 0; h < H; ++h) {
      if (exists[h]) reflect(Z + (lane + 32 * h) * ZD, held_count, weight);
      if (is(h, which)) waits[h] = false;
    }
    if (has_row) {
      reflect(E + lane * ZD, held_count, weight);
      if (N + lane == which) row_waits = false;
    }
    if (lane == 0) held[held_count] = which;
    ++held_count;
    __syncwarp();
  }
#pragma unroll
  for (int h = 0; h < H; ++h) {
    if (waits[h]) side[h] = 0;
  }
  if (row_waits) row_side = 0;
  __syncwarp();
};

auto soften = [&]() {                                 // the squares of the factor's rows, and the damping
  for (int e = lane; e < rank * rank; e += 32) {
    const int k = e / rank, l = e % rank;
    if (l < k) continue;
    double total = 0.0;
    for (int j = held_count; j < width; ++j) total += R[k * ZD + j] * R[l * ZD + j];
    square_of[k * VD + l] = total;
  }
  __syncwarp();
  cholesky(rank, damping + 1e-14 * size * size);
};

// the rows of the level that are wanted, to V: entry i of row a at V[i * VD + a]
auto stage = [&](const bool* wanted) {
#pragma unroll
  for (int g = 0; g < G; ++g)
    if (in_level[g])
#pragma unroll 8
      for (int i = 0; i < N; ++i) V[i * VD + lane + 32 * g] = wanted[g] ? entry(lane + 32 * g, i) : 0.0;
  __syncwarp();
};
// these rows in columns of the basis, from one on, to R; squares of the columns
auto project = [&](int from, double* square) {
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

auto fit = [&]() {                                    // factors the rows that count, within what the held rows leave
  ++factorizations;
  double square[H];                                   // of a column, from row `rank` down
  bool waits[H];
#pragma unroll
  for (int h = 0; h < H; ++h) waits[h] = lane + 32 * h >= held_count && lane + 32 * h < width;
  stage(counts);
  project(held_count, square);
  const int most = width - held_count < m ? width - held_count : m;
  for (rank = 0; rank < most; ++rank) {
    double best = -1.0;
    int which = N;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (waits[h] && square[h] > best) best = square[h], which = lane + 32 * h;
    first_largest(best, which);
    const double norm = sqrt(best);
    if (!(norm > rank_share * size)) break;
    double* const v = V + rank * VD;
    const double head = R[rank * ZD + which], weight = 1.0 / (norm * (norm + fabs(head)));
    for (int a = lane; a < m; a += 32) {
      const double own = a >= rank ? R[a * ZD + which] : 0.0;
      v[a] = a == rank ? head + (head < 0.0 ? -norm : norm) : own;
    }
    if (lane == 0) strength[rank] = weight, pivot[rank] = which;
    __syncwarp();
#pragma unroll
    for (int h = 0; h < H; ++h) {
      const int j = lane + 32 * h;
      if (j < held_count || j >= width) continue;
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
      if (j == which) waits[h] = false;
    }
    __syncwarp();
  }
  if (damping > 0.0) soften();
};

// the step that makes the level's cost least; x has to be in `point`
auto least_squares = [&](const double* slack, double* d) {
  double right[G];
#pragma unroll
  for (int g = 0; g < G; ++g) right[g] = in_level[g] && counts[g] ? -slack[g] : 0.0;
  for (int k = 0; k < rank; ++k) {
    double total = 0.0;
#pragma unroll
    for (int g = 0; g < G; ++g) total += in_level[g] ? V[k * VD + lane + 32 * g] * right[g] : 0.0;
    total = sum(total) * strength[k];
#pragma unroll
    for (int g = 0; g < G; ++g) right[g] -= in_level[g] ? V[k * VD + lane + 32 * g] * total : 0.0;
  }
  if (damping > 0.0) {                                // x + d is in the row space of the factor, as its rows weigh it
    for (int j = lane; j < width; j += 32) {
      double total = 0.0;
      for (int i = 0; i < N; ++i) total += Z[i * ZD + j] * point[i];
      second_of[j] = j >= held_count ? total : 0.0;
    }
    __syncwarp();
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int k = lane + 32 * g;
      if (k >= rank) right[g] = 0.0;
      else
        for (int j = held_count; j < width; ++j) right[g] += R[k * ZD + j] * second_of[j];
    }
    cholesky_solve(rank, right);
    __syncwarp();
#pragma unroll
    for (int g = 0; g < G; ++g)
      if (lane + 32 * g < rank) first_of[lane + 32 * g] = right[g];
    __syncwarp();
    for (int j = lane; j < N; j += 32) {
      double total = 0.0;
      if (j >= held_count && j < width) {
        for (int k = 0; k < rank; ++k) total += R[k * ZD + j] * first_of[k];
        total -= second_of[j];
      }
      turn[j] = total;
    }
    __syncwarp();
    along(held_count, width, d);
    __syncwarp();
    return;
  }
  for (int j = lane; j < N; j += 32) turn[j] = 0.0;
  __syncwarp();
  for (int k = rank - 1; k >= 0; --k) {
    double mine = right[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? right[g] : mine;
    const double z = __shfl_sync(ALL, mine, k & 31) / R[k * ZD + pivot[k]];
#pragma unroll
    for (int g = 0; g < G; ++g)
      if (lane + 32 * g < k) right[g] -= R[(lane + 32 * g) * ZD + pivot[k]] * z;
    if (lane == 0) turn[pivot[k]] = z;
  }
  __syncwarp();
  along(held_count, width, d);
  __syncwarp();
};

auto restore = [&](double* d) {                       // the shortest step that brings held rows to their bounds
  share_out(x);
  double gap[H];
  if (P) {
    if (has_row) first_of[lane] = (row_side < 0 ? row_low : row_high) - hard_row_times(point);
    __syncwarp();
  }
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) second_of[lane + 32 * h] = (side[h] < 0 ? low[h] : high[h]) - x[h];
  __syncwarp();
#pragma unroll
  for (int h = 0; h < H; ++h) {
    const int k = lane + 32 * h;
    gap[h] = k < held_count ? held[k] < N ? second_of[held[k]] : first_of[held[k] - N] : 0.0;
  }
  for (int k = 0; k < held_count; ++k) {
    double mine = gap[0];
#pragma unroll
    for (int h = 1; h < H; ++h) mine = k >> 5 == h ? gap[h] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) / place_of(held[k], k);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h > k && lane + 32 * h < held_count) gap[h] -= place_of(held[lane + 32 * h], k) * y;
    if (lane == 0) turn[k] = y;
  }
  __syncwarp();
  along(0, held_count, d);
  __syncwarp();
};

double multiplier[H] = {}, downhill[H] = {}, row_multiplier = 0.0, steepness = 0.0, residual = 0.0;
auto judge = [&](const double* slack) {               // multipliers of the held rows, the gradient's norm, stationarity
#pragma unroll
  for (int g = 0; g < G; ++g)
    if (in_level[g]) first_of[lane + 32 * g] = counts[g] ? slack[g] : 0.0;
  __syncwarp();
  double gradient[H], square = 0.0;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    gradient[h] = 0.0;
    if (exists[h]) {
      gradient[h] = damping * x[h];
#pragma unroll 8
      for (int a = 0; a < m; ++a) gradient[h] += B[(lane + 32 * h) * ROWS + a] * first_of[a];
    }
    square += gradient[h] * gradient[h];
  }
  steepness = sqrt(sum(square));
  share_out(gradient);
  double pull[H], off = 0.0;                          // the way downhill, in the basis
#pragma unroll
  for (int h = 0; h < H; ++h) {
    const int j = lane + 32 * h;
    pull[h] = 0.0;
    if (j < width)
      for (int i = 0; i < N; ++i) pull[h] -= Z[i * ZD + j] * point[i];
    if (j >= held_count) off = fmax(off, fabs(pull[h]));
    downhill[h] = pull[h];
  }
  residual = largest(off);
  for (int k = held_count - 1; k >= 0; --k) {
    double mine = pull[0];
#pragma unroll
    for (int h = 1; h < H; ++h) mine = k >> 5 == h ? pull[h] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) / place_of(held[k], k);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h < k) pull[h] -= place_of(held[k], lane + 32 * h) * y;
    if (lane == 0) turn[k] = y;
  }
#pragma unroll
  for (int h = 0; h < H; ++h) multiplier[h] = 0.0;
  row_multiplier = 0.0;
  __syncwarp();
  for (int k = 0; k < held_count; ++k) {
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (is(h, held[k])) multiplier[h] = turn[k];
    if (N + lane == held[k]) row_multiplier = turn[k];
  }
  __syncwarp();
};

bool all_done = true;
double worst_residual = 0.0;
for (level = 0; level < LEVELS; ++level) {
  const size_t here = problem * LEVELS + level;
  m = COUNT[level], mixed = MIXED[level] != 0;
  B = A + OFFSET[level];
  if (width == 0) {                                   // nothing is left to decide
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (exists[h]) {
        sides.data[here * HARD + lane + 32 * h] = 0, tight_rows.data[here * HARD + lane + 32 * h] = 0;
        multipliers.data[here * HARD + lane + 32 * h] = 0.0;
      }
    if (has_row) {
      sides.data[here * HARD + N + lane] = 0, tight_rows.data[here * HARD + N + lane] = 0;
      multipliers.data[here * HARD + N + lane] = 0.0;
    }
    for (int a = lane; a < M; a += 32) missed_rows.data[here * M + a] = 0, own_rows.data[here * M + a] = 0;
    if (lane == 0) ranks.data[here] = 0, reached.data[here] = INFINITY, strengths.data[here] = 0.0;
    continue;
  }
#pragma unroll
  for (int g = 0; g < G; ++g) {
    const int a = lane + 32 * g;
    in_level[g] = a < m;
    below[g] = above[g] = length[g] = 0.0;
    equal[g] = counts[g] = false;
    if (in_level[g]) {
      const size_t at = problem * ROWS + OFFSET[level] + a;
      below[g] = rows_lower.data[at];
      above[g] = rows_upper.data[at];
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
  size = largest(size);
  const double longest = size * size;
  double rows_size = 0.0;                             // Frobenius norm
#pragma unroll
  for (int g = 0; g < G; ++g) rows_size += length[g] * length[g];
  rows_size = sqrt(sum(rows_size));

  // ---- its damping: the constant part, and the other by what a step by itself, clipped into the box, would miss
  const double* const given_damping = dampings.data + problem * (LEVELS * 3) + level;
  const double constant = given_damping[0], unmet = given_damping[LEVELS], demand = given_damping[2 * LEVELS];
  damping = constant;
  if (unmet > LEAST * longest) {
    double base[H], goal[G], d[H], squares[H], trace = 0.0, share = 1.0;
    bool all[G];
#pragma unroll
    for (int g = 0; g < G; ++g) all[g] = true;
    stage(all);
    auto distance = [&](int g) {                      // of row lane + 32 g from its interval, at `point`
      double at = 0.0;
#pragma unroll 4
      for (int i = 0; i < N; ++i) at += V[i * VD + lane + 32 * g] * point[i];
      return equal[g] ? at - below[g] : at - clip(at, below[g], above[g]);
    };
    share_out(x);
    for (int j = lane; j < N; j += 32) {
      double total = 0.0;
      if (j < width)
        for (int i = 0; i < N; ++i) total += Z[i * ZD + j] * point[i];
      turn[j] = total;
    }
    __syncwarp();
    along(0, width, d);
#pragma unroll
    for (int h = 0; h < H; ++h) base[h] = x[h] - d[h];
    share_out(base);
#pragma unroll
    for (int g = 0; g < G; ++g) {
      goal[g] = in_level[g] ? -distance(g) : 0.0;
      if (in_level[g]) second_of[lane + 32 * g] = equal[g] || goal[g] != 0.0 ? 1.0 : 0.0;
    }
    __syncwarp();
    project(0, squares);
    for (int j = lane; j < width; j += 32)
      for (int a = 0; a < m; ++a) rows_of[a * ZD + j] *= second_of[a];
    __syncwarp();
    for (int e = lane; e < m * m; e += 32) {
      const int a = e / m, b = e % m;
      if (b < a) continue;
      double total = 0.0;
      for (int j = 0; j < width; ++j) total += rows_of[a * ZD + j] * rows_of[b * ZD + j];
      square_of[a * VD + b] = total;
      if (b == a) trace += total;
    }
    trace = sum(trace);
    __syncwarp();
    double before = 0.0;                              // a share that a pass has not changed stays, and one that makes no damping
    for (int pass = 0; pass < PASSES && share != before && unmet * share > LEAST * longest; ++pass) {
      before = share;
      double y[G], missed = 0.0;
      const double ridge = constant + unmet * share + 1e-13 * trace;
      cholesky(m, ridge > 0.0 ? ridge : 1.0);
#pragma unroll
      for (int g = 0; g < G; ++g) y[g] = goal[g];
      cholesky_solve(m, y);
      __syncwarp();
#pragma unroll
      for (int g = 0; g < G; ++g)
        if (in_level[g]) second_of[lane + 32 * g] = y[g];
      __syncwarp();
      for (int j = lane; j < N; j += 32) {
        double total = 0.0;
        if (j < width)
          for (int a = 0; a < m; ++a) total += rows_of[a * ZD + j] * second_of[a];
        turn[j] = total;
      }
      __syncwarp();
      along(0, width, d);
#pragma unroll
      for (int h = 0; h < H; ++h) d[h] = exists[h] ? clip(base[h] + d[h], low[h], high[h]) : 0.0;
      share_out(d);
#pragma unroll
      for (int g = 0; g < G; ++g) {
        const double off = in_level[g] ? distance(g) : 0.0;
        missed += off * off;
      }
      share = fmin(sqrt(sum(missed)) / (demand > 0.0 ? demand : 1.0), 1.0);
    }
    damping = constant + unmet * share;
  }
  if (!(damping > LEAST * longest)) damping = 0.0;      // its slopes would be rounding
  size = fmax(size, sqrt(damping));

  double value[G], slack[G], reach = 0.0, missing = 0.0, missing_rows = 0.0;
  auto look = [&]() {                                 // where the level stands at x
    share_out(x);
    double far = 0.0, square = 0.0;
#pragma unroll
    for (int h = 0; h < H; ++h) far = fmax(far, exists[h] ? fabs(x[h]) : 0.0);
    reach = largest(far);
#pragma unroll
    for (int g = 0; g < G; ++g) {
      value[g] = in_level[g] ? row_times(lane + 32 * g, point) : 0.0;
      slack[g] = in_level[g] ? value[g] - clip(value[g], below[g], above[g]) : 0.0;
      if (equal[g]) slack[g] = value[g] - below[g];
      square += slack[g] * slack[g];
    }
    square = sum(square);
    missing_rows = sqrt(square);
    double own = 0.0;
#pragma unroll
    for (int h = 0; h < H; ++h) own += exists[h] ? x[h] * x[h] : 0.0;
    missing = sqrt(square + damping * sum(own));
  };
  auto wrong_by = [&](double force, int at, double longest) { return -force * at * longest; };
  auto noise = [&]() { return size * step_share * (size * reach + missing); };
  auto floor_of_signs = [&]() { return multiplier_share * steepness + noise(); };
  auto at_rest = [&]() { return residual <= 10.0 * (multiplier_share * size * missing + noise()); };

  // ---- the working set of the warm start, and what its landing shows to be wrong with it, all changed at once
  double start[H];
  int carried[H], row_carried = row_side;
  bool optimal = false, to_hold = true, to_fit = true;
#pragma unroll
  for (int h = 0; h < H; ++h) start[h] = x[h], carried[h] = side[h];
  if (warm) {
    int own[G];
    const bool row_counts = has_row && !row_frozen && row_level < level;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      int at = exists[h] ? guess_hard.data[here * HARD + lane + 32 * h] : 0;
      at = at > 0 ? 1 : at < 0 ? -1 : 0;
      side[h] = !frozen[h] && at != 0 && is_finite(at < 0 ? low[h] : high[h]) ? at : 0;
    }
    row_side = 0;
    if (row_counts) {
      int at = guess_hard.data[here * HARD + N + lane];
      at = at > 0 ? 1 : at < 0 ? -1 : 0;
      row_side = at != 0 && is_finite(at < 0 ? row_low : row_high) ? at : 0;
    }
#pragma unroll
    for (int g = 0; g < G; ++g) {
      int at = in_level[g] ? guess_own.data[here * M + lane + 32 * g] : 0;
      at = at > 0 ? 1 : at < 0 ? -1 : 0;
      if (!is_finite(at < 0 ? below[g] : above[g])) at = 0;
      own[g] = equal[g] ? 2 : at;
    }
    bool feasible = false;
    for (int attempt = 1;; ++attempt) {
      double goal[G], d[H];
#pragma unroll
      for (int g = 0; g < G; ++g) counts[g] = own[g] != 0, goal[g] = own[g] == 1 ? above[g] : below[g];
#pragma unroll
      for (int h = 0; h < H; ++h) x[h] = start[h];
      hold();
      fit();
      for (int round = 0; round < 2; ++round) {
        double off[G];
        restore(d);
#pragma unroll
        for (int h = 0; h < H; ++h) x[h] += d[h];
        share_out(x);
#pragma unroll
        for (int g = 0; g < G; ++g) off[g] = counts[g] ? row_times(lane + 32 * g, point) - goal[g] : 0.0;
        least_squares(off, d);
#pragma unroll
        for (int h = 0; h < H; ++h) x[h] += d[h];
      }
      look();
      double square = 0.0, at_row = 0.0;
      int better[G];                                  // how the rows of the level had better count
      bool fine = true;
#pragma unroll
      for (int g = 0; g < G; ++g) {
        better[g] = own[g];
        if (in_level[g]) {
          const double near = feasible_share * (length[g] * reach + fabs(value[g]));
          const double under = below[g] - value[g], over = value[g] - above[g];
          const bool right = own[g] == 2 || (own[g] == 0 ? fmax(under, over) <= near : (own[g] < 0 ? under : over) >= -near);
          if (!right) better[g] = own[g] != 0 ? 0 : under > over ? -1 : 1;
          fine = fine && right;
          slack[g] = counts[g] ? value[g] - goal[g] : 0.0;
          square += slack[g] * slack[g];
        }
      }
      double own_size = 0.0;
#pragma unroll
      for (int h = 0; h < H; ++h) own_size += exists[h] ? x[h] * x[h] : 0.0;
      missing = sqrt(sum(square) + damping * sum(own_size));
      if (has_row) at_row = hard_row_times(point);
      bool outside[H], row_outside = false, inside = true;
#pragma unroll
      for (int h = 0; h < H; ++h) {
        outside[h] = exists[h] && !frozen[h] && side[h] == 0 &&
                     !(fmax(low[h] - x[h], x[h] - high[h]) <= feasible_share * (reach + fabs(x[h])));
        inside = inside && !outside[h];
      }
      if (row_counts && row_side == 0) {
        row_outside =
            !(fmax(row_low - at_row, at_row - row_high) <= feasible_share * (row_length * reach + fabs(at_row)));
        inside = inside && !row_outside;
      }
      if (!is_finite(reach)) {
        feasible = false;
        break;
      }
      feasible = !any(!inside);
      judge(slack);
      const double floor = floor_of_signs();
      bool wrong[H], row_wrong = has_row && row_side != 0 && wrong_by(row_multiplier, row_side, row_length) > floor;
      bool good = fine && !row_wrong;
#pragma unroll
      for (int h = 0; h < H; ++h) {
        wrong[h] = side[h] != 0 && wrong_by(multiplier[h], side[h], 1.0) > floor;
        good = good && !wrong[h];
      }
      optimal = feasible && !any(!good) && at_rest();
      if (optimal || attempt == ATTEMPTS) break;
      int turned = 0;
#pragma unroll
      for (int h = 0; h < H; ++h) {
        if (outside[h]) side[h] = x[h] < low[h] ? -1 : 1;
        else if (wrong[h]) side[h] = 0;
        turned += __popc(__ballot_sync(ALL, outside[h] || wrong[h]));
      }
      if (row_outside) row_side = at_row < row_low ? -1 : 1;
      else if (row_wrong) row_side = 0;
      turned += __popc(__ballot_sync(ALL, row_outside || row_wrong));
#pragma unroll
      for (int g = 0; g < G; ++g) {
        turned += __popc(__ballot_sync(ALL, better[g] != own[g]));
        own[g] = better[g];
      }
      if (turned == 0) break;
      changes += turned;
    }
    if (feasible) to_hold = false, to_fit = false;
    else {
#pragma unroll
      for (int h = 0; h < H; ++h) x[h] = start[h], side[h] = carried[h];
      row_side = row_carried;
    }
  }

  // ---- by hand, from a feasible point
  int stalled = 0, rounds = 0;
  bool tried = false;                                 // what was too weak for the factor
  while (!optimal && rounds++ < most_changes) {
    look();
    if (to_hold) hold();
    bool turned = to_hold || to_fit;
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const bool now = in_level[g] && (equal[g] || slack[g] != 0.0);
      turned = turned || now != counts[g];
      counts[g] = now;
    }
    if (any(turned)) fit();
    to_hold = to_fit = false;
    double d[H], rate[G], square = 0.0;
    least_squares(slack, d);
    share_out(d);
#pragma unroll
    for (int g = 0; g < G; ++g) {
      rate[g] = in_level[g] ? row_times(lane + 32 * g, point) : 0.0;
      square += counts[g] ? rate[g] * rate[g] : 0.0;
    }
    double along_x = 0.0, along_d = 0.0;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (exists[h]) along_x += x[h] * d[h], along_d += d[h] * d[h];
    along_x = damping * sum(along_x), along_d = damping * sum(along_d);
    const bool stands = sqrt(sum(square) + along_d) <= step_share * (size * reach + missing);
    bool weak = false;
    if (stands) {
      judge(slack);
      weak = !tried && !at_rest();
    }
    if (weak) {                                       // a damped step along what the factor's tolerance left out
      tried = true;
#pragma unroll
      for (int h = 0; h < H; ++h)
        if (exists[h]) turn[lane + 32 * h] = downhill[h] / (DAMPING * size * size + damping);
      __syncwarp();
      along(held_count, width, d);
      share_out(d);
    } else if (stands) {
      const double floor = floor_of_signs();
      double worst = -1.0;
      int which = HARD;
#pragma unroll
      for (int h = 0; h < H; ++h) {
        const double by = wrong_by(multiplier[h], side[h], 1.0);
        if (side[h] != 0 && by > floor && (stalled > PATIENCE ? 1.0 : by) > worst)
          worst = stalled > PATIENCE ? 1.0 : by, which = lane + 32 * h;
      }
      if (has_row && row_side != 0) {
        const double by = wrong_by(row_multiplier, row_side, row_length);
        if (by > floor && (stalled > PATIENCE ? 1.0 : by) > worst) worst = stalled > PATIENCE ? 1.0 : by, which = N + lane;
      }
      first_largest(worst, which);
      optimal = worst < 0.0;
      if (optimal) break;
#pragma unroll
      for (int h = 0; h < H; ++h)
        if (is(h, which)) side[h] = 0;
      if (N + lane == which) row_side = 0;
      to_hold = true;
      ++changes;
      continue;
    }
    double far = 0.0, nearest = INFINITY;
    int blocks = HARD, towards = 0;
#pragma unroll
    for (int h = 0; h < H; ++h) far += exists[h] ? d[h] * d[h] : 0.0;
    const double stride = sqrt(sum(far));
#pragma unroll
    for (int h = 0; h < H; ++h) {
      if (!exists[h] || frozen[h] || side[h] != 0 || fabs(d[h]) <= rank_share * stride) continue;
      const double gap = (d[h] > 0.0 ? high[h] : low[h]) - x[h], time = fmax(gap / d[h], 0.0);
      if (time < nearest) nearest = time, blocks = lane + 32 * h, towards = d[h] > 0.0 ? 1 : -1;
    }
    if (P) {
      const double here_rate = has_row ? hard_row_times(point) : 0.0;
      share_out(x);
      if (has_row && !row_frozen && row_level < level && row_side == 0 &&
          fabs(here_rate) > rank_share * stride * row_length) {
        const double bound = here_rate > 0.0 ? row_high : row_low;
        const double time = is_finite(bound) ? fmax((bound - hard_row_times(point)) / here_rate, 0.0) : INFINITY;
        if (time < nearest) nearest = time, blocks = N + lane, towards = here_rate > 0.0 ? 1 : -1;
      }
    }
    double soonest = -nearest;
    first_largest(soonest, blocks);
    const double limit = -soonest;
    double ideal = 1.0;
    if (mixed && !weak) {                                      // an exact line search: rows enter and leave their intervals
      __syncwarp();
#pragma unroll
      for (int g = 0; g < G; ++g)
        if (in_level[g]) first_of[lane + 32 * g] = value[g], second_of[lane + 32 * g] = rate[g];
      __syncwarp();
      auto slope = [&](double t) {
        double total = along_x + t * along_d;
        for (int a = 0; a < m; ++a) {
          const size_t at = problem * ROWS + OFFSET[level] + a;
          const double v = first_of[a] + t * second_of[a];
          const bool same = rows_equal.data[at] != 0;
          total += second_of[a] * (v - (same ? rows_lower.data[at] : clip(v, rows_lower.data[at], rows_upper.data[at])));
        }
        return total;
      };
      double knot[2 * G + 1], before = 0.0, after = INFINITY;
#pragma unroll
      for (int g = 0; g < G; ++g) {
        const bool moving = in_level[g] && rate[g] != 0.0;
        knot[2 * g] = moving && is_finite(below[g]) ? fmax((below[g] - value[g]) / rate[g], 0.0) : 1.0;
        knot[2 * g + 1] = moving && is_finite(above[g]) ? fmax((above[g] - value[g]) / rate[g], 0.0) : 1.0;
      }
      knot[2 * G] = lane == 0 ? 0.0 : 1.0;
#pragma unroll
      for (int e = 0; e < 2 * G + 1; ++e)
        if (slope(knot[e]) < 0.0) before = fmax(before, knot[e]);
      before = largest(before);
#pragma unroll
      for (int e = 0; e < 2 * G + 1; ++e)
        if (knot[e] > before) after = fmin(after, knot[e]);
      after = -largest(-after);
      const double probe = is_finite(after) ? 0.5 * (before + after) : before + 1.0;
      const double at_first = slope(before), at_last = slope(probe);
      const bool rising = at_last > at_first;
      ideal = rising ? fmax(before - at_first * (probe - before) / (at_last - at_first), 0.0) : before;
    }
    const bool blocked = limit <= ideal;
    const double share = blocked ? limit : ideal;
    double moved = 0.0;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      if (exists[h]) x[h] += share * d[h], moved = fmax(moved, share * fabs(d[h]));
      if (blocked && is(h, blocks)) side[h] = towards;
    }
    if (blocked && N + lane == blocks) row_side = towards;
    stalled = largest(moved) > 0.0 ? 0 : stalled + 1;
    to_hold = blocked;
    tried = tried && !blocked;
    changes += blocked;
  }
  all_done = all_done && optimal;
  worst_residual = fmax(worst_residual, residual);

  // ---- what the level decides: rows that push, and its own that miss their intervals, are equalities from here on
  look();
  double far_x = 0.0;
#pragma unroll
  for (int h = 0; h < H; ++h) far_x += exists[h] ? x[h] * x[h] : 0.0;
  // a force that the damping explains leaves the levels below room on the face that the level has reached
  const double floor = floor_of_signs() + damping * sqrt(sum(far_x));
  bool same = true, all_tight = true, row_tight = has_row && row_side != 0 && fabs(row_multiplier) * row_length > floor;
  bool now_counts[G], is_tight[H];
#pragma unroll
  for (int g = 0; g < G; ++g) {
    const double small = multiplier_share * (length[g] * reach + missing);
    now_counts[g] = in_level[g] && (equal[g] || fabs(slack[g]) > small);
    same = same && now_counts[g] == counts[g];
  }
#pragma unroll
  for (int h = 0; h < H; ++h) {
    is_tight[h] = exists[h] && side[h] != 0 && fabs(multiplier[h]) > floor;
    all_tight = all_tight && is_tight[h] == (side[h] != 0);
  }
  all_tight = !any(!all_tight || row_tight != (row_side != 0));
  same = !any(!same);
  const int rank_there = rank;
  int ended[H], row_ended = row_side;
#pragma unroll
  for (int h = 0; h < H; ++h) ended[h] = side[h];
  if (!(same && all_tight)) {
#pragma unroll
    for (int h = 0; h < H; ++h) side[h] = is_tight[h] ? side[h] : 0;
    row_side = row_tight ? row_side : 0;
#pragma unroll
    for (int g = 0; g < G; ++g) counts[g] = now_counts[g];
    hold();
    fit();
  }
  const bool tie = same && rank != rank_there && damping == 0.0;

#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) {
      const size_t at = here * HARD + lane + 32 * h;
      sides.data[at] = ended[h];
      tight_rows.data[at] = is_tight[h] || tie ? ended[h] : 0;
      multipliers.data[at] = multiplier[h];
      box_label[h] = ended[h] != 0 ? ended[h] : frozen[h] ? box_label[h] : 0;
      frozen[h] = frozen[h] || is_tight[h];
      side[h] = is_tight[h] ? 0 : ended[h];
    }
#pragma unroll
  for (int g = 0; g < G; ++g) {
    const int a = lane + 32 * g;
    const int miss = now_counts[g] ? slack[g] > 0.0 ? 1 : -1 : 0;
    if (a < M) {
      missed_rows.data[here * M + a] = miss;
      own_rows.data[here * M + a] = equal[g] ? 2 : miss;
    }
    if (in_level[g]) flags[a] = now_counts[g];
  }
  __syncwarp();
  if (has_row) {
    const size_t at = here * HARD + N + lane;
    sides.data[at] = row_ended;
    tight_rows.data[at] = row_tight || tie ? row_ended : 0;
    multipliers.data[at] = row_multiplier;
    row_frozen = row_frozen || row_tight;
    row_side = row_tight ? 0 : row_ended;
    if (row_level == level) {
      const double at_x = hard_row_times(point);
      row_low = fmin(row_low, at_x), row_high = fmax(row_high, at_x);
      row_frozen = row_frozen || flags[PLACE[lane] - OFFSET[level]] != 0;
    }
  }
  if (lane == 0) ranks.data[here] = tie ? rank_there : rank, reached.data[here] = missing_rows, strengths.data[here] = damping;

  // ---- what the levels below may spend of its progress (room_below of _damping.py)
  {
    const double missed = fmin(missing_rows, demand);
    const bool narrows = unmet * (missed / (demand > 0.0 ? demand : 1.0)) > LEAST * longest;
    double cost[H], most = 0.0;
    int many = 0;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      const double bends_here = exists[h] ? bends.data[here * N + lane + 32 * h] : 0.0;
      bent[h] = fmax(bent[h], bends_here / (rows_size > 0.0 ? rows_size : 1.0));
      cost[h] = missed * rows_size * bent[h];
      most = fmax(most, cost[h]);
    }
    most = BENDS * largest(most);
#pragma unroll
    for (int h = 0; h < H; ++h) many += __popc(__ballot_sync(ALL, cost[h] > most));
    const double gain = SPENT * (demand - missed) * (demand + missed);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (narrows && cost[h] > most) {
        const double room = sqrt(gain / (many * cost[h])) + ROOM;
        low[h] = fmax(low[h], x[h] - room), high[h] = fmin(high[h], x[h] + room);
      }
  }

  // ---- and are cut off: the row space of the factor goes to the front, after what is tight
  {
    for (int k = 0; k < rank; ++k) {
      const int at = held_count + k;
      const double weight = reflection_of(R + k * ZD, at);
#pragma unroll
      for (int h = 0; h < H; ++h)
        if (exists[h]) reflect(Z + (lane + 32 * h) * ZD, at, weight);
      for (int row = lane; row < rank; row += 32)
        if (row > k) reflect(R + row * ZD, at, weight);
      __syncwarp();
    }
    const int gone = held_count + rank;
    width -= gone;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (exists[h]) {
        double* const row = Z + (lane + 32 * h) * ZD;
        for (int j = 0; j < width; ++j) row[j] = row[j + gone];
        for (int j = width; j < width + gone; ++j) row[j] = 0.0;
      }
    __syncwarp();
  }
}

#pragma unroll
for (int h = 0; h < H; ++h)
  if (exists[h]) {
    const size_t at = problem * HARD + lane + 32 * h;
    const bool narrowed = box_label[h] < 0 ? low[h] > hard_lower.data[at] : high[h] < hard_upper.data[at];
    solution.data[problem * N + lane + 32 * h] = x[h];
    box.data[problem * N + lane + 32 * h] = narrowed ? 0 : box_label[h];
  }
if (lane == 0) {
  residuals.data[problem] = worst_residual;
  report.data[problem * 3] = all_done;
  report.data[problem * 3 + 1] = changes;
  report.data[problem * 3 + 2] = factorizations;
}
