// One problem: its variables, its hard rows beside the box, and whether it has a warm start.
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
// ---- hard rows beside the box: row q belongs to lane q
const bool has_row = lane < P;
double row_low = -INFINITY, row_high = INFINITY, row_length = 1.0;
int row_active = 0, row_level = LEVELS;
bool row_frozen = true;
const double* const row_of_lane = A + (P ? ROW[lane < P ? lane : 0] : 0);
if (has_row) {
  row_level = LEVEL[lane];
  double square = 0.0;
#pragma unroll 8
  for (int i = 0; i < N; ++i) square += row_of_lane[i * ROWS] * row_of_lane[i * ROWS];
  row_length = sqrt(square);
}

int known = 0;                                        // 0 where there is no warm start
for (int e = lane; e < LEVELS * M; e += 32) known |= guess_own.data[problem * (LEVELS * M) + e];
bool warm = any(known != 0);
double largest = 0.0;                                 // largest |x| at a guess from which the search of a level went on

auto begin = [&]() {                                  // at the box's point nearest to 0, with nothing frozen but pins
  width = 0, largest = 0.0;
  __syncwarp();
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
  if (has_row) {
    row_low = hard_lower.data[problem * HARD + N + lane];
    row_high = hard_upper.data[problem * HARD + N + lane];
    row_active = 0, row_frozen = false;
  }
};
