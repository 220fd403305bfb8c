// Sizes and shared memory of one warp: the coordinates, the rows of a level in them, and vectors to work with.
//
// Joint i belongs to lane i % 32, and so do coordinate i, saturated joint i and row i of the level. Constants from
// _cuda.py: N joints, LEVELS, M rows of the longest level, WARPS of a block, and those of numerics/_constants.py that
// it shares with the core.
constexpr int WIDE = N > M ? N : M;
constexpr int D = N | 1, MD = M | 1;                  // row lengths in shared memory: odd, to meet every bank
constexpr int G = (M + 31) / 32, H = (N + 31) / 32;   // rows of a lane, and joints
// room for a level's rows, and for most levels for a square matrix of theirs too; where it does not fit, it is in the
// global memory of the projector, which is written last, if that is large enough
constexpr bool HAS_ROOM_ELSEWHERE = M * MD <= N * N;
constexpr int ROOM = HAS_ROOM_ELSEWHERE ? N * (WIDE | 1) : N * (WIDE | 1) + M * MD;
constexpr unsigned ALL = 0xffffffffu;

__shared__ double shared_doubles[WARPS][N * D + ROOM + 14 * N + 6 * M + WIDE];
__shared__ int shared_ints[WARPS][6 * N + M];

const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
double* const turned = shared_doubles[warp];          // orthonormal rows: coordinates, those taken first
double* const room = turned + N * D;
double* const beside = room;                          // columns in the coordinates that are left: the level's rows
double* const duals = room;                           // of the saturated joints, once the level's motion is known

// ---- joints
double* const x = room + ROOM;                        // where the levels so far have moved them
double* const low = x + N;                            // the box of the levels below
double* const high = low + N;
double* const bent = high + N;                        // bound on the curvature of the rows so far
double* const motion = bent + N;                      // what the level asks for
double* const now = motion + N;                       // x of the search
double* const target_part = now + N;                  // of that x
double* const along = target_part + N;                // a direction
double* const normal = along + N;                     // the combination that stops the motion
// ---- coordinates
double* const turn = normal + N;
double* const place = turn + N;
// ---- saturated joints, in the order in which coordinates are theirs
double* const y = place + N;                          // their multipliers
double* const rate = y + N;                           // how much of a column they make up
double* const gap = rate + N;                         // from where they are to their bounds
// ---- rows of the level
double* const value = gap + N;                        // at a point
double* const wanted = value + M;                     // from there to their intervals
double* const row_square = wanted + M;                // of their length
double* const right = row_square + M;                 // right-hand side, and what is below it
double* const right_below = right + M;
double* const inverse_diagonal = right_below + M;     // 1 / diagonal of the Cholesky factor; the triangle's diagonal
double* const square = inverse_diagonal + M;          // of what is left of columns of `beside`

int* const at_bound = shared_ints[warp];              // label of each joint in the search
int* const passed = at_bound + N;                     // labels of free ones that saturated ones put on their bounds
int* const blocking = passed + N;                     // labels of those that stop the level
int* const fixed = blocking + N;                      // of those that can move no more; 2 for pinned ones
int* const who = fixed + N;                           // the saturated joints
int* const stays = who + N;                           // whether they stop the motion
int* const counts = stays + N;                        // where a row takes part: AT_X, AT_BASE or both
constexpr int AT_X = 1, AT_BASE = 2;                  // at x; at what of x the null space can not move
