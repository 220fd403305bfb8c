// A QP in a box, with soft rows, solved by one warp in single precision: the method, and the answer.
//
//     min 1/2 sum_r weight_r (A x - target)_r^2 + 1/2 sum_i damping_i (x_i - center_i)^2
//         + 1/2 sum_q t_q^2 / compliance_q
//     over lower <= [x; C x + t] <= upper
//
// Block pivoting: solve on the working set by a Cholesky factor and iterative refinement; violated bounds become
// active, those whose multiplier has the wrong sign inactive, all at once, until there are none (J. J. Judice, F. M. Pires, "A
// block principal pivoting algorithm for large-scale strictly monotone linear complementarity problems", 1994). Where
// that has ceased to reduce their number, the dual active-set method of Goldfarb and Idnani (GI, see
// _goldfarb_idnani.py) goes on from the working set. It cannot cycle: one constraint at a time, one factorisation each.
// An active soft row is a row of the cost.
//
// This is the end of the body of one function: the other files of this folder stand before it, in the order that
// solvers/qp/_single.py says. Its variables are declared in workspace.cu and problem.cu.

while (!hard && factorizations < MAX_FACTORIZATIONS && changes <= max_iterations) {
  if (has_row) {
    row_weights[M + lane] = row_label == FREE ? 0.f : 1.f / row_compliance;
    row_targets[M + lane] = row_label == FREE ? 0.f : row_label == AT_UPPER ? row_high : row_low;
  }
  __syncwarp();
  factor();
  refine();
  const int wrong_count = find_wrong_labels();
  converged = wrong_count == 0 && entering < 0;
  patience = wrong_count < fewest_wrong ? MAX_EXCHANGES : patience - 1;
  fewest_wrong = wrong_count < fewest_wrong ? wrong_count : fewest_wrong;
  use_dual = use_dual || patience < 0;
  if (converged) break;
  // the dual method first drops wrong multipliers, as its start requires
  const bool drops = entering < 0 && releases_any();
  if (use_dual && !drops) dual_step();
  else exchange_labels(use_dual);
}

#pragma unroll
for (int h = 0; h < H; ++h)
  if (exists[h]) {
    solution[problem * N + index[h]] = x[h];
    active[problem * CONSTRAINTS + index[h]] = label[h];
  }
if (has_row) {
  row_multipliers[problem * P + lane] = row_multiplier;
  active[problem * CONSTRAINTS + N + lane] = row_label;
}
if (lane == 0) {
  report[problem * 3] = converged;
  report[problem * 3 + 1] = changes;
  report[problem * 3 + 2] = factorizations;
}
