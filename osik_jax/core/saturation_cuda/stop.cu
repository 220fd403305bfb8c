// The joints that stop the motion: a combination that the null space does not change, and the scale that it allows.

// the scale at which joint k, whose column saturated joints make up, is on its bound with them; and its rate
auto scale_of = [&](int k, int label, double least, double& its_rate) {
  double largest = 1.0, gap_of_others = 0.0, rate_of_others = 0.0;
  __syncwarp();
  for (int j = first + lane; j < first + count; j += 32) {  // the rates once more, for rounding
    double total = 0.0;
#pragma unroll 4
    for (int a = 0; a < count; ++a) total += rate[a] * turned[j * D + who[a]];
    turn[j] -= total;
  }
  __syncwarp();
  for (int a = lane; a < count; a += 32) rate[a] += dual_times(a, turn), largest = fmax(largest, fabs(rate[a]));
  largest = warp_max(largest);
  for (int a = lane; a < count; a += 32) {
    if (fabs(rate[a]) > least * largest) {
      gap_of_others += rate[a] * (bound(who[a]) - x[who[a]]), rate_of_others += rate[a] * motion[who[a]];
    } else {
      rate[a] = 0.0;
    }
  }
  const double its_gap = (label < 0 ? low[k] : high[k]) - x[k] - warp_sum(gap_of_others);
  its_rate = motion[k] - warp_sum(rate_of_others);
  __syncwarp();
  return its_rate != 0.0 ? clip(its_gap / its_rate, 0.0, 1.0) : 1.0;
};
// joint k, and those that its column is made of, stop the motion: no other is beside its bounds or let go
auto stop_by = [&](int k, int label) {
  __syncwarp();
  for (int i = lane; i < N; i += 32) normal[i] = i == k ? 1.0 : 0.0, passed[i] = i == k ? label : 0;
  __syncwarp();
  for (int a = lane; a < count; a += 32) stays[a] = rate[a] != 0.0, normal[who[a]] = -rate[a];
  stop = k;
  __syncwarp();
};
// settles, at the scale near this one that puts the joint that stops the motion on its bound, so many times at most
auto settle_stopped = [&](int passes, double its_rate) {
  while (passes > 0) {
    settle();
    const double off = stop < 0 ? 0.0 : bound_passed(stop) - now[stop];
    if (off == 0.0 || --passes == 0) break;
    scale = clip(scale + off / its_rate, 0.0, 1.0);
  }
};
