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
// how much larger the scale may be: what is left of the combination that stops the motion, or wrong in it. By as much of
// it as the null space changes, other joints may make room, each by about `size`; so do those whose bound is not the one
// at which the combination is largest
auto scale_left = [&](double size) {
  double square = 0.0, wrong = 0.0, rate_of_scale = 0.0;
  for (int j = first + lane; j < N; j += 32) {
    const double changed = coordinate_times(j, normal);
    square += changed * changed;
  }
  for (int i = lane; i < N; i += 32) rate_of_scale += normal[i] * motion[i];
  square = warp_sum(square), rate_of_scale = warp_sum(rate_of_scale);
  for (int i = lane; i < N; i += 32) {
    const int its_label = i == stop ? passed[i] : at_bound[i];
    wrong += fmax(-its_label * normal[i] * (rate_of_scale > 0.0 ? 1.0 : -1.0), 0.0);
  }
  wrong = warp_sum(wrong);
  return rate_of_scale != 0.0 ? (sqrt(square) + wrong) * size / fabs(rate_of_scale) : INFINITY;
};
// how far a saturated joint would go that is let go: no step, where all multipliers have the right sign
auto step_left = [&]() {
  double most = 0.0;
  for (int a = lane; a < count; a += 32) {
    const double wrong = at_bound[who[a]] * y[a];
    if (stays[a] == 0 && wrong > 0.0) most = fmax(most, wrong / sqrt(dual_times(a, duals + a * D)));
  }
  return warp_max(most);
};
// joints are in their box, no larger scale is possible, and no joint should leave its bound
auto holds = [&](double size) {
  const double off = put_on_bounds();
  if (!(off < INFINITY && off <= SATURATION_RESIDUAL * size)) return false;
  if (stop >= 0 && !(scale_left(size) <= SATURATION_LOSS)) return false;
  return step_left() <= SATURATION_LOSS * size;
};
// searches and returns whether the answer is accepted
auto attempt = [&](double most, double least) {
  const double* const target = targets.data + here * N;
  double* const before = projectors.data + problem * (N * N);  // which is written last
  for (int j = first; j < N; ++j)
    for (int i = lane; i < N; i += 32) before[j * N + i] = turned[j * D + i];
  const bool done = search(target, most, least) && holds(size_of_numbers(target));
  if (!done)
    for (int j = first; j < N; ++j)
      for (int i = lane; i < N; i += 32) turned[j * D + i] = before[j * N + i];
  __syncwarp();
  return done;
};
