// What a level leaves to those below: joints that can move no more, the part of its step, and a narrower box.

// `blocking` becomes the joints that stop the motion; returns which of them the others say most about
auto find_blocking = [&]() {
  double most = 0.0;
  int blocker = N;
  __syncwarp();
  for (int i = lane; i < N; i += 32) {
    const double own = stop >= 0 ? fabs(normal[i]) : 0.0;
    blocking[i] = own == 0.0 ? 0 : i == stop ? passed[i] : at_bound[i];
    if (own > most) most = own, blocker = i;
  }
  warp_argmax(most, blocker);
  __syncwarp();
  return blocker < N ? blocker : 0;
};
// takes the joints that stop the level off the coordinates that are left
auto take_off_stops = [&]() {
  int columns = 0;
  __syncwarp();
  for (int i = 0; i < N; ++i) {
    if (blocking[i] == 0) continue;
    for (int j = lane; j < N - first; j += 32) beside[j * D + columns] = turned[(first + j) * D + i];
    ++columns;
  }
  if (columns == 0) return;
  first += take_row_space(columns, D, BLOCKING_RANK);
  for (int i = lane; i < N; i += 32)
    if (blocking[i] != 0)
      for (int j = first; j < N; ++j) turned[j * D + i] = 0.0;
  __syncwarp();
};
// the part of the step from x to `now` at which the damped cost of the level is least
auto damped_part = [&]() {
  double step_square = 0.0, x_square = 0.0, gain = 0.0, cost = 0.0;
  if (!(damping > 0.0)) return 1.0;
  __syncwarp();
  for (int i = lane; i < N; i += 32) {
    along[i] = now[i] - x[i];
    step_square += along[i] * along[i], x_square += x[i] * x[i];
  }
  step_square = warp_sum(step_square), x_square = warp_sum(x_square);
  __syncwarp();
  if (!(step_square > NEGLIGIBLE_STEP * NEGLIGIBLE_STEP * x_square)) return 1.0;
  for (int a = lane; a < m; a += 32) {
    if ((counts[a] & AT_X) == 0) continue;
    const double moved = row_times(a, along);
    gain += moved * wanted[a], cost += moved * moved;
  }
  gain = warp_sum(gain), cost = warp_sum(cost) + damping * step_square;
  const double part = gain / (cost > 0.0 ? cost : 1.0);
  return cost > 0.0 && part < FULL_STEP ? fmax(part, 0.0) : 1.0;
};
// the scale at which the damped cost of the level is least, with the saturated joints on their bounds; `now`, `scale`
// and `normal` are then others
auto best_scale = [&]() {
  double* const begin = normal;
  for (int end = 0; end < 2; ++end) {                 // at the scales 0 and 1
    scale = end;
    settle();
    if (end == 0)
      for (int i = lane; i < N; i += 32) begin[i] = now[i];
  }
  double gain = 0.0, cost = 0.0;
  for (int i = lane; i < N; i += 32) {
    const double forward = now[i] - begin[i];
    gain -= damping * (begin[i] * forward - x[i] * motion[i]), cost += damping * forward * forward;
  }
  for (int a = lane; a < m; a += 32) {
    if ((counts[a] & AT_X) == 0) continue;
    const double moved = row_times(a, motion);
    gain += moved * wanted[a], cost += moved * moved;
  }
  gain = warp_sum(gain), cost = warp_sum(cost);
  return cost > 0.0 ? gain / cost : 1.0;
};
// the box of the levels below (narrow_box of _damping.py): what they may spend of what a level out of reach has gained
auto narrow_box = [&]() {
  const double least = NEGLIGIBLE_DAMPING * longest;
  __syncwarp();
  for (int i = lane; i < N; i += 32)
    bent[i] = fmax(bent[i], bends[here * N + i] / (frobenius > 0.0 ? frobenius : 1.0));
  if (!(unmet > least)) return;
  const double missed = fmin(missed_at(x), demand);
  if (!(unmet * (missed / (demand > 0.0 ? demand : 1.0)) > least)) return;
  double most = 0.0, restricted = 0.0;
  for (int i = lane; i < N; i += 32) most = fmax(most, missed * frobenius * bent[i]);
  most = NEGLIGIBLE_CURVATURE * warp_max(most);
  for (int i = lane; i < N; i += 32) restricted += missed * frobenius * bent[i] > most ? 1.0 : 0.0;
  restricted = warp_sum(restricted);
  const double gain = COST_FRACTION * (demand - missed) * (demand + missed);
  for (int i = lane; i < N; i += 32) {
    const double cost = missed * frobenius * bent[i];
    if (cost > most) {
      const double room = sqrt(fmax(gain / (restricted * cost), 0.0)) + MIN_RADIUS;
      low[i] = fmax(low[i], x[i] - room), high[i] = fmin(high[i], x[i] + room);
    }
  }
  __syncwarp();
};
