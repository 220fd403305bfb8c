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
    subtract(turned + from * D + i, D, turn + from, weight * along[i], to - from);
  }
  __syncwarp();
  return weight;
};
// turns the coordinates that are left so that the first ones span the columns beside them; how many these are. An entry
// of a column is so far from the next. The longest column that is left is the pivot, the first of equals; one no longer
// than the cutoff ends it.
auto take_row_space = [&](int columns, int apart, double cutoff) {
  int at = first;
  __syncwarp();
  for (int a = lane; a < columns; a += 32) square[a] = squared_norm(beside + a, apart, N - first);
  for (; at < N && at - first < columns; ++at) {
    double most = -1.0, total = 0.0;
    int pivot = columns;
    for (int a = lane; a < columns; a += 32)
      if (square[a] > most) most = square[a], pivot = a;
    warp_argmax(most, pivot);
    if (pivot == columns) break;                      // a number that is none
    for (int j = at + lane; j < N; j += 32)
      turn[j] = beside[(j - first) * apart + pivot], total += turn[j] * turn[j];
    const double norm = sqrt(warp_sum(total));
    if (!(norm > cutoff)) break;
    __syncwarp();
    for (int i = lane; i < N; i += 32) along[i] = column_times(turn, i, at, N);
    const double weight = reflect(at, norm, at, N);
    for (int a = lane; a < columns; a += 32) {
      double* const own = beside + (at - first) * apart + a;
      subtract(own, apart, turn + at, weight * dot(turn + at, own, apart, N - at), N - at);
      square[a] = squared_norm(own + apart, apart, N - at - 1);
    }
    __syncwarp();
  }
  __syncwarp();
  return at - first;
};
