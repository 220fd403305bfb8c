// Body of one function: a QP in a box, with soft rows, solved by the warp that calls it. _kernel.py names the arguments.
//
//     min 1/2 sum_r weight_r (A x - target)_r^2 + 1/2 sum_i damping_i (x_i - center_i)^2 + 1/2 sum_q t_q^2 / compliance_q
//     over lower <= [x; C x + t] <= upper
//
// Guess an active set, factor, solve, refine, look: bounds that are crossed become active, bounds whose multiplier has
// the wrong sign become inactive, all at once, until none is left. Where several such exchanges have not left fewer, the
// dual method goes on from there (Goldfarb and Idnani, as in _pivots.py), which does not cycle: one constraint at a time, a
// factorization each. A soft row that is active is a row of the cost.
//
// Variable i belongs to lane i % 32. Constants from _kernel.py: N variables, M rows of the cost, P soft rows (at most
// 32), WARPS a block.

constexpr int H = N > 32 ? 2 : 1;             // variables a lane
constexpr int ROWS = M + P;
constexpr int NG = (N + 3) / 4;               // groups of four variables
constexpr int LD = 4 * (NG | 1);              // lengths of rows: an odd number of groups meets every bank
constexpr int TALL = (ROWS + 3) / 4 * 4;
constexpr int CONSTRAINTS = N + P;
constexpr unsigned ALL = 0xffffffffu;
constexpr int FREE = 0, AT_LOWER = -1, AT_UPPER = 1, EQUALITY = 2;
constexpr float RIDGE = 1.1920929e-7f;        // of the diagonal: one rounding
constexpr float LAST_CORRECTION = 1e-6f;      // as a share of x: of the one that would come next
constexpr float NEARLY = 10.f;                // roundings; a bound crossed by less holds
constexpr float WORTH = 0.25f;                // a correction that shrinks less than to this share was rounding
constexpr int MOST_CORRECTIONS = 6;
constexpr int MOST_FACTORIZATIONS = 100;
constexpr int PATIENCE = 2;                   // exchanges that do not help, before the dual method

__shared__ float4 rows_of[WARPS][(ROWS + 1) * LD / 4];
__shared__ float4 half_of[WARPS][N * LD / 4];
__shared__ float4 vectors_of[WARPS][(5 * LD + 3 * TALL + (P + 3) / 4 * 4) / 4];

const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
float* const S = (float*)rows_of[warp];       // A, then C
float* const half = (float*)half_of[warp];    // L^-1, for the free variables
float* const columns = (float*)vectors_of[warp];
float* const point = columns + 2 * LD;
float* const right_side = point + LD;
float* const middle = right_side + LD;
float* const weights = middle + LD;
float* const targets = weights + TALL;
float* const residuals = targets + TALL;
float* const row_values = residuals + TALL;

auto largest = [&](float a) {
  for (int far = 16; far; far /= 2) a = fmaxf(a, __shfl_xor_sync(ALL, a, far));
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
auto across = [&](const float* a, const float* b, int from, int to) {  // sum of a[k * LD] * b[k]; from is 0 or 32
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
    if (lane + 32 * h < 4 * NG) right_side[lane + 32 * h] = unit[h] * right[h];
  __syncwarp();
#pragma unroll
  for (int h = 0; h < H; ++h) {
    int i = lane + 32 * h, groups = NG < 8 * (h + 1) ? NG : 8 * (h + 1);
    if (i < N) middle[i] = dot(half + i * LD, right_side, groups);
  }
  __syncwarp();
#pragma unroll
  for (int h = 0; h < H; ++h) {
    int i = lane + 32 * h;
    step[h] = unit[h] * across(half + (i < N ? i : N - 1), middle, 32 * h, N);
  }
};
auto finite = [](float a) { return fabsf(a) <= 3.4e38f; };
auto nearest_bound = [&](float low, float high) {
  float near = fminf(finite(low) ? fabsf(low) : INFINITY, finite(high) ? fabsf(high) : INFINITY);
  return finite(near) ? near : 0.f;
};

// ---- the problem
const size_t problem = pid;
int index[H], state[H];
bool exists[H];
float low[H], high[H], damp[H], rest[H], x[H];
#pragma unroll
for (int h = 0; h < H; ++h) {
  int i = lane + 32 * h;
  exists[h] = i < N;
  index[h] = exists[h] ? i : N - 1;
  low[h] = exists[h] ? lower.data[problem * CONSTRAINTS + i] : 0.f;
  high[h] = exists[h] ? upper.data[problem * CONSTRAINTS + i] : 0.f;
  damp[h] = exists[h] ? damping.data[problem * N + i] : 0.f;
  rest[h] = exists[h] ? center.data[problem * N + i] : 0.f;
  state[h] = exists[h] ? guess.data[problem * CONSTRAINTS + i] : EQUALITY;
  x[h] = 0.f;
}
const bool has_row = lane < P;
float row_low = 0.f, row_high = 0.f, gives = 1.f;
int row_state = FREE;
if (has_row) {
  row_low = lower.data[problem * CONSTRAINTS + N + lane];
  row_high = upper.data[problem * CONSTRAINTS + N + lane];
  gives = compliance.data[problem * P + lane];
  row_state = row_low == row_high ? EQUALITY : guess.data[problem * CONSTRAINTS + N + lane];
}
const bool hard = __any_sync(ALL, has_row && gives <= 0.f && (finite(row_low) || finite(row_high)));
const float noise = tolerance.data[problem];

__syncwarp();
for (int e = lane; e < M * N; e += 32) S[e / N * LD + e % N] = matrix.data[problem * (M * N) + e];
for (int e = lane; e < P * N; e += 32) S[(M + e / N) * LD + e % N] = rows.data[problem * (P * N) + e];
for (int r = lane; r < ROWS; r += 32)
  for (int k = N; k < 4 * NG; ++k) S[r * LD + k] = 0.f;
for (int r = lane; r < M; r += 32) {
  weights[r] = weight.data[problem * M + r];
  targets[r] = target.data[problem * M + r];
}

int factorizations = 0, changes = 0, best = CONSTRAINTS + 1, lives = PATIENCE;
bool settled = false, dual = false;
int entering = -1;                            // the constraint that the dual method is making active, -1 for none
float pushed = 0.f;                           // its multiplier so far
float row_push = 0.f;                         // multiplier of the lane's row
while (!hard && factorizations < MOST_FACTORIZATIONS && changes <= most_changes) {
  if (has_row) {
    weights[M + lane] = row_state == FREE ? 0.f : 1.f / gives;
    targets[M + lane] = row_state == FREE ? 0.f : row_state == AT_UPPER ? row_high : row_low;
  }
  __syncwarp();

  // ---- the Hessian: lane i has column i, and of column i + 32 the rows from 32 on; the rest of that is in the other
  // lanes, by symmetry
  float R[H][N], own[H];
#pragma unroll
  for (int h = 0; h < H; ++h) {
    own[h] = damp[h];
#pragma unroll
    for (int k = 32 * h; k < N; ++k) R[h][k] = 0.f;
  }
  for (int r = 0; r < ROWS; ++r) {
    if (weights[r] == 0.f) continue;
    float a[H];
#pragma unroll
    for (int h = 0; h < H; ++h) {
      float entry = S[r * LD + index[h]];
      a[h] = weights[r] * entry;
      own[h] += a[h] * entry;
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

  // ---- of the free variables, in units that make its diagonal ones; the others get the identity
  float root[H], unit[H];
#pragma unroll
  for (int h = 0; h < H; ++h) {
    root[h] = sqrtf(own[h] > 0.f ? own[h] : 1.f);
    unit[h] = exists[h] && state[h] == FREE ? 1.f / root[h] : 0.f;
    if (lane + 32 * h < 4 * NG) point[lane + 32 * h] = unit[h];
  }
  __syncwarp();
#pragma unroll
  for (int k = 0; k < N; ++k)
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (32 * h <= k) R[h][k] = lane + 32 * h == k ? 1.f + RIDGE : R[h][k] * unit[h] * point[k];

  // ---- its factor's inverse, in place. Before step j lane i >= j has column i of what is left of the Hessian, lane
  // i < j column i of the identity as far as it has been solved for
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
        c[h] += at ? inverse : 0.f;  // lane j: what is left of its column, and at once the first step of its identity
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
        half[k * LD + lane + 32 * h] = lane + 32 * h <= k ? entry : 0.f;
      }
  ++factorizations;

  // ---- x: bounds where active, zeros to begin with, corrections against residuals of A itself
  float slope[H], share = INFINITY, before = INFINITY;
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (state[h] != FREE) x[h] = state[h] == AT_UPPER ? high[h] : low[h];
  for (int round = 0;; ++round) {
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h < 4 * NG) point[lane + 32 * h] = x[h];
    __syncwarp();
    for (int r = lane; r < ROWS; r += 32) {
      float value = dot(S + r * LD, point, NG);
      residuals[r] = r >= M && r - M + N == entering ? pushed : weights[r] * (targets[r] - value);
      if (r >= M) row_values[r - M] = value;
    }
    __syncwarp();
#pragma unroll
    for (int h = 0; h < H; ++h) {
      slope[h] = across(S + index[h], residuals, 0, ROWS) - damp[h] * (x[h] - rest[h]);
      if (lane + 32 * h == entering) slope[h] += pushed;
      if (!exists[h]) slope[h] = 0.f;
    }
    bool enough = share * share <= LAST_CORRECTION * before || share > WORTH * before;
    if (round == MOST_CORRECTIONS || (round > 1 && enough)) break;
    before = share;
    float step[H], moved = 0.f, far = 0.f;
    solve(slope, unit, step);
#pragma unroll
    for (int h = 0; h < H; ++h) {
      x[h] += step[h];
      moved = fmaxf(moved, fabsf(step[h] * root[h]));
      far = fmaxf(far, fabsf(x[h] * root[h]));
    }
    share = largest(moved) / fmaxf(largest(far), 1e-37f);
  }

  // ---- what has to change
  float far = 0.f, long_ = 0.f;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    far = fmaxf(far, fabsf(x[h] * root[h]));
    long_ = fmaxf(long_, fabsf(x[h]));
    if (lane + 32 * h < 4 * NG) middle[lane + 32 * h] = exists[h] ? 1.f / root[h] : 0.f;
  }
  far = largest(far), long_ = largest(long_);
  __syncwarp();
  int next[H], next_row = row_state, wrong = 0;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    float rounding = noise * (fminf(far / root[h], long_) + fabsf(x[h]) + nearest_bound(low[h], high[h]));
    float pull = rounding * root[h] * root[h], crossed = NEARLY * rounding;
    next[h] = state[h];
    if (state[h] == FREE) next[h] = x[h] < low[h] - crossed ? AT_LOWER : x[h] > high[h] + crossed ? AT_UPPER : FREE;
    if (state[h] == AT_LOWER && slope[h] > pull) next[h] = FREE;
    if (state[h] == AT_UPPER && slope[h] < -pull) next[h] = FREE;
    wrong += __popc(__ballot_sync(ALL, next[h] != state[h]));
  }
  row_push = 0.f;
  float row_gain = -1.f;
  if (has_row) {
    float reach = 0.f, span = 0.f, value = row_values[lane];
    for (int k = 0; k < N; ++k) {
      float a = fabsf(S[(M + lane) * LD + k]);
      reach += a * middle[k], span += a;
    }
    float rounding = noise * (fminf(far * reach, long_ * span) + fabsf(value) + nearest_bound(row_low, row_high));
    float pull = rounding / fmaxf(reach * reach, 1e-37f), crossed = NEARLY * rounding;
    if (row_state == FREE)
      next_row = value < row_low - crossed ? AT_LOWER : value > row_high + crossed ? AT_UPPER : FREE;
    else
      row_push = weights[M + lane] * (targets[M + lane] - value);
    if (row_state == AT_LOWER && row_push < -pull) next_row = FREE;
    if (row_state == AT_UPPER && row_push > pull) next_row = FREE;
    float gap = fmaxf(row_low - value, value - row_high);
    if (row_state == FREE && next_row != FREE) row_gain = gap * gap / (gives + reach * reach);
  }
  wrong += __popc(__ballot_sync(ALL, next_row != row_state));
  settled = wrong == 0 && entering < 0;
  lives = wrong < best ? PATIENCE : lives - 1;
  best = wrong < best ? wrong : best;
  dual = dual || lives < 0;
  if (settled) break;
  bool frees = has_row && row_state != FREE && next_row == FREE;
#pragma unroll
  for (int h = 0; h < H; ++h) frees = frees || (state[h] != FREE && next[h] == FREE);
  bool drops = entering < 0 && __any_sync(ALL, frees);
  if (!dual || drops) {  // all at once; the dual method begins with what has to become inactive
#pragma unroll
    for (int h = 0; h < H; ++h) {
      bool takes = next[h] != state[h] && (!dual || next[h] == FREE);
      changes += __popc(__ballot_sync(ALL, takes));
      if (takes) state[h] = next[h];
    }
    bool takes = next_row != row_state && (!dual || next_row == FREE);
    changes += __popc(__ballot_sync(ALL, takes));
    if (takes) row_state = next_row;
    continue;
  }

  // ---- one step of the dual method. Which constraint: the one whose activation would raise the dual objective most
  if (entering < 0) {
    float gain = row_gain;
    int which = N + lane;
#pragma unroll
    for (int h = 0; h < H; ++h) {
      float inverse = 0.f;
      for (int k = 32 * h; k < N; ++k) inverse += half[k * LD + index[h]] * half[k * LD + index[h]];
      float gap = fmaxf(low[h] - x[h], x[h] - high[h]);
      float own_gain = gap * gap / fmaxf(inverse * unit[h] * unit[h], 1e-37f);
      if (state[h] == FREE && next[h] != FREE && own_gain > gain) gain = own_gain, which = lane + 32 * h;
    }
    unsigned first = __ballot_sync(ALL, gain == largest(gain));
    entering = __shfl_sync(ALL, which, __ffs(first) - 1);
    pushed = 0.f;
  }
  // which way and how far: to x + length side ahead, and the multipliers of the active constraints with it
  const int place = entering < N ? entering & 31 : entering - N, part = entering < N ? entering >> 5 : -1;
  float along[H], ahead[H], rate[H];
#pragma unroll
  for (int h = 0; h < H; ++h)
    along[h] = !exists[h] ? 0.f : part < 0 ? S[(M + place) * LD + index[h]] : lane + 32 * h == entering ? 1.f : 0.f;
  solve(along, unit, ahead);
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (lane + 32 * h < 4 * NG) point[lane + 32 * h] = ahead[h];
  float value = has_row ? row_values[lane] : 0.f;
  __syncwarp();
  for (int r = lane; r < ROWS; r += 32) {
    float change = dot(S + r * LD, point, NG);
    residuals[r] = weights[r] * change;
    if (r >= M) row_values[r - M] = change;
  }
  __syncwarp();
  float gap_low = row_low - value - gives * pushed, gap_high = value + gives * pushed - row_high;
  float gain = gives + (has_row ? row_values[lane] : 0.f);
#pragma unroll
  for (int h = 0; h < H; ++h) {
    rate[h] = across(S + index[h], residuals, 0, ROWS) + damp[h] * ahead[h] - along[h];
    if (part == h) gap_low = low[h] - x[h], gap_high = x[h] - high[h], gain = ahead[h];
  }
  gap_low = __shfl_sync(ALL, gap_low, place), gap_high = __shfl_sync(ALL, gap_high, place);
  gain = __shfl_sync(ALL, gain, place);
  const float side = pushed > 0.f ? 1.f : pushed < 0.f ? -1.f : gap_low > gap_high ? 1.f : -1.f;
  const float full = fmaxf(side > 0.f ? gap_low : gap_high, 0.f) / fmaxf(gain, 1e-37f);
  float shortest = INFINITY;
  int leaving = -1;
#pragma unroll
  for (int h = 0; h < H; ++h) {
    float sign = state[h] == AT_LOWER ? 1.f : state[h] == AT_UPPER ? -1.f : 0.f;
    float falls = -sign * side * rate[h], length = fmaxf(-sign * slope[h], 0.f) / falls;
    if (exists[h] && falls > 0.f && length < shortest) shortest = length, leaving = lane + 32 * h;
  }
  if (has_row) {
    float sign = row_state == AT_LOWER ? 1.f : row_state == AT_UPPER ? -1.f : 0.f;
    float falls = sign * side * residuals[M + lane], length = fmaxf(sign * row_push, 0.f) / falls;
    if (falls > 0.f && length < shortest) shortest = length, leaving = N + lane;
  }
  const float length = -largest(-shortest);
  ++changes;
  if (full <= length) {
    int label = side > 0.f ? AT_LOWER : AT_UPPER;
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h == entering) state[h] = label;
    if (has_row && N + lane == entering) row_state = label;
    entering = -1, pushed = 0.f;
  } else {
    unsigned first = __ballot_sync(ALL, shortest == length);
    leaving = __shfl_sync(ALL, leaving, __ffs(first) - 1);
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h == leaving) state[h] = FREE;
    if (has_row && N + lane == leaving) row_state = FREE;
    pushed += side * length;
  }
}

// ---- the answer
#pragma unroll
for (int h = 0; h < H; ++h)
  if (exists[h]) {
    solution.data[problem * N + index[h]] = x[h];
    active.data[problem * CONSTRAINTS + index[h]] = state[h];
  }
if (has_row) {
  row_multipliers.data[problem * P + lane] = row_push;
  active.data[problem * CONSTRAINTS + N + lane] = row_state;
}
if (lane == 0) {
  report.data[problem * 3] = settled;
  report.data[problem * 3 + 1] = changes;
  report.data[problem * 3 + 2] = factorizations;
}
