// The basis Z of what the levels so far leave free, and Householder reflections of its columns.
auto entry_in_basis = [&](int row, int column) {      // of a hard row in the basis
  return row < N ? Z[row * ZD + column] : E[(row - N) * ZD + column];
};
auto from_basis = [&](int from, int to, double* d) {  // sum of columns of Z times `reflector`
#pragma unroll
  for (int h = 0; h < H; ++h) {
    d[h] = 0.0;
    if (exists[h])
      for (int j = from; j < to; ++j) d[h] += Z[(lane + 32 * h) * ZD + j] * reflector[j];
  }
};
// the sum of the squares of a row's entries
auto norm_squared = [&](const double* row, int from, int to) {
  double even = 0.0, odd = 0.0;
  int j = from;
  for (; j + 1 < to; j += 2) even += row[j] * row[j], odd += row[j + 1] * row[j + 1];
  return j < to ? even + odd + row[j] * row[j] : even + odd;
};
// `reflector` becomes the Householder vector v that takes a row's entries from `at` on to entry `at`; returns 2 / v'v
auto make_reflector = [&](const double* row, int at) {
  double square = 0.0;
  __syncwarp();
  for (int j = lane; j < N; j += 32) {
    reflector[j] = j >= at && j < width ? row[j] : 0.0;
    square += reflector[j] * reflector[j];
  }
  const double norm = sqrt(warp_sum(square));
  __syncwarp();
  const double head = reflector[at];
  __syncwarp();
  if (lane == 0) reflector[at] = head + (head < 0.0 ? -norm : norm);
  __syncwarp();
  return 1.0 / (norm * (norm + fabs(head)));
};
// applies I - weight v v' from the right to a row of this lane
auto apply_reflector = [&](double* row, int at, double weight) {
  double even = 0.0, odd = 0.0;
  int j = at;
  for (; j + 1 < width; j += 2) even += row[j] * reflector[j], odd += row[j + 1] * reflector[j + 1];
  if (j < width) even += row[j] * reflector[j];
  const double by = weight * (even + odd);
  for (int i = at; i < width; ++i) row[i] -= by * reflector[i];
};
