// One control step in one call: what control/_step.py defines, for the tasks that control/_compiled_step.py takes.
//
//   rows of all tasks and the box (step_rows.hpp) -> damping -> the scheme's solver -> certificate -> velocity
//
// Statuses, and what is returned with each, are those of the definition.
#pragma once
#include "certificates.hpp"
#include "saturation.hpp"
#include "step_rows.hpp"

namespace osik {

class Step : StepRows {
 public:
  Step(const int* given, int count) : StepRows(given, count) { begin_solvers(); }
  using StepRows::find_pack, StepRows::has;

  // clean: whether no number of the arrays is NaN; robot: as in find_rows
  void take(const StepData& d, const StepResult& to, bool clean, int robot = -1) {
    const int n = s.nv;
    const bool valid = find_rows(d, clean, robot);
    contradicts = false;
    std::fill(to.integers, to.integers + 3 + s.labels(), 0);
    if (s.scheme == CLASSICAL || s.scheme == SATURATED) to.integers[2] = s.L - 1;
    if (s.scheme == CLASSICAL) to.integers[1] = s.L - 1;
    int status = NUMERICAL_ERROR;
    Certificate found{false, d.constants[s.nq + s.dofs]};
    if (valid) {
      found = s.scheme == WEIGHTED       ? solve_weighted(d, to)
              : s.scheme == HIERARCHICAL ? solve_hierarchy(d, to)
                                         : solve_null_space(to);
      const bool finite = found.residual <= LARGEST_DOUBLE && all_finite(to.numbers, n);
      status = !finite ? NUMERICAL_ERROR : !ordered || contradicts ? INFEASIBLE : found.holds ? SOLVED : MAX_ITERATIONS;
    }
    for (int j = 0; j < n && status == NUMERICAL_ERROR; ++j)
      to.numbers[j] = s.scheme == CLASSICAL ? 0
                                            : nearest(0, lower[j] < INFINITE ? lower[j] : -INFINITE,
                                                      upper[j] > -INFINITE ? upper[j] : INFINITE);
    to.integers[0] = status;
    report(to, status == NUMERICAL_ERROR ? d.constants[s.nq + s.dofs] : found.residual);
  }

 private:
  // ---- damping of some tasks (schemes/_scheme.py)
  struct Bending {
    double bound, damping;  // of the curvature, and the part of it that is damped
  };
  // VelocityProblem.curvature, with near_part and fraction_to_damp of tasks/_curvature.py
  template <class Chosen> Bending curvature_of(Chosen chosen) {
    double *stiffness = parts.data(), *far = stiffness + s.tasks, *to_damp = far + s.tasks, farthest = 0;
    int count = 0;
    for (int k = 0; k < s.tasks; ++k) {
      const Task& task = tasks[k];
      if (!chosen(task) || (task.dofs && !task.bounded)) continue;
      double distance = 0, held = 0, divisor = curvature[k] > 0 ? curvature[k] : 1;
      for (int i = 0; i < task.m && !task.bounded; ++i) {
        distance += task.rows.error[i] * (task.weight[i] * (task.rows.pull[i] / divisor));
        held += task.weight[i] * task.rows.squares[i];
      }
      const double ratio = square(clip(distance / NEAR_ERROR, 0.0, FARTHEST_ERROR));
      bounds[count] = dt * curvature[k], stiffness[count] = held, far[count] = task.bounded ? -1 : ratio / (1 + ratio);
      farthest = larger(farthest, bounds[count] > 0 ? far[count] : 0.0), ++count;
    }
    for (int i = 0; i < count; ++i) {
      if (far[i] >= 0) bounds[i] *= NEAR_PART + (1 - NEAR_PART) * farthest;
      const double total = 0.5 * bounds[i] + stiffness[i], resisted = stiffness[i] / (total > 0 ? total : 1);
      to_damp[i] = bounds[i] * (far[i] >= 0 ? 1 - (1 - UNHELD_PART) * far[i] * resisted : 1.0);
    }
    return {safe_norm(bounds.data(), count), safe_norm(to_damp, count)};
  }
  // VelocityProblem.bends, with row_sums of tasks/_curvature.py; returns the largest
  template <class Chosen> double find_bends(Chosen chosen, double* own) {
    const int n = s.nv;
    double *farthest = center.data(), largest = 0, sum = 0, most = 0;
    int before = 0;
    for (int j = 0; j < n; ++j) farthest[j] = 0;
    for (int k = 0; k < s.tasks; ++k)
      if (chosen(tasks[k]))
        for (int j = 0; j < n; ++j) farthest[j] = layout.turning[j] ? larger(farthest[j], levers[k * n + j]) : 0.0;
    for (int j = 0; j < n; ++j) largest = larger(largest, farthest[j]);
    for (int j = 0; j < n; ++j) {  // the lever of the one farther from the root
      const bool moves = farthest[j] > LEVER_ROUNDOFF * largest;
      farthest[j] = moves ? farthest[j] : 0.0, own[j] = farthest[j] * before, before += moves;
    }
    for (int j = n - 1; j >= 0; --j) {
      sum += farthest[j], own[j] += farthest[j] > 0 ? sum : 0.0;
      own[j] = layout.scalar[j] >= 0 ? dt * own[j] : 0.0, most = larger(most, own[j]);
    }
    return most;
  }
  // VelocityProblem.curvature_above: what the postures of a level cannot meet, the rows above it balance; what other tasks
  // cannot meet, closed loops above it
  double curvature_above(int level) {
    double *force = parts.data(), curved = 0;
    int count = 0;
    bool loops = false;
    for (const Task& task : tasks) {
      for (int i = 0; i < task.m && task.dofs && task.level == level; ++i)
        force[count++] = task.weight[i] * task.rows.pull[i];
      loops |= task.level < level && task.closes_loop;
    }
    if (!level || !(count || loops)) return 0;
    const double linear = count ? safe_norm(force, count) * bending([&](const Task& task) { return task.level < level; })
                                : 0;
    if (!loops) return linear;
    for (const Task& task : tasks) {
      if (task.dofs || task.level != level) continue;
      std::fill_n(force, s.nv, 0.0);
      for (int i = 0; i < task.m; ++i)
        for (int j = 0; j < s.nv; ++j) force[j] += task.rows.jacobian[i * s.nv + j] * (task.weight[i] * task.rows.pull[i]);
      const double both[] = {curved, safe_norm(force, s.nv)};
      curved = safe_norm(both, 2);
    }
    const double both[] = {linear,
                           curved * bending([&](const Task& task) { return task.level < level && task.closes_loop; })};
    return safe_norm(both, 2);
  }
  // VelocityProblem._bending: the curvature of tasks for a unit force in the joints
  template <class Chosen> double bending(Chosen chosen) {
    double squares = 0;
    for (const Task& task : tasks)
      for (int i = 0; i < task.m && chosen(task); ++i) squares += task.weight[i] * task.rows.squares[i];
    return find_bends(chosen, above.data()) / (squares > 0 ? sqrt(squares) : 1.0);
  }

  // ---- the weighted scheme (schemes/_weighted.py)
  Numbers solver_space, qp_bounds, diagonal, compliance, multipliers, above, hard_and_soft;
  bool contradicts;  // whether no velocity of the box satisfies the rows of limits
  std::vector<WeightedQP<Team>> qp;
  std::vector<QPCertificate<Team>> certificate;

  Certificate solve_weighted(const StepData& d, const StepResult& to) {
    const int n = s.nv, N = n + s.p;
    const Bending bending = curvature_of([](const Task&) { return true; });
    const double bound = kappa * bending.bound, rest = kappa * bending.damping;
    std::fill_n(diagonal.data(), n, damping), std::fill_n(center.data(), n, 0.0);
    std::copy_n(low_speed.data(), n, qp_bounds.data()), std::copy_n(high_speed.data(), n, &qp_bounds[N]);
    for (const Task& task : tasks)
      for (int i = 0; i < task.m && task.diagonal; ++i) {
        const int dof = task.dofs[i];
        diagonal[dof] += task.weight[i], center[dof] += task.weight[i] * task.rows.lower[i];
      }
    each_entry(n, [&](auto e) {
      const auto given = e(diagonal.data()), total = bound + DIAGONAL_RATIO * given, one = decltype(given + given)(1);
      const auto sum = given + rest * (bound / select(total > 0.0, total, one)), held = select(sum < 0.0, 0.0 * one, sum);
      e.put(held, diagonal.data()), e.put(e(center.data()) / select(held > 0.0, held, one), center.data());
    });
    if (!all_finite(diagonal.data(), n)) return {false, INFINITE};
    const int soft = s.p - limit_rows;
    for (int i = 0; i < soft; ++i) {  // a row of weight 0 has no bounds
      const double own = weight[s.m + i];
      compliance[i] = 1 / (own > 0 ? own : 1);
      qp_bounds[n + i] = own > 0 ? order(low[s.m + i], high[s.m + i], -1) : -INFINITE;
      qp_bounds[N + n + i] = own > 0 ? order(low[s.m + i], high[s.m + i], 1) : INFINITE;
    }
    if (limit_rows) add_hard(soft);
    QPData<double> data{};
    data.matrix = J, data.target = low, data.weight = weight, data.damping = diagonal.data(), data.center = center.data();
    data.rows = limit_rows ? hard_and_soft.data() : J + s.m * n, data.compliance = compliance.data();
    data.lower = qp_bounds.data(), data.upper = qp_bounds.data() + N, data.tolerance = tolerances[0];
    data.guess = d.guess ? d.guess : no_labels.data();
    int* active = to.integers + 3;
    Certificate found = certificate[0].solve(qp[0], data, {to.numbers, multipliers.data(), active, to.integers},
                                             tolerances[1], true);
    contradicts = to.integers[0] == LEAST_VIOLATION;
    if (!found.holds && !contradicts) {
      const double longest = limit_rows ? qp[0].longest_row() : 0;
      for (int i = soft; i < s.p; ++i) compliance[i] = longest > 0 ? longest : 1;
      move_downhill(data, to.numbers);
      for (int i = 0; i < N; ++i) active[i] = i < n && data.lower[i] == data.upper[i] ? EQUALITY : INACTIVE;
      found.residual = certificate[0].judge(data, to.numbers, zeros.data(), active, tolerances[1]).residual;
    }
    for (int j = 0; j < n; ++j) to.numbers[j] = nearest(to.numbers[j], lower[j], upper[j]);
    return found;
  }
  // The rows of limits behind the soft ones, which a step without them takes from where all rows are.
  void add_hard(int soft) {
    const int n = s.nv, N = n + s.p;
    std::copy_n(J + s.m * n, soft * n, hard_and_soft.data());
    int i = soft;
    each_hard([&](Hard rows) {
      std::copy_n(rows.jacobian.at, rows.jacobian.size, &hard_and_soft[i * n]);
      for (int k = 0; k < rows.lower.size; ++k, ++i) {
        compliance[i] = 0;
        qp_bounds[n + i] = order(rows.lower[k], rows.upper[k], -1),
                      qp_bounds[N + n + i] = order(rows.lower[k], rows.upper[k], 1);
      }
    });
  }
  // A point of the box that is no worse than zero: solvers/qp/_projected_gradient.py. The rows are soft.
  void move_downhill(const QPData<double>& d, double* x) {
    const int n = s.nv, rows = s.m + s.p;
    double *size = center.data() + n, *gradient = size + n;
    auto stiffness = [&](int i) { return i < s.m ? d.weight[i] : 1 / d.compliance[i - s.m]; };
    auto row = [&](int i) { return i < s.m ? d.matrix + i * n : d.rows + (i - s.m) * n; };
    for (int j = 0; j < n; ++j) x[j] = nearest(0, d.lower[j], d.upper[j]), size[j] = d.damping[j];
    for (int i = 0; i < rows; ++i) {
      double length = 0;
      for (int j = 0; j < n; ++j) length += fabs(row(i)[j]);
      for (int j = 0; j < n; ++j) size[j] += stiffness(i) * length * fabs(row(i)[j]);
    }
    for (int step = 0; step < GRADIENT_STEPS; ++step) {
      for (int j = 0; j < n; ++j) gradient[j] = d.damping[j] * (x[j] - d.center[j]);
      for (int i = 0; i < rows; ++i) {
        const int q = n + i - s.m;
        const double value = Team::own_dot(row(i), x, 0, n);
        const double force = stiffness(i) * (value - (i < s.m ? d.target[i] : nearest(value, d.lower[q], d.upper[q])));
        for (int j = 0; j < n; ++j) gradient[j] += force * row(i)[j];
      }
      for (int j = 0; j < n; ++j) x[j] = nearest(x[j] - gradient[j] / (size[j] > 0 ? size[j] : 1), d.lower[j], d.upper[j]);
    }
  }

  // ---- levels (schemes/_scheme.py)
  Numbers level_rows, level_lower, level_upper, hard, hard_lower, hard_upper, dampings, bends, found_numbers;
  std::vector<int> equality, pinned, found_labels;

  // the rows of all levels, their weights' roots multiplied in, and the hard ones among them
  void add_levels() {
    const int n = s.nv;
    std::vector<int>& end = found_labels;  // rows of each level so far
    for (int k = 0; k < s.L; ++k) end[k] = 0;
    for (int j = 0; j < n; ++j)
      hard_lower[j] = low_speed[j], hard_upper[j] = high_speed[j], pinned[j] = lower[j] >= upper[j];
    for (const Task& task : tasks)
      for (int i = 0; i < task.m; ++i) {
        const int row = task.level * s.m + end[task.level]++;
        const double own = task.weight[i], root = positive_root(own);
        const double low = task.rows.lower[i], high = task.bounded ? task.rows.upper[i] : low;
        const double a = order(low, high, -1), b = order(low, high, 1);
        for (int j = 0; j < n; ++j) level_rows[row * n + j] = root * task.rows.jacobian[i * n + j];
        equality[row] = !task.bounded || (a >= b && own > 0);
        if (own > 0)
          level_lower[row] = fabs(a) < INFINITE ? root * a : a, level_upper[row] = fabs(b) < INFINITE ? root * b : b;
        else level_lower[row] = task.bounded ? -INFINITE : 0, level_upper[row] = task.bounded ? INFINITE : 0;
      }
    for (int i = n; i < s.h; ++i) {
      const int row = layout.level_of_hard[i] * s.m + layout.row_of_hard[i - n];
      for (int j = 0; j < n; ++j) hard[(i - n) * n + j] = level_rows[row * n + j];
      hard_lower[i] = level_lower[row], hard_upper[i] = level_upper[row], pinned[i] = equality[row];
    }
  }
  // the damping of each level: VelocityProblem.dampings
  void add_dampings() {
    for (int level = 0; level + 1 < s.L; ++level) {
      auto chosen = [&](const Task& task) { return task.level == level; };
      const double factor = (level ? BELOW_OTHERS : 1.0) * kappa;
      double* own = &bends[level * s.nv];
      dampings[3 * level] = damping;
      dampings[3 * level + 1] = factor * curvature_of(chosen).damping + kappa * curvature_above(level);
      int count = 0;
      for (const Task& task : tasks)
        for (int i = 0; i < task.m && chosen(task); ++i) parts[count++] = positive_root(task.weight[i]) * task.rows.pull[i];
      dampings[3 * level + 2] = safe_norm(parts.data(), count);
      find_bends(chosen, own);
      for (int j = 0; j < s.nv; ++j) own[j] *= factor;
    }
  }

  // ---- the hierarchy (schemes/_hierarchical.py)
  std::vector<char> hierarchy_space;
  std::vector<Hierarchy<Team>> hierarchy;

  Sizes sizes() const {
    return {s.L, s.m, s.nv, s.h, s.max_iterations, layout.row_counts, layout.level_of_hard, layout.row_of_hard};
  }
  Certificate solve_hierarchy(const StepData& d, const StepResult& to) {
    const int n = s.nv, L = s.L, h = s.h, m = s.m;
    add_levels();
    add_dampings();
    bool valid = true;
    for (const Numbers* v : {&dampings, &bends})
      for (double a : *v) valid &= a >= 0 && a <= LARGEST_DOUBLE;
    if (!valid) return {false, INFINITE};
    Problem p{};
    p.matrix = level_rows.data(), p.lower = level_lower.data(), p.upper = level_upper.data(), p.equality = equality.data();
    p.hard = hard.data(), p.hard_lower = hard_lower.data(), p.hard_upper = hard_upper.data(), p.pinned = pinned.data();
    p.damping = dampings.data(), p.bends = bends.data(), p.tolerances = tolerances, p.row = n, p.column = 1;
    p.guess_hard = d.guess ? d.guess : no_labels.data(), p.guess_own = d.guess ? d.guess_own : no_labels.data();
    double* f = found_numbers.data();
    int *i = found_labels.data(), *active = to.integers + 3, report[3];
    const Answer a{to.numbers, f,     f + L * h,     f + L * h + L,  f + L * h + 2 * L,     i,
                   active,     i + n, i + n + L * h, active + L * h, i + n + L * h + L * m, report};
    hierarchy[0].solve(p, a);
    to.integers[0] = 0, to.integers[1] = report[1], to.integers[2] = report[2];
    const Certificate found = judge(sizes(), p, a);
    for (int j = 0; j < n; ++j)
      to.numbers[j] = nearest(a.active_bounds[j] ? a.active_bounds[j] < 0 ? lower[j] : upper[j] : to.numbers[j], lower[j],
                              upper[j]);
    return found;
  }

  // ---- the projections (schemes/_null_space.py)
  Numbers targets, separate, scales;  // [L, n] only the last level has a target; damping of each level [3, L]; [L]
  std::vector<ClassicalProjection<Team>> projection;
  std::vector<Saturation<Team>> saturation;

  // descent of the joint-limit potential (limit_potential_gradient); returns whether it is finite
  bool find_descent(double* out) {
    const double potential_gain = *of_step(StepLayout::POTENTIAL_GAIN), margin = *of_step(StepLayout::MARGIN);
    double *from = center.data(), *to = from + s.nv;
    int count = 0;
    auto has_potential = [&](int j) {  // two finite limits, and a range
      const double narrow = NARROW_RANGE * EPSILON * larger(fabs(from[j]), fabs(to[j]));
      return from[j] > -INFINITE && to[j] < INFINITE && to[j] - from[j] > narrow;
    };
    for (int j = 0; j < s.nv; ++j) {
      from[j] = -INFINITE, to[j] = INFINITE;
      for (const int* limit = layout.limits; limit < layout.limits + 5 * s.limits && layout.scalar[j] >= 0; limit += 5)
        if (limit[0] == RANGE) from[j] = larger(from[j], leaf(limit[1])[j]), to[j] = least(to[j], leaf(limit[2])[j]);
      count += has_potential(j);
    }
    for (int j = 0; j < s.nv; ++j) {
      double gradient = 0;
      if (has_potential(j)) {
        const double span = to[j] - from[j], angle = of_step(StepLayout::Q)[layout.scalar[j]];
        const double at = nearest(angle, from[j] + margin * span, to[j] - margin * span);
        gradient = span * (2 * at - to[j] - from[j]) / (2 * count * square(to[j] - at) * square(at - from[j]));
      }
      out[j] = -potential_gain * gradient;
    }
    return all_finite(out, s.nv);
  }
  Certificate solve_null_space(const StepResult& to) {
    const int n = s.nv, L = s.L, m = s.m, own = L - 1;  // the last level has no rows: the secondary motion
    double *x = to.numbers, *secondary = &targets[own * n];
    add_levels();
    add_dampings();
    if (!find_descent(secondary) || !all_finite(dampings.data(), 3 * L) || !all_finite(bends.data(), L * n))
      return {false, INFINITE};
    if (s.scheme == CLASSICAL) {
      projection[0].rank_tol = *of_step(StepLayout::RANK_TOLERANCE);
      projection[0].begin();
      for (int k = 0; k < own; ++k)
        projection[0].solve_level({&level_rows[k * m * n], &level_lower[k * m], &level_upper[k * m], &bends[k * n],
                                   &equality[k * m], dampings[3 * k], dampings[3 * k + 1], dampings[3 * k + 2],
                                   layout.row_counts[k], n, 1});
      projection[0].end(secondary, x, nullptr);
      return {true, first_residual(x, x, 1)};
    }
    for (int k = 0; k < 3 * L; ++k) separate[k % 3 * L + k / 3] = dampings[k];
    remove_roundoff();
    int *sides = found_labels.data(), report[2];
    SaturationProblem p{};
    p.matrix = level_rows.data(), p.lower = level_lower.data(), p.upper = level_upper.data(), p.equality = equality.data();
    p.constant = separate.data(), p.unmet = p.constant + L, p.demand = p.unmet + L, p.bends = bends.data();
    p.targets = targets.data(), p.low = low_speed.data(), p.high = high_speed.data();
    p.rank_tol = *of_step(StepLayout::RANK_TOLERANCE), p.max_changes = s.max_iterations;
    p.L = L, p.m = m, p.row = n, p.column = 1;
    saturation[0].solve(p, {x, nullptr, scales.data(), sides, sides + L, sides + L + L * n, sides + L + 2 * L * n,
                            sides + 2 * L + 2 * L * n, report});
    to.integers[1] = report[1], to.integers[2] += report[1];
    for (int j = 0; j < n; ++j) center[j] = nearest(0, lower[j], upper[j]);
    return {report[0] != 0, first_residual(x, center.data(), scales[0])};
  }
  // entries that are roundoff of their row are 0 (solvers/null_space/_padding.py)
  void remove_roundoff() {
    const int n = s.nv;
    for (int i = 0; i < s.L * s.m; ++i) {
      double* row = &level_rows[i * n];
      double largest = 0;
      for (int j = 0; j < n; ++j) largest = larger(largest, fabs(row[j]));
      for (int j = 0; j < n; ++j) row[j] = fabs(row[j]) <= tolerances[0] * largest ? 0 : row[j];
    }
  }
  // Largest entry of the gradient of what the first level misses of its motion from `start` at this scale.
  double first_residual(const double* x, const double* start, double scale) {
    const int n = s.nv;
    double *gradient = &separate[3 * s.L], largest = 0;
    for (int j = 0; j < n; ++j) gradient[j] = 0;
    for (const Task& task : tasks)
      for (int i = 0; i < task.m && task.level == 0; ++i) {
        const double *row = task.rows.jacobian + i * n, begun = Team::own_dot(row, start, 0, n);
        const double off = begun -
                           nearest(begun, task.rows.lower[i], task.bounded ? task.rows.upper[i] : task.rows.lower[i]);
        const double missed = larger(task.weight[i], 0.0) * (Team::own_dot(row, x, 0, n) - begun + scale * off);
        for (int j = 0; j < n; ++j) gradient[j] += missed * row[j];
      }
    for (int j = 0; j < n; ++j)
      if (s.scheme == CLASSICAL || lower[j] != upper[j]) largest = larger(largest, fabs(gradient[j]));
    return largest <= LARGEST_DOUBLE ? largest : LARGEST_DOUBLE;
  }

  void begin_solvers() {
    const int n = s.nv, L = s.L, h = s.h, m = s.m;
    above.resize(n);
    if (s.scheme == WEIGHTED) {
      const QPSizes of{m, n, s.p, s.max_iterations};
      solver_space.resize(WeightedQP<Team>::bytes(of) / sizeof(double));
      hard_and_soft.resize((limit_rows ? s.p * n : 0) + 8), qp_bounds.resize(2 * (n + s.p)), diagonal.resize(n + 8),
          compliance.resize(s.p), multipliers.resize(s.p);
      qp.emplace_back(of, reinterpret_cast<char*>(solver_space.data()));
      certificate.emplace_back(of, reinterpret_cast<char*>(solver_space.data()));
      return;
    }
    level_rows.resize(L * m * n + 8), level_lower.assign(L * m, -INFINITE), level_upper.assign(L * m, INFINITE);
    hard.resize((h - n) * n + 8), hard_lower.resize(h), hard_upper.resize(h), equality.resize(L * m), pinned.resize(h);
    dampings.resize(3 * L), bends.resize(L * n), found_numbers.resize(L * h + 2 * L + 1);
    found_labels.resize(n + L * (2 + larger(h, n) + larger(m, n)));
    if (s.scheme == HIERARCHICAL) {
      dampings[3 * L - 3] = 1;  // the last level has no rows: the smallest velocity
      hierarchy_space.resize(Hierarchy<Team>::bytes(sizes()));
      hierarchy.emplace_back(sizes(), hierarchy_space.data());
      return;
    }
    targets.resize(L * n), separate.resize(3 * L + n), scales.resize(L);
    const NullSpaceSizes sizes{n, m};
    solver_space.resize(Saturation<Team>::bytes(sizes) / sizeof(double));
    char* space = reinterpret_cast<char*>(solver_space.data());
    if (s.scheme == CLASSICAL) projection.emplace_back(sizes, space);
    else saturation.emplace_back(sizes, space);
  }

  // slack and error of each row, in the order of the tasks' names; what is not finite is 0
  void report(const StepResult& to, double residual) {
    const int n = s.nv;
    double *v = to.numbers, *slack = v + n + 2, *errors = slack + s.rows, outside = 0;
    auto finite = [](double a) { return fabs(a) <= LARGEST_DOUBLE ? a : 0.0; };
    for (int j = 0; j < n; ++j) outside = larger(outside, larger(finite(lower[j] - v[j]), finite(v[j] - upper[j])));
    each_hard([&](Hard rows) {
      for (int i = 0; i < rows.lower.size; ++i) {
        const double value = Team::own_dot(rows.jacobian.at + i * n, v, 0, n);
        outside = larger(outside, larger(finite(rows.lower[i] - value), finite(value - rows.upper[i])));
      }
    });
    v[n] = residual, v[n + 1] = outside;
    for (const Task& task : tasks)
      for (int i = 0; i < task.m; ++i) {
        double off = 0;
        if (task.valid) {
          const double a = task.rows.lower[i], b = task.bounded ? task.rows.upper[i] : a;
          off = task.dofs ? v[task.dofs[i]] : Team::own_dot(task.rows.jacobian + i * n, v, 0, n);
          off = a == a && b == b ? off - nearest(off, a, b) : 0;
        }
        slack[task.out + i] = finite(off), errors[task.out + i] = task.valid ? finite(task.rows.error[i]) : 0.0;
      }
  }
};
}  // namespace osik
