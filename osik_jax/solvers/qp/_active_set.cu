// Body of one function: a QP in a box, with soft rows, solved by one warp. _kernel.py names the arguments.
//
//     min 1/2 sum_r weight_r (A x - target)_r^2 + 1/2 sum_i damping_i (x_i - center_i)^2
//         + 1/2 sum_q t_q^2 / compliance_q
//     over lower <= [x; C x + t] <= upper
//
// Block pivoting: solve on the working set by a Cholesky factor and iterative refinement; violated bounds become
// active, those whose multiplier has the wrong sign inactive, all at once, until there are none (J. J. Judice, F. M. Pires, "A
// block principal pivoting algorithm for large-scale strictly monotone linear complementarity problems", 1994). Where
// that has ceased to reduce their number, the dual active-set method of Goldfarb and Idnani (GI, see
// _goldfarb_idnani.py) goes on from the working set. It cannot cycle: one constraint at a time, one factorisation each.
// An active soft row is a row of the cost.
//
// Variable i belongs to lane i % 32, in its slot i / 32. Constants from _kernel.py: N variables, M rows of the cost,
// P soft rows (at most 32), WARPS of a block.

constexpr int H = N > 32 ? 2 : 1;             // variables of a lane
constexpr int ROWS = M + P;
constexpr int NG = (N + 3) / 4;               // groups of four variables
constexpr int LD = 4 * (NG | 1);              // length of a row: an odd number of groups meets every bank
constexpr int PADDED_ROWS = (ROWS + 3) / 4 * 4;
constexpr int CONSTRAINTS = N + P;
constexpr unsigned ALL = 0xffffffffu;
constexpr int FREE = 0, AT_LOWER = -1, AT_UPPER = 1, EQUALITY = 2;
constexpr float RIDGE = 1.1920929e-7f;        // relative to the diagonal: machine epsilon
constexpr float LAST_CORRECTION = 1e-6f;      // relative to x: the correction that would come next
constexpr float FEASIBILITY_TOL = 10.f;       // in units of roundoff: a bound that is violated by less holds
constexpr float MIN_DECREASE = 0.25f;         // a correction that shrinks to more than this was roundoff
constexpr int MAX_REFINEMENTS = 6;
constexpr int MAX_FACTORIZATIONS = 100;
constexpr int MAX_STALLED = 2;                // exchanges that leave no fewer wrong labels, before the dual method

__shared__ float4 shared_rows[WARPS][(ROWS + 1) * LD / 4];
__shared__ float4 shared_inverse[WARPS][N * LD / 4];
__shared__ float4 shared_vectors[WARPS][(5 * LD + 3 * PADDED_ROWS + (P + 3) / 4 * 4) / 4];

const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
float* const S = (float*)shared_rows[warp];       // A, then C
float* const inverse_factor = (float*)shared_inverse[warp];    // L^-1, for the free variables
float* const columns = (float*)shared_vectors[warp];
float* const point = columns + 2 * LD;
float* const scaled_right = point + LD;
float* const work = scaled_right + LD;
float* const row_weights = work + LD;
float* const row_targets = row_weights + PADDED_ROWS;
float* const residuals = row_targets + PADDED_ROWS;
float* const row_values = residuals + PADDED_ROWS;

auto warp_max = [&](float a) {
  for (int distance = 16; distance; distance /= 2) a = fmaxf(a, __shfl_xor_sync(ALL, a, distance));
  return a;
};
auto dot = [&](const float* a, const float* b, int groups) {
  float4 sum = {0.f, 0.f, 0.f, 0.f};
#pragma unroll
  for (int g = 0; g < groups; ++g) {
    float4 u = ((const float4*)a)[g], v = ((const float4*)b)[g];
    sum.x += u.x * v.x, sum.y += u.y * v.y, sum.z += u.z * v.z, sum.w += u.w * v.w;
  }
  return (sum.x + sum.y) + (sum.z + sum.w);
};
auto dot_column = [&](const float* a, const float* b, int from, int to) {  // sum of a[k * LD] * b[k]; from is 0 or 32
  float4 sum = {0.f, 0.f, 0.f, 0.f};
  int k = from;
#pragma unroll 2
  for (; k + 4 <= to; k += 4) {
    float4 v = *(const float4*)(b + k);
    sum.x += a[k * LD] * v.x, sum.y += a[(k + 1) * LD] * v.y;
    sum.z += a[(k + 2) * LD] * v.z, sum.w += a[(k + 3) * LD] * v.w;
  }
#pragma unroll
  for (int e = 0; e < 3; ++e)
    if (k + e < to) sum.x += a[(k + e) * LD] * b[k + e];
  return (sum.x + sum.y) + (sum.z + sum.w);
};
auto solve = [&](const float* right, const float* unit, float* step) {  // with the Hessian of the free variables
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (lane + 32 * h < 4 * NG) scaled_right[lane + 32 * h] = unit[h] * right[h];
  __syncwarp();
#pragma unroll
  for (int h = 0; h < H; ++h) {
    int i = lane + 32 * h, groups = NG < 8 * (h + 1) ? NG : 8 * (h + 1);
    if (i < N) work[i] = dot(inverse_factor + i * LD, scaled_right, groups);
  }
  __syncwarp();
#pragma unroll
  for (int h = 0; h < H; ++h) {
    int i = lane + 32 * h;
    step[h] = unit[h] * dot_column(inverse_factor + (i < N ? i : N - 1), work, 32 * h, N);
  }
};
auto finite = [](float a) { return fabsf(a) <= 3.4e38f; };
auto nearest_bound = [&](float low, float high) {
  float near = fminf(finite(low) ? fabsf(low) : INFINITY, finite(high) ? fabsf(high) : INFINITY);
  return finite(near) ? near : 0.f;
};

// ---- the problem
const size_t problem = pid;
int index[H], label[H];
bool exists[H];
float low[H], high[H], damping_of[H], center_of[H], x[H];
#pragma unroll
for (int h = 0; h < H; ++h) {
  int i = lane + 32 * h;
  exists[h] = i < N;
  index[h] = exists[h] ? i : N - 1;
  low[h] = exists[h] ? lower.data[problem * CONSTRAINTS + i] : 0.f;
  high[h] = exists[h] ? upper.data[problem * CONSTRAINTS + i] : 0.f;
  damping_of[h] = exists[h] ? damping.data[problem * N + i] : 0.f;
  center_of[h] = exists[h] ? center.data[problem * N + i] : 0.f;
  label[h] = exists[h] ? guess.data[problem * CONSTRAINTS + i] : EQUALITY;
  x[h] = 0.f;
}
const bool has_row = lane < P;
float row_low = 0.f, row_high = 0.f, row_compliance = 1.f;
int row_label = FREE;
if (has_row) {
  row_low = lower.data[problem * CONSTRAINTS + N + lane];
  row_high = upper.data[problem * CONSTRAINTS + N + lane];
  row_compliance = compliance.data[problem * P + lane];
  row_label = row_low == row_high ? EQUALITY : guess.data[problem * CONSTRAINTS + N + lane];
}
const bool hard = __any_sync(ALL, has_row && row_compliance <= 0.f && (finite(row_low) || finite(row_high)));
const float relative_tol = tolerance.data[problem];

__syncwarp();
for (int e = lane; e < M * N; e += 32) S[e / N * LD + e % N] = matrix.data[problem * (M * N) + e];
for (int e = lane; e < P * N; e += 32) S[(M + e / N) * LD + e % N] = rows.data[problem * (P * N) + e];
for (int r = lane; r < ROWS; r += 32)
  for (int k = N; k < 4 * NG; ++k) S[r * LD + k] = 0.f;
for (int r = lane; r < M; r += 32) {
  row_weights[r] = weight.data[problem * M + r];
  row_targets[r] = target.data[problem * M + r];
}

int factorizations = 0, changes = 0, fewest_wrong = CONSTRAINTS + 1, patience = MAX_STALLED;
bool converged = false, use_dual = false;
int entering = -1;                            // the constraint that the dual method makes active, -1 for none
float entering_multiplier = 0.f;                           // its multiplier so far
float row_multiplier = 0.f;                         // multiplier of the lane's soft row
while (!hard && factorizations < MAX_FACTORIZATIONS && changes <= max_iterations) {
  if (has_row) {
    row_weights[M + lane] = row_label == FREE ? 0.f : 1.f / row_compliance;
    row_targets[M + lane] = row_label == FREE ? 0.f : row_label == AT_UPPER ? row_high : row_low;
  }
  __syncwarp();

  // ---- the Hessian: lane i has column i, and of column i + 32 the rows from 32 on; the rest of that is in the other
  // lanes, by symmetry
  float R[H][N], diagonal[H];
#pragma unroll
  for (int h = 0; h < H; ++h) {
    diagonal[h] = damping_of[h];
#pragma unroll
    for (int k = 32 * h; k < N; ++k) R[h][k] = 0.f;
  }
  for (int r = 0; r < ROWS; ++r) {
    if (row_weights[r] == 0.f) continue;
    float a[H];
#pragma unroll
    for (int h = 0; h < H; ++h) {
      float entry = S[r * LD + index[h]];
      a[h] = row_weights[r] * entry;
      diagonal[h] += a[h] * entry;
    }
#pragma unroll
    for (int g = 0; g < NG; ++g) {
      float4 v = ((const float4*)(S + r * LD))[g];
      float part[4] = {v.x, v.y, v.z, v.w};
#pragma unroll
      for (int e = 0; e < 4; ++e)
#pragma unroll
        for (int h = 0; h < H; ++h)
          if (32 * h <= 4 * g + e && 4 * g + e < N) R[h][4 * g + e] += a[h] * part[e];
    }
  }

  // ---- over the free variables, scaled to a diagonal of ones; the others get a row and column of the identity
  float root[H], unit[H];
#pragma unroll
  for (int h = 0; h < H; ++h) {
    root[h] = sqrtf(diagonal[h] > 0.f ? diagonal[h] : 1.f);
    unit[h] = exists[h] && label[h] == FREE ? 1.f / root[h] : 0.f;
    if (lane + 32 * h < 4 * NG) point[lane + 32 * h] = unit[h];
  }
  __syncwarp();
#pragma unroll
  for (int k = 0; k < N; ++k)
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (32 * h <= k) R[h][k] = lane + 32 * h == k ? 1.f + RIDGE : R[h][k] * unit[h] * point[k];

  // ---- L^-1 of its Cholesky factor L, in place. Before step j lane i >= j has column i of the Schur complement that
  // is left of the Hessian, lane i < j column i of the identity as far as L has been solved for
#pragma unroll
  for (int j = 0; j < N; ++j) {
    float inverse = rsqrtf(__shfl_sync(ALL, R[j >> 5][j], j & 31));
    float* column = columns + (j & 1) * LD;
    float c[H];
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (32 * h <= j) {
        c[h] = R[h][j] * inverse;
        if (exists[h]) column[index[h]] = c[h];
        bool at = lane + 32 * h == j;
        R[h][j] = at ? inverse : c[h];
        c[h] += at ? inverse : 0.f;  // lane j: its column of L, and the first step of its column of the identity
      }
    if (j < 32 && lane == j)
#pragma unroll
      for (int k = 32; k < N; ++k) column[k] = R[0][k] * inverse;
    __syncwarp();
    if (H > 1 && j < 32) c[H - 1] = column[index[H - 1]];
#pragma unroll
    for (int g = (j + 1) / 4; g < NG; ++g) {
      float4 v = ((const float4*)column)[g];
      float part[4] = {v.x, v.y, v.z, v.w};
#pragma unroll
      for (int e = 0; e < 4; ++e)
        if (4 * g + e > j && 4 * g + e < N)
#pragma unroll
          for (int h = 0; h < H; ++h)
            if (32 * h <= 4 * g + e) R[h][4 * g + e] -= part[e] * c[h];
    }
  }
  __syncwarp();
#pragma unroll
  for (int k = 0; k < N; ++k)
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h < 4 * NG) {
        float entry = 32 * h <= k ? R[h][k] : 0.f;
        inverse_factor[k * LD + lane + 32 * h] = lane + 32 * h <= k ? entry : 0.f;
      }
  ++factorizations;

  // ---- x: active bounds, then iterative refinement against residuals of A itself
  float gradient[H], relative = INFINITY, last_relative = INFINITY;
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (label[h] != FREE) x[h] = label[h] == AT_UPPER ? high[h] : low[h];
  for (int round = 0;; ++round) {
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h < 4 * NG) point[lane + 32 * h] = x[h];
    __syncwarp();
    for (int r = lane; r < ROWS; r += 32) {
      float value = dot(S + r * LD, point, NG);
      residuals[r] = r >= M && r - M + N == entering ? entering_multiplier : row_weights[r] * (row_targets[r] - value);
      if (r >= M) row_values[r - M] = value;
    }
    __syncwarp();
#pragma unroll
    for (int h = 0; h < H; ++h) {
      gradient[h] = dot_column(S + index[h], residuals, 0, ROWS) - damping_of[h] * (x[h] - center_of[h]);
      if (lane + 32 * h == entering) gradient[h] += entering_multiplier;
      if (!exists[h]) gradient[h] = 0.f;
    }
    bool enough = relative * relative <= LAST_CORRECTION * last_relative || relative > MIN_DECREASE * last_relative;
    if (round == MAX_REFINEMENTS || (round > 1 && enough)) break;
    last_relative = relative;
    float step[H], step_size = 0.f, x_size = 0.f;
    solve(gradient, unit, step);
#pragma unroll
    for (int h = 0; h < H; ++h) {
      x[h] += step[h];
      step_size = fmaxf(step_size, fabsf(step[h] * root[h]));
      x_size = fmaxf(x_size, fabsf(x[h] * root[h]));
    }
    relative = warp_max(step_size) / fmaxf(warp_max(x_size), 1e-37f);
  }

  // ---- labels that are wrong: violated constraints that are inactive, multipliers of the wrong sign
  float x_size = 0.f, x_max = 0.f;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    x_size = fmaxf(x_size, fabsf(x[h] * root[h]));
    x_max = fmaxf(x_max, fabsf(x[h]));
    if (lane + 32 * h < 4 * NG) work[lane + 32 * h] = exists[h] ? 1.f / root[h] : 0.f;
  }
  x_size = warp_max(x_size), x_max = warp_max(x_max);
  __syncwarp();
  int next[H], next_row_label = row_label, wrong_count = 0;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    float roundoff = relative_tol * (fminf(x_size / root[h], x_max) + fabsf(x[h]) + nearest_bound(low[h], high[h]));
    float multiplier_tol = roundoff * root[h] * root[h], violation_tol = FEASIBILITY_TOL * roundoff;
    next[h] = label[h];
    if (label[h] == FREE)
      next[h] = x[h] < low[h] - violation_tol ? AT_LOWER : x[h] > high[h] + violation_tol ? AT_UPPER : FREE;
    if (label[h] == AT_LOWER && gradient[h] > multiplier_tol) next[h] = FREE;
    if (label[h] == AT_UPPER && gradient[h] < -multiplier_tol) next[h] = FREE;
    wrong_count += __popc(__ballot_sync(ALL, next[h] != label[h]));
  }
  row_multiplier = 0.f;
  float row_gain = -1.f;
  if (has_row) {
    float row_reach = 0.f, row_sum = 0.f, value = row_values[lane];
    for (int k = 0; k < N; ++k) {
      float a = fabsf(S[(M + lane) * LD + k]);
      row_reach += a * work[k], row_sum += a;
    }
    float scale = fminf(x_size * row_reach, x_max * row_sum) + fabsf(value) + nearest_bound(row_low, row_high);
    float roundoff = relative_tol * scale;
    float multiplier_tol = roundoff / fmaxf(row_reach * row_reach, 1e-37f), violation_tol = FEASIBILITY_TOL * roundoff;
    if (row_label == FREE)
      next_row_label = value < row_low - violation_tol ? AT_LOWER : value > row_high + violation_tol ? AT_UPPER : FREE;
    else
      row_multiplier = row_weights[M + lane] * (row_targets[M + lane] - value);
    if (row_label == AT_LOWER && row_multiplier < -multiplier_tol) next_row_label = FREE;
    if (row_label == AT_UPPER && row_multiplier > multiplier_tol) next_row_label = FREE;
    float gap = fmaxf(row_low - value, value - row_high);
    if (row_label == FREE && next_row_label != FREE) row_gain = gap * gap / (row_compliance + row_reach * row_reach);
  }
  wrong_count += __popc(__ballot_sync(ALL, next_row_label != row_label));
  converged = wrong_count == 0 && entering < 0;
  patience = wrong_count < fewest_wrong ? MAX_STALLED : patience - 1;
  fewest_wrong = wrong_count < fewest_wrong ? wrong_count : fewest_wrong;
  use_dual = use_dual || patience < 0;
  if (converged) break;
  bool releases = has_row && row_label != FREE && next_row_label == FREE;
#pragma unroll
  for (int h = 0; h < H; ++h) releases = releases || (label[h] != FREE && next[h] == FREE);
  bool drops = entering < 0 && __any_sync(ALL, releases);
  if (!use_dual || drops) {  // all at once; the dual method first drops wrong multipliers, as its start requires
#pragma unroll
    for (int h = 0; h < H; ++h) {
      bool changes_label = next[h] != label[h] && (!use_dual || next[h] == FREE);
      changes += __popc(__ballot_sync(ALL, changes_label));
      if (changes_label) label[h] = next[h];
    }
    bool changes_label = next_row_label != row_label && (!use_dual || next_row_label == FREE);
    changes += __popc(__ballot_sync(ALL, changes_label));
    if (changes_label) row_label = next_row_label;
    continue;
  }

  // ---- a dual step (GI, step 1): the violated constraint whose activation raises the dual objective most enters
  if (entering < 0) {
    float gain = row_gain;
    int which = N + lane;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      float inverse = 0.f;
      for (int k = 32 * h; k < N; ++k) inverse += inverse_factor[k * LD + index[h]] * inverse_factor[k * LD + index[h]];
      float gap = fmaxf(low[h] - x[h], x[h] - high[h]);
      float own_gain = gap * gap / fmaxf(inverse * unit[h] * unit[h], 1e-37f);
      if (label[h] == FREE && next[h] != FREE && own_gain > gain) gain = own_gain, which = lane + 32 * h;
    }
    unsigned first = __ballot_sync(ALL, gain == warp_max(gain));
    entering = __shfl_sync(ALL, which, __ffs(first) - 1);
    entering_multiplier = 0.f;
  }
  // GI, step 2a: x moves along the primal direction H^-1 normal, the multipliers of the active constraints with it
  const int entering_lane = entering < N ? entering & 31 : entering - N;
  const int entering_slot = entering < N ? entering >> 5 : -1;  // -1 for a row
  float normal[H], direction[H], rate[H];
#pragma unroll
  for (int h = 0; h < H; ++h)
    normal[h] = !exists[h]          ? 0.f
                : entering_slot < 0 ? S[(M + entering_lane) * LD + index[h]]
                                    : lane + 32 * h == entering ? 1.f : 0.f;
  solve(normal, unit, direction);
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (lane + 32 * h < 4 * NG) point[lane + 32 * h] = direction[h];
  float value = has_row ? row_values[lane] : 0.f;
  __syncwarp();
  for (int r = lane; r < ROWS; r += 32) {
    float change = dot(S + r * LD, point, NG);
    residuals[r] = row_weights[r] * change;
    if (r >= M) row_values[r - M] = change;
  }
  __syncwarp();
  float gap_low = row_low - value - row_compliance * entering_multiplier;
  float gap_high = value + row_compliance * entering_multiplier - row_high;
  float gain = row_compliance + (has_row ? row_values[lane] : 0.f);
#pragma unroll
  for (int h = 0; h < H; ++h) {
    rate[h] = dot_column(S + index[h], residuals, 0, ROWS) + damping_of[h] * direction[h] - normal[h];
    if (entering_slot == h) gap_low = low[h] - x[h], gap_high = x[h] - high[h], gain = direction[h];
  }
  gap_low = __shfl_sync(ALL, gap_low, entering_lane), gap_high = __shfl_sync(ALL, gap_high, entering_lane);
  gain = __shfl_sync(ALL, gain, entering_lane);
  const float sign_of_bound = entering_multiplier > 0.f   ? 1.f
                              : entering_multiplier < 0.f ? -1.f
                                                          : gap_low > gap_high ? 1.f : -1.f;
  // GI, step 2b: the full step makes the entering constraint hold, the partial step takes a multiplier to 0
  const float full_step = fmaxf(sign_of_bound > 0.f ? gap_low : gap_high, 0.f) / fmaxf(gain, 1e-37f);
  float shortest_step = INFINITY;
  int leaving = -1;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    float sign = label[h] == AT_LOWER ? 1.f : label[h] == AT_UPPER ? -1.f : 0.f;
    float decrease = -sign * sign_of_bound * rate[h], length = fmaxf(-sign * gradient[h], 0.f) / decrease;
    if (exists[h] && decrease > 0.f && length < shortest_step) shortest_step = length, leaving = lane + 32 * h;
  }
  if (has_row) {
    float sign = row_label == AT_LOWER ? 1.f : row_label == AT_UPPER ? -1.f : 0.f;
    float decrease = sign * sign_of_bound * residuals[M + lane], length = fmaxf(sign * row_multiplier, 0.f) / decrease;
    if (decrease > 0.f && length < shortest_step) shortest_step = length, leaving = N + lane;
  }
  const float length = -warp_max(-shortest_step);
  ++changes;
  if (full_step <= length) {  // GI, step 2c: the full step, the constraint becomes active
    int new_label = sign_of_bound > 0.f ? AT_LOWER : AT_UPPER;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h == entering) label[h] = new_label;
    if (has_row && N + lane == entering) row_label = new_label;
    entering = -1, entering_multiplier = 0.f;
  } else {                    // the partial step, the blocking constraint becomes inactive
    unsigned first = __ballot_sync(ALL, shortest_step == length);
    leaving = __shfl_sync(ALL, leaving, __ffs(first) - 1);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h == leaving) label[h] = FREE;
    if (has_row && N + lane == leaving) row_label = FREE;
    entering_multiplier += sign_of_bound * length;
  }
}

// ---- the answer
#pragma unroll
for (int h = 0; h < H; ++h)
  if (exists[h]) {
    solution.data[problem * N + index[h]] = x[h];
    active.data[problem * CONSTRAINTS + index[h]] = label[h];
  }
if (has_row) {
  row_multipliers.data[problem * P + lane] = row_multiplier;
  active.data[problem * CONSTRAINTS + N + lane] = row_label;
}
if (lane == 0) {
  report.data[problem * 3] = converged;
  report.data[problem * 3 + 1] = changes;
  report.data[problem * 3 + 2] = factorizations;
}
