// The Hessian of the working set, and the inverse of its Cholesky factor.

// named, since Warp makes a macro of what stands before a parenthesis in "float (&R)"
using Entries = float[H][N];

// lane i has column i, and of column i + 32 the rows from 32 on; the rest of that is in the other lanes, by symmetry
auto form_hessian = [&](Entries& R, float* diagonal) {
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
};
// over the free variables, scaled to a diagonal of ones; the others get a row and column of the identity
auto scale_hessian = [&](Entries& R, const float* diagonal) {
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
};
// L^-1 of its Cholesky factor L, in place. Before step j lane i >= j has column i of the Schur complement that is left of
// the Hessian, lane i < j column i of the identity as far as L has been solved for
auto invert_factor = [&](Entries& R) {
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
};
auto store_factor = [&](const Entries& R) {     // to `inverse_factor`, from the registers
#pragma unroll
  for (int k = 0; k < N; ++k)
#pragma unroll
    for (int h = 0; h < H; ++h)
      if (lane + 32 * h < 4 * NG) {
        float entry = 32 * h <= k ? R[h][k] : 0.f;
        inverse_factor[k * LD + lane + 32 * h] = lane + 32 * h <= k ? entry : 0.f;
      }
};
auto factor = [&]() {
  float R[H][N], diagonal[H];
  form_hessian(R, diagonal);
  scale_hessian(R, diagonal);
  invert_factor(R);
  store_factor(R);
  ++factorizations;
};
