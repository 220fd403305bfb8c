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
// joints are in their box, and no larger scale is possible
auto holds = [&](double size) {
  const double off = put_on_bounds();
  if (!(off < INFINITY && off <= SATURATION_RESIDUAL * size)) return false;
  return stop < 0 || scale_left(size) <= SATURATION_LOSS;
};
// makes what is missing of the motion a short coordinate, before the others: moves along these cost less
auto add_missing_part = [&](double compliance) {
  double square = 0.0;
  for (int i = lane; i < N; i += 32) square += motion[i] * motion[i];
  square = warp_sum(square);
  const double root = square > 0.0 ? sqrt(compliance / square) : 0.0;
  for (int i = lane; i < N; i += 32) turned[(first - 1) * D + i] = root * motion[i];
};
// the scale at which a search with that coordinate ended, and the joint that stops the motion; the multipliers are then
// the combination of joints that stops it: what is missing pulls at it with nearly all
auto find_stop = [&]() {
  double moved = 0.0, square = 0.0, largest = 0.0;
  int which = N;
  for (int i = lane; i < N; i += 32)
    moved += motion[i] * (now[i] - x[i] - target_part[i]), square += motion[i] * motion[i], normal[i] = 0.0;
  moved = warp_sum(moved), square = warp_sum(square);
  scale = square > 0.0 ? clip(moved / square, 0.0, 1.0) : 1.0;
  stop = -1;
  __syncwarp();
  if (scale >= 1.0 - PATH_STEP) return;
  for (int a = lane; a < count; a += 32)
    if (fabs(y[a]) > largest) largest = fabs(y[a]), which = a;
  warp_argmax(largest, which);
  if (which == N) return;
  for (int a = lane; a < count; a += 32) normal[who[a]] = y[a] / largest;
  stop = who[which];
  if (lane == 0) passed[stop] = at_bound[stop];
  __syncwarp();
};
// searches, perhaps from the joints that the attempt before has saturated, and returns whether the answer is accepted.
// With a compliance the motion may be missed in part, so that at any scale there is an answer, and joints that nearly
// depend on each other need no decision; that coordinate takes the place of one which is taken
auto attempt = [&](double most, double least, double compliance, bool goes_on) {
  const double* const target = targets + here * N;
  double* const before = projectors + problem * (N * N);  // which is written last
  const bool is_soft = compliance > 0.0;
  const int start = first - is_soft;
  const auto put_back = [&]() {
    for (int j = start; j < N; ++j)
      for (int i = lane; i < N; i += 32) turned[j * D + i] = before[j * N + i];
    __syncwarp();
  };
  for (int j = goes_on ? N : start; j < N; ++j)
    for (int i = lane; i < N; i += 32) before[j * N + i] = turned[j * D + i];
  if (goes_on) go_on(most);
  else begin_search(target, most);
  if (is_soft) add_missing_part(compliance);
  first = start;
  bool done = search(target, least);
  const double whole = size_of_numbers(target);
  first += is_soft;
  if (is_soft) {
    done = done && stop < 0;
    find_stop();
    put_back();
  }
  done = done && holds(whole);
  __syncwarp();
  for (int i = lane; is_soft && i < N; i += 32)
    if (fabs(normal[i]) <= NEGLIGIBLE_ENTRY) normal[i] = 0.0;
  if (!done && !is_soft) put_back();
  __syncwarp();
  return done;
};
