// What a level asks for: the damped least-squares motion in the coordinates of its row space, which it takes.

// `place` becomes least |C p - wanted|^2 + damping |p|^2, C the level's rows on the basis of their space: orthogonal
// factors of C with the root of the damping below it, by modified Gram-Schmidt with the right-hand side as a column
auto solve_on_basis = [&]() {
  const double root = sqrt(damping);
  for (int k = 0; k < rank; ++k)
    for (int i = lane; i <= k; i += 32) triangle[k * VD + i] = i == k ? root : 0.0;
  for (int a = lane; a < m; a += 32) right[a] = wanted[a];
  for (int k = lane; k < rank; k += 32) right_below[k] = 0.0;
  __syncwarp();
  for (int k = 0; k < rank; ++k) {
    double* const column = beside + (first + k) * BD;
    double* const below = triangle + k * VD;
    double total = 0.0;
    for (int a = lane; a < m; a += 32) total += column[a] * column[a];
    for (int i = lane; i <= k; i += 32) total += below[i] * below[i];
    const double norm = sqrt(warp_sum(total));
    for (int a = lane; a < m; a += 32) column[a] /= norm;
    for (int i = lane; i <= k; i += 32) below[i] /= norm;
    if (lane == 0) inverse_diagonal[k] = 1.0 / norm;
    __syncwarp();
    for (int c = k + 1 + lane; c <= rank; c += 32) {  // what this column takes from the later ones
      double* const other = c < rank ? beside + (first + c) * BD : right;
      double* const other_below = c < rank ? triangle + c * VD : right_below;
      double product = 0.0;
      for (int a = 0; a < m; ++a) product += column[a] * other[a];
      for (int i = 0; i <= k; ++i) product += below[i] * other_below[i];
      for (int a = 0; a < m; ++a) other[a] -= product * column[a];
      for (int i = 0; i <= k; ++i) other_below[i] -= product * below[i];
      (c < rank ? triangle[k * VD + c] : place[first + k]) = product;
    }
    __syncwarp();
  }
  for (int k = rank - 1; k >= 0; --k) {
    const double part = place[first + k] * inverse_diagonal[k];
    __syncwarp();
    if (lane == 0) place[first + k] = part;
    for (int i = lane; i < k; i += 32) place[first + i] -= triangle[i * VD + k] * part;
    __syncwarp();
  }
};
auto find_motion = [&]() {
  double total = 0.0;
  for (int a = lane; a < m; a += 32) {
    if (counts[a] != 0) total += row_square[a];
    else for (int j = first; j < N; ++j) beside[j * BD + a] = 0.0;
  }
  rank = take_row_space(m, rank_tolerance.data[problem] * sqrt(warp_sum(total)));
  solve_on_basis();
  for (int i = lane; i < N; i += 32) motion[i] = column_times(place, i, first, first + rank);
  __syncwarp();
};
