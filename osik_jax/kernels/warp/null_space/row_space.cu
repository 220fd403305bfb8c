// Householder reflections of the coordinates, and the row space of a level that they bring to the front.

// reflects coordinates so that `turn`, of this norm, is along `head` alone; `along` is their sum by `turn` before.
// Returns the weight of the reflection, whose vector `turn` becomes.
auto reflect = [&](int head, double norm, int from, int to) {
  const double top = turn[head], by = top < 0.0 ? -norm : norm, weight = 1.0 / (norm * (norm + fabs(top)));
  __syncwarp();
  if (lane == 0) turn[head] = top + by;
  __syncwarp();
  for (int i = lane; i < N; i += 32) {
    along[i] += by * turned[head * D + i];
    const double part = weight * along[i];
#pragma unroll 4
    for (int j = from; j < to; ++j) turned[j * D + i] -= turn[j] * part;
  }
  __syncwarp();
  return weight;
};
// turns the coordinates that are left so that the first ones span the columns of `beside`; how many these are. The
// longest column that is left is the pivot, the first of equals; one no longer than the cutoff ends it.
auto take_row_space = [&](int columns, double cutoff) {
  int at = first;
  __syncwarp();
  for (int a = lane; a < columns; a += 32) {
    double total = 0.0;
#pragma unroll 4
    for (int j = first; j < N; ++j) total += beside[j * BD + a] * beside[j * BD + a];
    square[a] = total;
  }
  for (; at < N && at - first < columns; ++at) {
    double most = -1.0, total = 0.0;
    int pivot = columns;
    for (int a = lane; a < columns; a += 32)
      if (square[a] > most) most = square[a], pivot = a;
    warp_argmax(most, pivot);
    if (pivot == columns) break;                      // a number that is none
    for (int j = at + lane; j < N; j += 32) turn[j] = beside[j * BD + pivot], total += turn[j] * turn[j];
    const double norm = sqrt(warp_sum(total));
    if (!(norm > cutoff)) break;
    __syncwarp();
    for (int i = lane; i < N; i += 32) along[i] = column_times(turn, i, at, N);
    const double weight = reflect(at, norm, at, N);
    for (int a = lane; a < columns; a += 32) {
      double product = 0.0, left = 0.0;
#pragma unroll 4
      for (int j = at; j < N; ++j) product += turn[j] * beside[j * BD + a];
      product *= weight;
#pragma unroll 4
      for (int j = at; j < N; ++j) {
        beside[j * BD + a] -= turn[j] * product;
        if (j > at) left += beside[j * BD + a] * beside[j * BD + a];
      }
      square[a] = left;
    }
    __syncwarp();
  }
  __syncwarp();
  return at - first;
};
