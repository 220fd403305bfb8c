// Cholesky factor of the first `count` rows of `gram`, whose upper triangle with the diagonal is the matrix, plus
// `ridge` on the diagonal; the factor goes below the diagonal, the inverse of its own to `inverse_diagonal`
auto cholesky = [&](int count, double ridge) {
  for (int k = 0; k < count; ++k) {
    double value[G];
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int a = lane + 32 * g;
      value[g] = a >= k && a < count ? gram[k * VD + a] + (a == k ? ridge : 0.0) : 0.0;
      if (a >= k && a < count)
        for (int j = 0; j < k; ++j) value[g] -= gram[a * VD + j] * gram[k * VD + j];
    }
    double mine = value[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? value[g] : mine;
    const double inverse = rsqrt(fmax(__shfl_sync(ALL, mine, k & 31), 1e-300));
    __syncwarp();
#pragma unroll
    for (int g = 0; g < G; ++g)
      if (lane + 32 * g > k && lane + 32 * g < count) gram[(lane + 32 * g) * VD + k] = value[g] * inverse;
    if (lane == 0) inverse_diagonal[k] = inverse;
    __syncwarp();
  }
};
auto cholesky_solve = [&](int count, double* right) { // entry a of lane a % 32
  for (int k = 0; k < count; ++k) {
    double mine = right[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? right[g] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) * inverse_diagonal[k];
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int a = lane + 32 * g;
      if (a == k) right[g] = y;
      if (a > k && a < count) right[g] -= gram[a * VD + k] * y;
    }
  }
  for (int k = count - 1; k >= 0; --k) {
    double mine = right[0];
#pragma unroll
    for (int g = 1; g < G; ++g) mine = k >> 5 == g ? right[g] : mine;
    const double y = __shfl_sync(ALL, mine, k & 31) * inverse_diagonal[k];
#pragma unroll
    for (int g = 0; g < G; ++g) {
      const int a = lane + 32 * g;
      if (a == k) right[g] = y;
      if (a < k) right[g] -= gram[k * VD + a] * y;
    }
  }
};
