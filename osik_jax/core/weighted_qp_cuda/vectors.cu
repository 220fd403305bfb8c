// Sums over the rows and columns of shared memory, and the solve with the factor that is kept there.
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
