// Sizes and shared memory of one warp: the basis, the factors, and vectors to work with.
//
// Variable i belongs to lane i % 32, and so do row i of the level and column i of Z. Constants from _warp.py: N
// variables, LEVELS, M rows of the longest level, ROWS of all levels, P hard rows beside the box (at most 32), WARPS
// of a block; COUNT, OFFSET and HAS_INEQUALITIES of each level; of each hard row beside the box its ROW among those of
// all levels, and its LEVEL; and those of numerics/_constants.py that it shares with plain JAX.
constexpr int H = (N + 31) / 32, G = (M + 31) / 32;   // variables and rows of a lane
constexpr int ZD = N | 1, VD = M | 1;                 // row lengths in shared memory: odd, to meet every bank
constexpr int MAX_RANK = N < M ? N : M;
constexpr int MAX_LENGTH = (N > M ? N : M) > P ? (N > M ? N : M) : P;
constexpr int HARD = N + P;
constexpr int FACTORS = N * VD + M * ZD;              // the level's rows, then their reflectors; the triangle
constexpr unsigned ALL = 0xffffffffu;

__shared__ double shared_doubles[WARPS][N * ZD + FACTORS + (P ? P : 1) * ZD + 4 * MAX_LENGTH + MAX_RANK + M * VD + M];
__shared__ int shared_ints[WARPS][N + MAX_RANK + M];

const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
bool exists[H];
#pragma unroll
for (int h = 0; h < H; ++h) exists[h] = lane + 32 * h < N;
auto is = [&](int h, int row) { return exists[h] && lane + 32 * h == row; };  // a row of the box, of this lane
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
