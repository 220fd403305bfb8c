// The joints that are on their bounds: the first `count` coordinates that are left have all of them.
int count = 0, stop = -1;                             // stop: the joint that stops the motion; -1 for none
double scale = 1.0;

auto bound = [&](int i) { return at_bound[i] > 0 ? high[i] : low[i]; };
auto bound_passed = [&](int i) { return passed[i] < 0 ? low[i] : high[i]; };
auto dual_times = [&](int a, const double* v) {       // the dual of a saturated joint times v, of the coordinates
  return dot(v + first, duals + a * D + first, 1, count);
};
// `now` at the scale with the saturated joints on their bounds, and their multipliers; refined once
auto settle = [&]() {
  __syncwarp();
  for (int i = lane; i < N; i += 32) now[i] = x[i] + scale * motion[i] + target_part[i];
  for (int a = lane; a < count; a += 32) y[a] = 0.0;
  for (int pass = 0; pass < 2 && count > 0; ++pass) {
    __syncwarp();
    for (int a = lane; a < count; a += 32) gap[a] = bound(who[a]) - now[who[a]];
    __syncwarp();
    for (int j = first + lane; j < first + count; j += 32) place[j] = dot(gap, duals + j, D, count);
    __syncwarp();
    for (int i = lane; i < N; i += 32) now[i] += column_times(place, i, first, first + count);
    for (int a = lane; a < count; a += 32) y[a] += dual_times(a, place);
  }
  __syncwarp();
};
// what of column k saturated joints make up, `rate`, and how all move along the rest; returns its squared length
auto look_along = [&](int k) {
  __syncwarp();
  for (int j = first + lane; j < N; j += 32) turn[j] = turned[j * D + k];
  __syncwarp();
  double total = 0.0;
  for (int a = lane; a < count; a += 32) rate[a] = dual_times(a, turn);
  for (int i = lane; i < N; i += 32) along[i] = column_times(turn, i, first + count, N);
  for (int j = first + count + lane; j < N; j += 32) total += turn[j] * turn[j];
  __syncwarp();
  return warp_sum(total);
};
// makes joint k the last of the saturated ones, after `look_along`
auto saturate = [&](int k, double length_squared, int label, double multiplier, int its_stay) {
  const int head = first + count;
  reflect(head, sqrt(length_squared), head, N);
  for (int j = head + 1 + lane; j < N; j += 32) turned[j * D + k] = 0.0;
  const double pivot = turned[head * D + k];
  for (int a = lane; a < count; a += 32) duals[a * D + head] = -rate[a] / pivot;
  for (int j = first + lane; j <= head; j += 32) duals[count * D + j] = j == head ? 1.0 / pivot : 0.0;
  if (lane == 0) who[count] = k, stays[count] = its_stay, y[count] = multiplier, at_bound[k] = label;
  ++count;
  __syncwarp();
};
// releases a saturated joint, to where it has no multiplier if it moves
auto release = [&](int a, bool moves) {
  const int end = first + count, last = end - 1;
  double* const own = duals + a * D;
  double total = 0.0;
  __syncwarp();
  for (int i = lane; i < N; i += 32) along[i] = column_times(own, i, first, end);
  __syncwarp();
  for (int b = lane; b < count; b += 32) rate[b] = (b == a ? 1.0 : 0.0) - along[who[b]];
  __syncwarp();
  for (int j = first + lane; j < end; j += 32) {      // once more, for rounding
    own[j] += dot(rate, duals + j, D, count);
    turn[j] = own[j], total += own[j] * own[j];
  }
  const double length_squared = warp_sum(total);
  __syncwarp();
  for (int i = lane; i < N; i += 32) along[i] = column_times(own, i, first, end);
  const double by = moves ? y[a] / length_squared : 0.0;
  __syncwarp();
  if (by != 0.0) {
    for (int i = lane; i < N; i += 32) now[i] -= by * along[i];
    for (int b = lane; b < count; b += 32) y[b] -= by * dual_times(b, own);
  }
  const double weight = reflect(last, sqrt(length_squared), first, end);
  if (lane == 0) {
    at_bound[who[a]] = 0;
    who[a] = who[count - 1], stays[a] = stays[count - 1], y[a] = y[count - 1];
  }
  for (int j = first + lane; j < end; j += 32) own[j] = duals[(count - 1) * D + j];
  __syncwarp();
  for (int b = lane; b < count - 1; b += 32) {
    subtract(duals + b * D + first, 1, turn + first, weight * dual_times(b, turn), last - first);
    duals[b * D + last] = turned[last * D + who[b]] = 0.0;
  }
  __syncwarp();
  --count;
};
