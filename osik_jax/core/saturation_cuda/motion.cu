// What a level asks for: the damped least-squares motion in the coordinates of its row space, which it takes.

// `place` becomes least |C p - wanted|^2 + damping |p|^2, C the level's rows on the basis of their space: orthogonal
// factors of C with the root of the damping below it, by modified Gram-Schmidt with the right-hand side as a column
auto solve_on_basis = [&]() {
  const double root = sqrt(damping);
  double* const triangle = gram;                      // of the factors; up to its diagonal what is below C
  const bool is_damped = damping > 0.0;
  for (int k = 0; is_damped && k < rank; ++k)
    for (int i = lane; i <= k; i += 32) triangle[k * VD + i] = i == k ? root : 0.0;
  for (int a = lane; a < m; a += 32) right[a] = wanted[a];
  for (int k = lane; k < rank; k += 32) right_below[k] = 0.0;
  __syncwarp();
  for (int k = 0; k < rank; ++k) {
    double* const column = beside + k * MD;
    double* const below = triangle + k * VD;
    const int depth = is_damped ? k + 1 : 0;          // of what is below C and not 0
    double total = 0.0;
    for (int a = lane; a < m; a += 32) total += column[a] * column[a];
    for (int i = lane; i < depth; i += 32) total += below[i] * below[i];
    const double inverse = rsqrt(warp_sum(total));
    for (int a = lane; a < m; a += 32) column[a] *= inverse;
    for (int i = lane; i < depth; i += 32) below[i] *= inverse;
    if (lane == 0) inverse_diagonal[k] = inverse;
    __syncwarp();
    for (int c = k + 1 + lane; c <= rank; c += 32) {  // what this column takes from the later ones
      double* const other = c < rank ? beside + c * MD : right;
      double* const other_below = c < rank ? triangle + c * VD : right_below;
      double product = dot(column, other, 1, m);
      for (int i = 0; i < depth; ++i) product += below[i] * other_below[i];
      subtract(other, 1, column, product, m);
      for (int i = 0; i < depth; ++i) other_below[i] -= product * below[i];
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
    if ((counts[a] & AT_X) != 0) total += row_square[a];
    else for (int j = 0; j < N - first; ++j) beside[j * MD + a] = 0.0;
  }
  rank = take_row_space(m, MD, rank_tolerance[problem] * sqrt(warp_sum(total)));
  solve_on_basis();
  for (int i = lane; i < N; i += 32) motion[i] = column_times(place, i, first, first + rank);
  __syncwarp();
};
