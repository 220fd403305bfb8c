// A hierarchy, solved by one warp in double precision: all its levels, and the answer. The problem and the conditions by
// which a level is judged are those of _cascade.py, _working_set_solve.py and _primal_active_set.py in solvers/hqp.
//
// Z, an orthonormal basis of the null space of what the levels so far have frozen, gets narrower from level to level.
// At each level, active hard rows are rotated into its first columns by Householder reflections from the right; the
// level's rows, in the columns that are left, are factored by reflections from the left with column pivoting. The
// working set of the warm start is tried first. Where its solution is not optimal, violated rows become active, rows
// whose multiplier has the wrong sign inactive, and it is solved again, a few times. Where that fails, or there is no
// warm start, a primal active-set method begins where the level above ended. Where that is stationary but for
// directions that the rank tolerance left out, it takes one damped step along them. Rows that the optimum freezes, and
// the row space of the level's factor, are rotated to the front of Z and removed.
//
// A level may have damping (_damping.py): its cost is 1/2 |slack|^2 + 1/2 damping |x|^2. The last level has no rows
// and damping 1: the smallest norm.
//
// This is the end of the body of one function: the other files of this folder stand before it, in the order that
// solvers/hqp/_warp.py says. Where its variables are declared: workspace.cu, problem.cu, level.cu, multipliers.cu.

auto write_skipped_level = [&]() {                    // no freedom is left: nothing is active, nothing in the cost
#pragma unroll
  for (int h = 0; h < H; ++h)
    if (exists[h]) {
      active_rows.data[here * HARD + lane + 32 * h] = 0, frozen_rows.data[here * HARD + lane + 32 * h] = 0;
      multipliers.data[here * HARD + lane + 32 * h] = 0.0;
    }
  if (has_row) {
    active_rows.data[here * HARD + N + lane] = 0, frozen_rows.data[here * HARD + N + lane] = 0;
    multipliers.data[here * HARD + N + lane] = 0.0;
  }
  for (int a = lane; a < M; a += 32) rows_in_cost.data[here * M + a] = 0, own_rows.data[here * M + a] = 0;
  if (lane == 0) ranks.data[here] = 0, slack_norms.data[here] = INFINITY, level_dampings.data[here] = 0.0;
};

bool all_done = true;
double worst_residual = 0.0;
for (;;) {
  begin();
  all_done = true, worst_residual = 0.0;
  for (level = 0; level < LEVELS; ++level) {
    here = problem * LEVELS + level;
    m = COUNT[level], has_inequalities = HAS_INEQUALITIES[level] != 0;
    B = A + OFFSET[level];
    if (width == 0) {
      write_skipped_level();
      continue;
    }
    load_level();
    compute_damping();
    optimal = false;
    const bool starts_feasible = warm && try_warm_start();
    primal_active_set(!starts_feasible, !starts_feasible);
    all_done = all_done && optimal;
    freeze();
    const double terms = size * fmax(size * x_max, root_cost);
    worst_residual = fmax(worst_residual, residual / (terms > 0.0 ? terms : 1.0));
    narrow_box();
    remove_determined();
  }
  // a guess far beyond the answer has left its roundoff there: all levels are solved again without guesses
  if (!warm || (all_done && largest <= MAX_DETOUR * x_max)) break;
  warm = false;
}

#pragma unroll
for (int h = 0; h < H; ++h)
  if (exists[h]) {
    const size_t at = problem * HARD + lane + 32 * h;
    const bool narrowed = bound_label[h] < 0 ? low[h] > hard_lower.data[at] : high[h] < hard_upper.data[at];
    solution.data[problem * N + lane + 32 * h] = x[h];
    active_bounds.data[problem * N + lane + 32 * h] = narrowed ? 0 : bound_label[h];
  }
if (lane == 0) {
  residuals.data[problem] = worst_residual;
  report.data[problem * 3] = all_done;
  report.data[problem * 3 + 1] = changes;
  report.data[problem * 3 + 2] = factorizations;
}
