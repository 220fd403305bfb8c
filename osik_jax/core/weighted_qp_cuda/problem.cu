// One problem: its variables and soft rows, and what the method knows of them.
const size_t problem = pid;
int index[H], label[H];
bool exists[H];
float low[H], high[H], damping_of[H], center_of[H], x[H];
#pragma unroll
for (int h = 0; h < H; ++h) {
  int i = lane + 32 * h;
  exists[h] = i < N;
  index[h] = exists[h] ? i : N - 1;
  low[h] = exists[h] ? lower[problem * CONSTRAINTS + i] : 0.f;
  high[h] = exists[h] ? upper[problem * CONSTRAINTS + i] : 0.f;
  damping_of[h] = exists[h] ? damping[problem * N + i] : 0.f;
  center_of[h] = exists[h] ? center[problem * N + i] : 0.f;
  label[h] = exists[h] ? guess[problem * CONSTRAINTS + i] : EQUALITY;
  x[h] = 0.f;
}
const bool has_row = lane < P;
float row_low = 0.f, row_high = 0.f, row_compliance = 1.f;
int row_label = FREE;
if (has_row) {
  row_low = lower[problem * CONSTRAINTS + N + lane];
  row_high = upper[problem * CONSTRAINTS + N + lane];
  row_compliance = compliance[problem * P + lane];
  row_label = row_low == row_high ? EQUALITY : guess[problem * CONSTRAINTS + N + lane];
}
const bool hard = __any_sync(ALL, has_row && row_compliance <= 0.f && (finite(row_low) || finite(row_high)));
const float relative_tol = tolerance[problem];

__syncwarp();
for (int e = lane; e < M * N; e += 32) S[e / N * LD + e % N] = matrix[problem * (M * N) + e];
for (int e = lane; e < P * N; e += 32) S[(M + e / N) * LD + e % N] = rows[problem * (P * N) + e];
for (int r = lane; r < ROWS; r += 32)
  for (int k = N; k < 4 * NG; ++k) S[r * LD + k] = 0.f;
for (int r = lane; r < M; r += 32) {
  row_weights[r] = weight[problem * M + r];
  row_targets[r] = target[problem * M + r];
}

int factorizations = 0, changes = 0, fewest_wrong = CONSTRAINTS + 1, patience = MAX_EXCHANGES;
bool converged = false, use_dual = false;
int entering = -1;                            // the constraint that the dual method makes active, -1 for none
float entering_multiplier = 0.f;              // its multiplier so far
float row_multiplier = 0.f;                   // multiplier of the lane's soft row
float root[H], unit[H];                       // roots of the Hessian's diagonal; their inverses where free, else 0
float gradient[H];                            // of the cost, downhill
int next[H], next_row_label = FREE;           // labels without what is wrong of the present ones
float row_gain = -1.f;                        // by how much the dual objective rises with the lane's row
