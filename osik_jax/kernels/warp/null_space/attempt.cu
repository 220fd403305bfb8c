// The kernel's own judge: a search whose answer does not hold leaves the coordinates as they were.

// puts joints on their bounds, where they are up to roundoff; returns that roundoff, infinite where `now` is NaN
auto put_on_bounds = [&]() {
  double off = 0.0;
  __syncwarp();
  for (int i = lane; i < N; i += 32) {
    const double before = now[i];
    const double on_bound = at_bound[i] != 0 ? bound(i) : i == stop ? bound_passed(i) : before;
    now[i] = clip(on_bound, low[i], high[i]);
    const double moved = fabs(now[i] - before);
    off = fmax(off, moved < INFINITY ? moved : INFINITY);
  }
  __syncwarp();
  return warp_max(off);
};
// searches and returns whether the answer is accepted
auto attempt = [&](double most, double least) {
  const double* const target = targets.data + here * N;
  double* const before = projectors.data + problem * (N * N);  // which is written last
  for (int j = first; j < N; ++j)
    for (int i = lane; i < N; i += 32) before[j * N + i] = turned[j * D + i];
  bool done = search(target, most, least);
  if (done) {
    const double off = put_on_bounds();
    done = off < INFINITY && off <= SATURATION_RESIDUAL * size_of_numbers(target);
  }
  if (!done)
    for (int j = first; j < N; ++j)
      for (int i = lane; i < N; i += 32) turned[j * D + i] = before[j * N + i];
  __syncwarp();
  return done;
};
