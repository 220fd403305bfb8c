// The systems of retargeting/_banded.py on a GPU in single precision, one by the 32 threads of a block. It is another
// arrangement than banded.hpp, which is for one thread: each thread has a tile of every block in registers.
//
// Of row t of blocks, with D = square[t] + alone[t], B = first - rows[t]^T weight[t] rows[t-1], s = second[t], and
// V[t] = L[t]^-1 the inverse of the factor:
//
//     near[t] = (B - s V[t-2]^T near[t-1]^T) V[t-1]^T
//     L L^T = D - near near^T - (s V[t-2]^T) (s V[t-2]^T)^T
//     y[t] = V[t] (right[t] - near[t] y[t-1] - s V[t-2]^T y[t-2])
//
// and backwards x[t] = V[t]^T (y[t] - near[t+1]^T x[t+1] - V[t] (second[t+2] x[t+2])). Thread (a, b) of 4 x 8 has the
// entries (a + 4 r, b + 8 c) of each block in registers. Constants from retargeting/_banded.py: N dofs, M rows.
extern "C" __global__ void __launch_bounds__(32)
    osik_kernel(const float* square, const float* alone, const float* rows, const float* weight, const float* first,
                const float* second, const float* right, const int* frame_count, float* solution, float* near,
                float* inverse, int problems) {
  constexpr int ROWS = (N + 3) / 4, COLUMNS = (N + 7) / 8;
  constexpr int LD = N | 1;                     // lengths of rows: an odd number meets every bank
  constexpr int BLOCK = N * N;

  __shared__ float blocks[4][N * LD];
  __shared__ float couplings[2][M * N];
  __shared__ float vectors[6][N];

  const int lane = threadIdx.x & 31, a = lane / 8, b = lane % 8;
  float* const below = blocks[0];               // near of the frame before, then of this one
  float* const between = blocks[1];
  float* inverse1 = blocks[2];                  // of the frame before
  float* inverse2 = blocks[3];                  // of the one before that, then of this one
  float* const scale = vectors[2];
  float* const middle = vectors[3];
  float* y1 = vectors[4];
  float* const weighted = couplings[0];         // rows of this frame, times less than nothing
  float* const before = couplings[1];           // of the one before
  float* y2 = vectors[5];
  int row[ROWS], column[COLUMNS];               // those that do not exist are the last
#pragma unroll
  for (int r = 0; r < ROWS; ++r) row[r] = a + 4 * r < N ? a + 4 * r : N - 1;
#pragma unroll
  for (int c = 0; c < COLUMNS; ++c) column[c] = b + 8 * c < N ? b + 8 * c : N - 1;
  float tile[ROWS][COLUMNS];

  auto clear = [&]() {
#pragma unroll
    for (int r = 0; r < ROWS; ++r)
#pragma unroll
      for (int c = 0; c < COLUMNS; ++c) tile[r][c] = 0.f;
  };
  struct Strides {
    int row, k;
  };
  const Strides upright{LD, 1}, transposed{1, LD}, flat{1, N};
  auto add_product = [&](const float* left, Strides at, const float* right, Strides to, int count) {
    for (int k = 0; k < count; ++k) {           // tile += sum over k of left[i][k] right[j][k]
      float u[ROWS], v[COLUMNS];
#pragma unroll
      for (int r = 0; r < ROWS; ++r) u[r] = left[row[r] * at.row + k * at.k];
#pragma unroll
      for (int c = 0; c < COLUMNS; ++c) v[c] = right[column[c] * to.row + k * to.k];
#pragma unroll
      for (int r = 0; r < ROWS; ++r)
#pragma unroll
        for (int c = 0; c < COLUMNS; ++c) tile[r][c] += u[r] * v[c];
    }
  };
  auto write = [&](float* to) {
#pragma unroll
    for (int r = 0; r < ROWS; ++r)
#pragma unroll
      for (int c = 0; c < COLUMNS; ++c)
        if (a + 4 * r < N && b + 8 * c < N) to[(a + 4 * r) * LD + b + 8 * c] = tile[r][c];
  };
  auto copy = [&](const float* block, float* to) {
    for (int e = lane; e < BLOCK; e += 32) to[e / N * LD + e % N] = block[e];
  };
  auto keep = [&](const float* block, float* to) {
    for (int e = lane; e < BLOCK; e += 32) to[e] = block[e / N * LD + e % N];
  };

  const size_t system = blockIdx.x, frames = *frame_count;
  const float* const D = square + system * frames * BLOCK;
  const float* const own = alone + system * frames * N;
  const float* const C = rows + system * frames * M * N;
  const float* const W = weight + system * frames * M;
  const float* const B = first + system * frames * N;
  const float* const S = second + system * frames * N;
  const float* const R = right + system * frames * N;
  float* const nears = near + system * frames * BLOCK;
  float* const inverses = inverse + system * frames * BLOCK;
  float* const x = solution + system * frames * N;

  for (int e = lane; e < 4 * N * LD; e += 32) blocks[0][e] = 0.f;
  for (int e = lane; e < M * N; e += 32) before[e] = 0.f;
  for (int i = lane; i < N; i += 32) y1[i] = y2[i] = 0.f;
  __syncwarp();

  // ---- from the first frame to the last
  for (size_t t = 0; t < frames; ++t) {
    for (int i = lane; i < N; i += 32) scale[i] = S[t * N + i];
    for (int e = lane; e < M * N; e += 32) weighted[e] = -W[t * M + e / N] * C[t * M * N + e];
    clear();
    add_product(inverse2, transposed, below, upright, N);
    __syncwarp();
#pragma unroll
    for (int r = 0; r < ROWS; ++r)
#pragma unroll
      for (int c = 0; c < COLUMNS; ++c) {
        float diagonal = row[r] == column[c] ? B[t * N + row[r]] : 0.f;
        tile[r][c] = diagonal - scale[row[r]] * tile[r][c];
      }
    add_product(weighted, flat, before, flat, M);
    write(between);
    __syncwarp();
    for (int e = lane; e < M * N; e += 32) before[e] = C[t * M * N + e];
    clear();
    add_product(between, upright, inverse1, upright, N);
    write(below);
    __syncwarp();
    keep(below, nears + t * BLOCK);

    clear();
    add_product(inverse2, transposed, inverse2, transposed, N);
#pragma unroll
    for (int r = 0; r < ROWS; ++r)
#pragma unroll
      for (int c = 0; c < COLUMNS; ++c) tile[r][c] *= scale[row[r]] * scale[column[c]];
    add_product(below, upright, below, upright, N);
#pragma unroll
    for (int r = 0; r < ROWS; ++r)
#pragma unroll
      for (int c = 0; c < COLUMNS; ++c) {
        float diagonal = row[r] == column[c] ? own[t * N + row[r]] : 0.f;
        tile[r][c] = D[t * BLOCK + row[r] * N + column[c]] + diagonal - tile[r][c];
      }
    for (int i = lane; i < N; i += 32) {
      float sum = R[t * N + i], far = 0.f;
      for (int k = 0; k < N; ++k) sum -= below[i * LD + k] * y1[k], far += inverse2[k * LD + i] * y2[k];
      middle[i] = sum - scale[i] * far;
    }

    // the factor and its inverse in one: what is left of column k of the factor becomes column k of the inverse
#pragma unroll
    for (int at = 0; at < ROWS; ++at)           // the row of tiles that has row k, and half the column that has column k
#pragma unroll 1
      for (int k = 4 * at; k < 4 * at + 4 && k < N; ++k) {
        float* const across = vectors[k & 1];   // column k from its diagonal down, row k before it
        if (b == k % 8) {
#pragma unroll
          for (int r = 0; r < ROWS; ++r)
            if (a + 4 * r >= k && a + 4 * r < N) across[a + 4 * r] = tile[r][at / 2];
        }
        if (a == k % 4) {
#pragma unroll
          for (int c = 0; c < COLUMNS; ++c)
            if (b + 8 * c < k) across[b + 8 * c] = tile[at][c];
        }
        __syncwarp();
        const float root = 1.f / sqrtf(across[k]);
        float lower[ROWS], unit[COLUMNS];
#pragma unroll
        for (int r = 0; r < ROWS; ++r) lower[r] = a + 4 * r > k ? across[row[r]] * root : 0.f;
#pragma unroll
        for (int c = 0; c < COLUMNS; ++c) unit[c] = across[column[c]] * root;
#pragma unroll
        for (int r = 0; r < ROWS; ++r)
#pragma unroll
          for (int c = 0; c < COLUMNS; ++c) tile[r][c] -= lower[r] * unit[c];
        if (b == k % 8) {
#pragma unroll
          for (int r = 0; r < ROWS; ++r) {
            if (a + 4 * r > k) tile[r][at / 2] = -lower[r] * root;
            if (a + 4 * r == k) tile[r][at / 2] = root;
          }
        }
        if (a == k % 4) {
#pragma unroll
          for (int c = 0; c < COLUMNS; ++c)
            if (b + 8 * c < k) tile[at][c] = unit[c];
        }
      }
#pragma unroll
    for (int r = 0; r < ROWS; ++r)
#pragma unroll
      for (int c = 0; c < COLUMNS; ++c)
        if (b + 8 * c > a + 4 * r) tile[r][c] = 0.f;
    __syncwarp();
    write(inverse2);
    __syncwarp();
    keep(inverse2, inverses + t * BLOCK);
    for (int i = lane; i < N; i += 32) {
      float sum = 0.f;
      for (int k = 0; k < N; ++k) sum += inverse2[i * LD + k] * middle[k];
      y2[i] = x[t * N + i] = sum;
    }
    float* const older = inverse1;
    inverse1 = inverse2, inverse2 = older;
    float* const swapped = y1;
    y1 = y2, y2 = swapped;
    __syncwarp();
  }

  // ---- and back
  for (int i = lane; i < N; i += 32) y1[i] = y2[i] = 0.f;    // x of the frame after, and of the one after that
  for (size_t t = frames; t-- > 0;) {
    copy(inverses + t * BLOCK, inverse1);
    if (t + 1 < frames) copy(nears + (t + 1) * BLOCK, below);
    for (int i = lane; i < N; i += 32) scale[i] = t + 2 < frames ? S[(t + 2) * N + i] * y2[i] : 0.f;
    __syncwarp();
    for (int i = lane; i < N; i += 32) {
      float sum = x[t * N + i], far = 0.f;
      for (int k = 0; k < N; ++k) far += inverse1[i * LD + k] * scale[k];
      if (t + 1 < frames)
        for (int k = 0; k < N; ++k) sum -= below[k * LD + i] * y1[k];
      middle[i] = sum - far;
    }
    __syncwarp();
    for (int i = lane; i < N; i += 32) {
      float sum = 0.f;
      for (int k = 0; k < N; ++k) sum += inverse1[k * LD + i] * middle[k];
      y2[i] = x[t * N + i] = sum;
    }
    float* const swapped = y1;
    y1 = y2, y2 = swapped;
    __syncwarp();
  }
}
