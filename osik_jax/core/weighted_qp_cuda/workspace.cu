// Sizes and shared memory of one warp: the rows, the inverse factor, and vectors to work with.
//
// Variable i belongs to lane i % 32, in its slot i / 32. Constants from _single.py: N variables, M rows of the cost, P
// soft rows (at most 32), WARPS of a block; and those of numerics/_constants.py.

constexpr int H = N > 32 ? 2 : 1;             // variables of a lane
constexpr int ROWS = M + P;
constexpr int NG = (N + 3) / 4;               // groups of four variables
constexpr int LD = 4 * (NG | 1);              // length of a row: an odd number of groups meets every bank
constexpr int PADDED_ROWS = (ROWS + 3) / 4 * 4;
constexpr int CONSTRAINTS = N + P;
constexpr unsigned ALL = 0xffffffffu;
constexpr int FREE = 0, AT_LOWER = -1, AT_UPPER = 1, EQUALITY = 2;

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
