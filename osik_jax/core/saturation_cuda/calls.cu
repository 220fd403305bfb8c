// Functions that are called, not put in where they are used: the kernel is so long that fetching instructions takes most
// of its time. They are members of a struct, since C++ has no functions inside of functions. Vectors are in shared memory.
struct Called {
  // `v` times `w`, whose entries are so far apart
  static __device__ __noinline__ double dot(const double* v, const double* w, int apart, int count) {
    __builtin_assume(__isShared(v));
    __builtin_assume(__isShared(w));
    double even = 0.0, odd = 0.0;
    int j = 0;
    for (; j + 3 < count; j += 4, w += 4 * apart) {
      even += v[j] * w[0], odd += v[j + 1] * w[apart];
      even += v[j + 2] * w[2 * apart], odd += v[j + 3] * w[3 * apart];
    }
    for (; j < count; ++j, w += apart) even += v[j] * w[0];
    return even + odd;
  }
  // takes `part` of `v` from `w`, whose entries are so far apart; four are read before the first is written
  static __device__ __noinline__ void subtract(double* w, int apart, const double* v, double part, int count) {
    __builtin_assume(__isShared(v));
    __builtin_assume(__isShared(w));
    int j = 0;
    for (; j + 3 < count; j += 4, w += 4 * apart) {
      const double first = w[0] - part * v[j], second = w[apart] - part * v[j + 1];
      const double third = w[2 * apart] - part * v[j + 2], fourth = w[3 * apart] - part * v[j + 3];
      w[0] = first, w[apart] = second, w[2 * apart] = third, w[3 * apart] = fourth;
    }
    for (; j < count; ++j, w += apart) w[0] -= part * v[j];
  }
};
auto dot = [](const double* v, const double* w, int apart, int count) { return Called::dot(v, w, apart, count); };
auto subtract = [](double* w, int apart, const double* v, double part, int count) {
  Called::subtract(w, apart, v, part, count);
};
