// Saturation in the null space, all levels of a problem by one warp in double precision. The problem is the one that
// solvers/null_space/_saturation.py states; the method is that of Numba's kernel (kernels/numba/_saturation.py), part
// by part: the motion of a level in coordinates of the null space, then joints put on their bounds by a dual method in
// these coordinates, and the joints that stop the level taken off them.
//
// The motion has one way where Numba's kernel has quicker ones beside it: reflections that bring the level's row space
// to the front of the coordinates, and orthogonal factors of its rows there.
//
// This is the end of the body of one function: the other files of this folder stand before it, in the order that
// solvers/null_space/_warp.py says. Where its variables are declared: workspace.cu, problem.cu, level.cu, saturated.cu.

// moves x as the level asks and returns the scale; what it takes are the coordinates before `first`
auto solve_level = [&](bool& done, int& blocker, int& its_changes) {
  load_level();
  set_beside();
  compute_damping();
  look(x);
  find_motion();
  first += rank;
  done = false, its_changes = 0;
  for (int pass = 0; pass < 2 && !done && (pass == 0 || its_changes < max_iterations); ++pass) {
    done = attempt(pass == 0 ? SATURATION_RANK : LOOSE_SATURATION_RANK);
    its_changes += changes;
  }
  blocker = label_joints();
  if (!done) {
    for (int i = lane; i < N; i += 32) at_bound[i] = blocking[i] = 0;
    narrow_box();
    return 0.0;
  }
  const double part = damped_part();
  for (int i = lane; i < N; i += 32) x[i] = part == 1.0 ? now[i] : x[i] + part * (now[i] - x[i]);
  narrow_box();
  take_off_stops();
  return part * scale;
};

bool all_done = true;
int all_changes = 0;
for (level = 0; level < LEVELS; ++level) {
  here = problem * LEVELS + level;
  A = matrix.data + here * (N * M);
  bool done;
  int blocker, its_changes;
  const double its_scale = solve_level(done, blocker, its_changes);
  all_done = all_done && done, all_changes += its_changes;
  for (int i = lane; i < N; i += 32) {
    fixed[i] = fixed[i] == 0 ? blocking[i] : fixed[i];
    joints_at_bounds.data[here * N + i] = at_bound[i], joints_blocking.data[here * N + i] = blocking[i];
  }
  if (lane == 0) scales.data[here] = its_scale, dones.data[here] = done, blockers.data[here] = blocker;
  __syncwarp();
}

for (int i = lane; i < N; i += 32) {
  // a joint may have stopped at the trust region of its level, or damped on its way to the bound
  const int label = fixed[i] != 0 ? fixed[i] : at_bound[i];
  const double its_bound = label < 0 ? given_low[i] : given_high[i];
  const bool is_away = label * label == 1 && fabs(x[i] - its_bound) > BOUND_DISTANCE * (1.0 + fabs(its_bound));
  solution.data[problem * N + i] = x[i];
  active_joints.data[problem * N + i] = is_away ? 0 : label;
}
for (int i = 0; i < N; ++i)
  for (int k = lane; k < N; k += 32) {
    double total = 0.0;
#pragma unroll 4
    for (int j = first; j < N; ++j) total += turned[j * D + i] * turned[j * D + k];
    projectors.data[(problem * N + i) * N + k] = total;
  }
if (lane == 0) report.data[problem * 2] = all_done, report.data[problem * 2 + 1] = all_changes;
