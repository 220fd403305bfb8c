// Which joint enters or leaves next; -1 for none.

// the size of the numbers that x is made of
auto size_of_numbers = [&](const double* target) {
  double most = 0.0;
  for (int i = lane; i < N; i += 32) most = fmax(most, fabs(x[i]) + scale * fabs(motion[i]) + fabs(target[i]));
  for (int a = lane; a < count; a += 32) most = fmax(most, fabs(bound(who[a])));
  return warp_max(most);
};
auto chosen = [&](double most, int which) {           // of all lanes
  warp_argmax(most, which);
  return which < N ? which : -1;
};
// the saturated joint with the largest multiplier of the wrong sign
auto most_wrong = [&](double roundoff) {
  double most = roundoff;
  int which = N;
  for (int a = lane; a < count; a += 32) {
    const double wrong = at_bound[who[a]] * y[a];
    if (stays[a] == 0 && wrong > most) most = wrong, which = a;
  }
  return chosen(most, which);
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
// the free joint that is furthest beyond its bound
auto most_violated = [&](double roundoff) {
  double most = roundoff;
  int which = N;
  for (int i = lane; i < N; i += 32) {
    if (at_bound[i] != 0 || passed[i] != 0) continue;
    const double beyond = fmax(low[i] - now[i], now[i] - high[i]);
    if (beyond > most) most = beyond, which = i;
  }
  return chosen(most, which);
};
// the saturated joint whose multiplier is the first to be 0, and the dual step there, infinite for none
auto first_to_leave = [&](double sign, double negligible, double& length) {
  int which = N;
  length = INFINITY;
  for (int a = lane; a < count; a += 32) {
    const int label = at_bound[who[a]];
    const double falls = label * sign * rate[a];
    if (stays[a] == 0 && falls < -negligible) {
      const double step = fmax(-label * y[a], 0.0) / -falls;
      if (step < length) length = step, which = a;
    }
  }
  double most = -length;
  warp_argmax(most, which);
  length = -most;
  return which < N ? which : -1;
};
// the saturated joint among those that stop the motion which a further combination releases
auto first_to_cross = [&](double sign, double negligible) {
  double most = 0.0;
  int which = N;
  for (int a = lane; a < count; a += 32) {
    const double falls = -at_bound[who[a]] * sign * rate[a], own = fabs(normal[who[a]]);
    if (stays[a] != 0 && falls > negligible && falls > most * own) most = falls / own, which = a;
  }
  return chosen(most, which);
};
// the saturated joint with the largest rate, where that is more than the entering joint's by this factor
auto largest_rate = [&](double factor) {
  double most = factor;
  int which = N;
  for (int a = lane; a < count; a += 32)
    if (fabs(rate[a]) > most) most = fabs(rate[a]), which = a;
  return chosen(most, which);
};
