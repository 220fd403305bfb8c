// Saturation in the null space, all levels of a problem by one warp in double precision. The problem is the one that
// solvers/null_space/_saturation.py states; the method is that of core/saturation.hpp, part by part:
// the motion of a level in coordinates of the null space, then joints put on their bounds by a dual method in
// these coordinates, and the joints that stop the level taken off them.
//
// The motion has one way where the core has a quicker one beside it: reflections that bring the level's row space
// to the front of the coordinates, and orthogonal factors of its rows there.
//
// This is the end of the body of one function: the other files of this folder stand before it, in the order that
// solvers/null_space/_cuda.py says. Where its variables are declared: workspace.cu, problem.cu, level.cu, saturated.cu.

// finds the end of the level's motion, or what comes before it where that has the least damped cost, from a part of the
// straight way to the end on; returns the scale. A search for the end has up to three attempts, the second and the
// third with a compliance. `ended`: how (STRAIGHT, PART, WHOLE), 0 where the search has not
auto go_along = [&](int& ended, int& blocker, int& its_changes) {
  double* const kept = solution + problem * N;   // which is written last, and so are the labels
  int* const kept_labels = joints_at_bounds + here * N;
  double at = 1.0, below = 0.0, above = 1.0, whole = 1.0, its_scale = 0.0;
  int number = 0;                                     // of the attempt at this scale
  bool goes_on = false;                               // from the joints that the attempt before has saturated
  ended = blocker = its_changes = 0;
  for (int searches = 0; searches <= PATH_SEARCHES && its_changes < max_iterations;) {
    const int own = MAX_SATURATION_CHANGES * N;
    most_changes = max_iterations - its_changes;
    if (number == 0 && own < most_changes) most_changes = own;
    const double least = number == 0 ? SATURATION_RANK : SOFT_SATURATION_RANK;
    const double compliance = number == 0 ? 0.0 : number == 1 ? SATURATION_COMPLIANCE : STIFFER_SATURATION_COMPLIANCE;
    const bool went_on = goes_on, done = attempt(at, least, compliance, goes_on);  // one place in the program for all
    its_changes += changes;
    goes_on = done && number == 0 && count > 0;
    if (!done && went_on) continue;                   // once more, from none
    if (!done && number < 2 && at == 1.0 && first > 0) {
      ++number;
      continue;
    }
    number = 0;
    double part = 1.0, best = 0.0;
    bool keeps = true;
    double* const reached = ended == 0 || at == 1.0 ? now : along;
    if (ended == 0) {                                 // the end of the path
      if (!done) break;
      blocker = find_blocking(), ended = STRAIGHT;
      part = damped_part();
      above = whole = scale, its_scale = part * scale;
      if (part == 1.0) ended = WHOLE;
    } else if (at == 1.0) {                           // the end once more
      if (!done) break;
      blocker = find_blocking(), ended = WHOLE, its_scale = scale;
    } else {
      ++searches;
      if (!done || stop >= 0) break;
      const double tried = scale;
      for (int i = lane; i < N; i += 32) along[i] = now[i];
      best = best_scale();
      keeps = ended == STRAIGHT || best >= at * (1.0 - PATH_STEP);  // beyond the least cost the path gets dear
      if (keeps) ended = PART, its_scale = tried;
    }
    for (int i = lane; keeps && i < N; i += 32) {
      kept[i] = part == 1.0 ? reached[i] : x[i] + part * (reached[i] - x[i]);
      // the joint that stops the motion is on its bound in the place of the blocker
      kept_labels[i] = stop >= 0 && i == blocker ? 0 : i == stop ? passed[i] : at_bound[i];
    }
    if (ended == WHOLE) break;
    if (ended == STRAIGHT) {
      at = its_scale;
      if (!(at > 0.0)) break;
      continue;
    }
    if (best >= whole * (1.0 - PATH_STEP) && above == whole) {
      below = at;
      at = at > whole * (1.0 - PATH_END) ? 1.0 : whole * (1.0 - 0.5 * PATH_END);
      continue;
    }
    if (fabs(best - at) <= PATH_STEP * at) break;
    if (best > at) below = at;
    else above = at;
    at = below < best && best < above ? best : 0.5 * (below + above);
  }
  for (int i = lane; i < N; i += 32) {
    if (ended == 0) blocking[i] = 0;
    else x[i] = kept[i];
    at_bound[i] = ended == 0 ? 0 : kept_labels[i];
  }
  __syncwarp();
  return its_scale;
};
// moves x as the level asks and returns the scale; what it takes are the coordinates before `first`
auto solve_level = [&](int& ended, int& blocker, int& its_changes) {
  load_level();
  look();
  set_beside();
  compute_damping();
  find_motion();
  first += rank;
  const double its_scale = go_along(ended, blocker, its_changes);
  narrow_box();
  if (ended != 0) take_off_stops();
  return its_scale;
};

bool all_done = true;
int all_changes = 0;
for (level = 0; level < LEVELS; ++level) {
  here = problem * LEVELS + level;
  A = matrix + here * (N * M);
  int ended, blocker, its_changes;
  const double its_scale = solve_level(ended, blocker, its_changes);
  all_done = all_done && ended != 0, all_changes += its_changes;
  for (int i = lane; i < N; i += 32) {
    fixed[i] = fixed[i] == 0 ? blocking[i] : fixed[i];
    joints_at_bounds[here * N + i] = at_bound[i], joints_blocking[here * N + i] = blocking[i];
  }
  if (lane == 0) scales[here] = its_scale, dones[here] = ended, blockers[here] = blocker;
  __syncwarp();
}

for (int i = lane; i < N; i += 32) {
  // a joint may have stopped at the trust region of its level, or damped on its way to the bound
  const int label = fixed[i] != 0 ? fixed[i] : at_bound[i];
  const double its_bound = label < 0 ? given_low[i] : given_high[i];
  const bool is_away = label * label == 1 && fabs(x[i] - its_bound) > BOUND_DISTANCE * (1.0 + fabs(its_bound));
  solution[problem * N + i] = x[i];
  active_joints[problem * N + i] = is_away ? 0 : label;
}
for (int i = 0; i < N; ++i)
  for (int k = lane; k < N; k += 32) {
    double total = 0.0;
#pragma unroll 4
    for (int j = first; j < N; ++j) total += turned[j * D + i] * turned[j * D + k];
    projectors[(problem * N + i) * N + k] = total;
  }
if (lane == 0) report[problem * 2] = all_done, report[problem * 2 + 1] = all_changes;
