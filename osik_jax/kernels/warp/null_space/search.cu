// The saturated joints and the largest scale of a level's motion, by the dual method that
// kernels/numba/_saturation_search.py describes.
int changes = 0;                                      // of the active set, in the search of this level

// no joint is saturated; what the null space makes of the target
auto begin_search = [&](const double* target) {
  count = 0, stop = -1, scale = 1.0;
  __syncwarp();
  for (int i = lane; i < N; i += 32) along[i] = target[i] - x[i], at_bound[i] = passed[i] = 0;
  __syncwarp();
  for (int j = first + lane; j < N; j += 32) {
    double total = 0.0;
#pragma unroll 8
    for (int i = 0; i < N; ++i) total += turned[j * D + i] * along[i];
    place[j] = total;
  }
  __syncwarp();
  for (int i = lane; i < N; i += 32) {
    target_part[i] = column_times(place, i, first, N);
    double total = 0.0;
#pragma unroll 8
    for (int j = first; j < N; ++j) total += turned[j * D + i] * turned[j * D + i];
    free_part[i] = total;
  }
  settle();
};
// finds `now`, inside its box, and returns whether it has; a combination with parts below `least` depends on others
auto search = [&](const double* target, double least) {
  int entering = -1, crossings = 0;                   // crossings: exchanges at this scale for this joint
  double sign = 1.0, push = 0.0, stop_rate = 0.0;
  bool dropping = false, going = true;
  begin_search(target);
  double whole = size_of_numbers(target);
  changes = 0;
  while (changes < max_iterations) {
    if (dropping) {
      const int wrong = most_wrong(SATURATION_ROUNDOFF * whole);
      dropping = wrong >= 0;
      if (dropping) {
        release(wrong, true);
        ++changes;
        continue;
      }
    }
    if (entering < 0) {
      entering = most_violated(SATURATION_ROUNDOFF * whole, least);
      going = entering >= 0;
      if (!going) break;
      sign = low[entering] - now[entering] >= now[entering] - high[entering] ? 1.0 : -1.0;
      push = 0.0, crossings = 0;
    }
    const int k = entering, label = sign > 0.0 ? -1 : 1;
    ++changes;
    const double length_squared = look_along(k);
    const double beyond = fmax(sign > 0.0 ? low[k] - now[k] : now[k] - high[k], 0.0);
    const double full = length_squared > least * least ? beyond / length_squared : INFINITY;
    double largest = 1.0, length;
    for (int a = lane; a < count; a += 32) largest = fmax(largest, fabs(rate[a]));
    largest = warp_max(largest);
    const int leaving = first_to_leave(sign, (full < INFINITY ? SATURATION_ROUNDOFF : least) * largest, length);
    if (leaving < 0 && full == INFINITY) {
      const int out = first_to_cross(sign, least * largest);
      if (out >= 0) {
        if (++crossings > count) break;               // rounding has them go round
        ++changes;
        stop = exchange(out, stop), push = 0.0;
        settle();
        continue;
      }
      entering = -1;
      double its_rate, lower_scale = scale_of(k, label, least, its_rate);
      if (lane == 0) passed[k] = label;
      __syncwarp();
      if (!(lower_scale < scale - SATURATION_ROUNDOFF)) continue;  // but for rounding it is where the others put it
      int stopped = k, its_label = label;
      const int most_said_about = largest_rate(LARGEST_RATE);
      if (most_said_about >= 0) {
        stopped = exchange(most_said_about, k), changes += 2;
        its_label = passed[stopped];
        look_along(stopped);
        lower_scale = scale_of(stopped, its_label, least, its_rate);
      }
      stop_by(stopped, its_label);
      stop_rate = its_rate, dropping = true, scale = fmin(lower_scale, scale);
      settle_stopped(stop_rate);
      whole = size_of_numbers(target);
      continue;
    }
    const double step = sign * fmin(length, full);
    for (int i = lane; i < N; i += 32) now[i] += step * along[i];
    for (int a = lane; a < count; a += 32) y[a] -= step * rate[a];
    push += step;
    if (length < full) {
      release(leaving, false);
    } else {
      saturate(k, length_squared, label, push, 0);
      if (lane == 0) now[k] = bound(k);
      whole = fmax(whole, fabs(bound(k)));
      entering = -1;
      __syncwarp();
    }
  }
  if (count > 0) settle_stopped(stop_rate);
  return !going;
};
