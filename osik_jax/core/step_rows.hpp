// Rows of all tasks of one control step, its box, and what both are computed from: what control/_compiled_step.py lays out.
//
//   configuration -> bodies -> rows of all tasks; limits -> box
//
// The rows of task k are rows first .. first + m of the matrix of all rows. The weighted scheme has the equalities of
// frames and of the centre of mass first (`dense` rows), then the inequalities (`intervals`), then the equalities of
// single dofs, which are terms of its diagonal.
#pragma once
#include "moving_rows.hpp"
#include "serial.hpp"

namespace osik {

enum StepStatus { SOLVED = 0, MAX_ITERATIONS = 1, INFEASIBLE = 2, NUMERICAL_ERROR = 3 };

// What is given of one step, and what it returns.
struct StepData {
  const double* constants;        // factors of the configuration [nq] and of the dofs [dofs], largest number, tolerances
  const double* const* arrays;    // of this robot; a leaf of numbers is in one of them
  const size_t* apart;            // for each array, from a robot to the next; 0 if they share it
  int count;                      // of the arrays; leaves of integers are behind them
  const int *guess, *guess_own;   // labels of the warm start, those of a hierarchy's levels beside them; null for none
};
struct StepResult {
  double* numbers;  // velocity [nv], residual, violation of the box, slacks and errors of all rows
  int* integers;    // status, iterations, factorizations, labels for the next warm start
};

// The point of [low, high] next to a; the upper end of an interval whose ends are the wrong way round.
inline double nearest(double a, double low, double high) {
  const double raised = a < low ? low : a;
  return raised > high ? high : raised;
}

inline double positive_root(double a) { return a > 0 ? sqrt(a) : 0; }
// The smaller one; NaN if one is.
template <class Real> Real least(Real a, Real b) { return select((a != a) | (a < b), a, b); }

// The Euclidean norm, whose squares neither overflow nor underflow.
inline double safe_norm(const double* v, int count) {
  double size = 0, squares = 0;
  for (int i = 0; i < count; ++i) size = larger(size, fabs(v[i]));
  if (!(size > 0 && size < INFINITE)) size = 1;
  for (int i = 0; i < count; ++i) squares += square(v[i] / size);
  return size * sqrt(squares);
}

// The rows and the box of a step at hand. Robots of a batch have their rows computed in packs.
struct StepRows {
  using Team = Serial<double>;
  using Numbers = std::vector<double>;
  using Pack = Lanes<double>;
  struct Task : StepLayout::Task {
    const int* dofs;  // of rows that each ask for the velocity of one dof [m]; null for other rows
    bool valid = true;
    Rows<double*> rows = {};
    double* weight = nullptr;

    bool closes_loop = false;

    explicit Task(const StepLayout::Task& of) : StepLayout::Task(of) {
      TaskKinds::with(kind, [&](auto card) {
        dofs = card.dofs(of) < count ? options + card.dofs(of) : nullptr, closes_loop = card.closes_loop(of);
      });
    }
  };
  StepLayout layout;
  const StepSizes& s;
  const RowPlaces place;
  MovingRows<double> own;
  MovingRows<Pack> packed;
  std::vector<Task> tasks;
  Numbers numbers;  // RowPlaces of each robot of a pack
  double *J, *low, *high, *weight, *levers, *curvature;  // of the robot at hand
  Numbers bounds, parts, center, lower, upper, low_speed, high_speed, zeros;
  std::vector<int> no_labels;
  const double* const* arrays;  // of the step at hand
  const double* tolerances;
  double dt, damping, kappa;
  bool ordered;  // whether no lower bound is above its upper one
  int limit_rows = 0;

  StepRows(const int* given, int count)
      : layout(given, count), s(layout.s), place(s), own(layout), packed(layout), numbers(Pack::COUNT * place.end) {
    center.resize(3 * s.nv + 8), zeros.resize(s.rows + s.nq + 1), no_labels.resize(s.labels()), bounds.resize(s.tasks);
    parts.resize(s.rows + s.nv + 3 * s.tasks + 8);
    for (Numbers* v : {&lower, &upper, &low_speed, &high_speed}) v->resize(s.nv);
    for (const StepLayout::Task& task : layout.tasks) tasks.emplace_back(task);
    for (int k = 0; k < s.limits; ++k)
      limit_rows += layout.limits[5 * k] == HARD_ROWS ? layout.places[layout.limits[5 * k + 2]].size : 0;
  }
  bool has(const int* given, int count) const { return layout.has(given, count); }

  // The rows of a pack of robots, the first of which is given.
  void find_pack(const StepData& d) {
    packed.place(d.constants, d.arrays, d.apart, numbers.data());
    for (int k = 0; k < s.tasks; ++k) packed.add(k);
  }
  Leaf<const double*> leaf(int k) const {
    const StepLayout::Place& place = layout.places[k];
    return {arrays[place.array] + place.offset, place.size};
  }
  bool is_finite(const Task& task, int own) const {
    const auto numbers = leaf(task.leaves[own]);
    return all_finite(numbers.at, numbers.size);
  }
  const double* of_step(int k) const { return leaf(layout.of_step[k]).at; }
  // f(rows) of each limit with rows. Leaves: Jacobian, lower and upper bounds.
  struct Hard {
    Leaf<const double*> jacobian, lower, upper;
  };
  template <class F> void each_hard(F f) const {
    for (const int* limit = layout.limits; limit < layout.limits + 5 * s.limits; limit += 5)
      if (limit[0] == HARD_ROWS) f(Hard{leaf(limit[1]), leaf(limit[2]), leaf(limit[3])});
  }
  // Whether a number of these leaves is NaN.
  bool spoiled(int from, int to, int count) const {
    for (int k = from; k < to; ++k)
      if (layout.places[k].array < count && has_nan(leaf(k).at, leaf(k).size)) return true;
    return false;
  }

  // ---- box, kinematics and rows of tasks; returns whether all numbers are valid
  // robot: its place in its pack, whose rows are there; -1 for a robot alone
  bool find_rows(const StepData& d, bool clean, int robot) {
    arrays = d.arrays, ordered = true;
    use(robot < 0 ? 0 : robot);
    const double* given = of_step(StepLayout::Q);
    dt = *of_step(StepLayout::DT), damping = *of_step(StepLayout::DAMPING), kappa = *of_step(StepLayout::CURVATURE_DAMPING);
    tolerances = d.constants + s.nq + s.dofs + 1;
    if (!(dt > 0)) dt = NAN;
    const int first = layout.of_step[StepLayout::DAMPING], end = layout.of_step[StepLayout::DT];
    const bool has_box = find_box(given) && has_hard_rows(),
               set_up = dt <= LARGEST_DOUBLE && (clean || !spoiled(first, end, d.count));
    const bool finite = all_finite(given, s.given);
    bool valid = has_box && set_up && finite;
    if (!(dt <= LARGEST_DOUBLE)) dt = 1;
    const bool is_placed = finite && (clean || !spoiled(0, layout.of_step[StepLayout::Q], d.count));
    if (is_placed && robot < 0) own.place(d.constants, arrays, d.apart, numbers.data());
    for (int k = 0; k < s.tasks; ++k) {
      Task& task = tasks[k];
      TaskKinds::with(task.kind, [&](auto card) {
        task.valid = is_placed && (clean || !card.is_spoiled(*this, task, d.count));
        if (task.valid) valid = add(card, k, given, robot < 0) && valid;
      });
      valid = valid && task.valid;
    }
    return valid;
  }
  // Let the rows be those of a robot of the pack.
  void use(int robot) {
    double* at = &numbers[robot * place.end];
    J = at + place.J, low = at + place.low, high = at + place.high, weight = at + place.weight, levers = at + place.levers;
    curvature = at + place.curvature;
    for (int k = 0; k < s.tasks; ++k) {
      Task& task = tasks[k];
      task.rows = rows_at<double*>(place, task, k, s.nv, [&](size_t first) { return at + first; });
      task.weight = weight + task.first;
    }
  }
  // A bound of the solver's: where they are the wrong way round, both are in the middle (solvers/_box.py).
  template <class Real> static Real order(Real low, Real high, int side) {
    return select(low > high, 0.5 * (low + high), side < 0 ? low : high);
  }
  // limits/_box.py: of ConfigurationLimit and VelocityLimit, or as it is given. What depends on NaN is NaN. The classical
  // projection has no box, whatever its bounds are.
  bool find_box(const double* given) {
    const int nv = s.nv, *box = layout.of_step + StepLayout::BOX;
    double *angle = parts.data(), *a = lower.data(), *b = upper.data();
    for (int j = 0; j < nv; ++j) {
      const double at = layout.scalar[j] < 0 ? 0.0 : given[layout.scalar[j]];
      angle[j] = fabs(at) < INFINITE || at != at ? at : 1;
      a[j] = *box < 0 ? -INFINITE : leaf(box[0]).at[j], b[j] = *box < 0 ? INFINITE : leaf(box[1]).at[j];
    }
    bool valid = true;
    for (const int* limit = layout.limits; limit < layout.limits + 5 * s.limits; limit += 5) {
      if (limit[0] == HARD_ROWS) continue;
      const Leaf<const double*> low = leaf(limit[1]), high = leaf(limit[2]), gain = leaf(limit[3]), speed = leaf(limit[4]);
      const bool of_speed = limit[0] == SPEED;
      valid &= of_speed || all_finite(gain.at, gain.size);
      if (*box < 0) each_entry(nv, [&](auto e) { narrow(e, of_speed, e.of(low), e.of(high), e.of(gain), e.of(speed)); });
    }
    each_entry(nv, [&](auto e) {
      const auto from = e(a), to = e(b);
      if (s.scheme != CLASSICAL) valid &= !any(!((from < INFINITE) & (to > -INFINITE))), ordered &= !any(!(from <= to));
      e.put(order(from, to, -1), low_speed.data()), e.put(order(from, to, 1), high_speed.data());
    });
    return valid;
  }
  // Whether a solver takes the rows of limits.
  bool has_hard_rows() {
    bool valid = true;
    each_hard([&](Hard rows) {
      valid &= all_finite(rows.jacobian.at, rows.jacobian.size);
      for (int i = 0; i < rows.lower.size; ++i) {
        valid &= rows.lower[i] < INFINITE && rows.upper[i] > -INFINITE;
        ordered &= !(rows.lower[i] > rows.upper[i]);
      }
    });
    return valid;
  }
  // Narrow the box at some dofs by a limit on the speed, or by a range that is to be kept.
  template <class E, class Real> void narrow(E e, bool of_speed, Real low, Real high, Real gain, Real speed) {
    Real from = -high, to = high;
    if (!of_speed) {
      const Real at = e(parts.data()), none = INFINITE;
      const auto alone = e.are(layout.scalar, -1);  // no range
      auto reach = [&](Real bound, double inward) {  // rounded inward
        const Real way = bound - at, found = gain * (way + inward * RANGE_ROUNDOFF * EPSILON * fabs(way)) / Real(dt);
        return select(fabs(bound) < none, found, bound);
      };
      from = reach(select(alone, -none, low), 1), to = reach(select(alone, none, high), -1);
      to = -least(-to, speed), from = least(least(from, speed), to);
    }
    const Real first = e(lower.data()), last = e(upper.data());
    auto narrowed = [&](Real bound) {
      const Real raised = select(bound < first, first, bound), within = select(raised > last, last, raised);
      return select((first != first) | (bound != bound), Real(NAN), within);
    };
    e.put(narrowed(from), lower.data()), e.put(narrowed(to), upper.data());
  }
  // The rows of a task, and whether a solver takes them.
  template <class Card> bool add(Card card, int k, const double* given, bool alone) {
    Task& task = tasks[k];
    if constexpr (card.IS_COMPUTED) return card.add(*this, task);
    else {
      const int m = task.m, *leaves = task.leaves;
      const double gain = *leaf(leaves[GAIN]).at;
      const double* velocity = leaves[TARGET_VELOCITY] < 0 ? zeros.data() : leaf(leaves[TARGET_VELOCITY]).at;
      bool takes = card.takes(*this, task);
      task.valid = fabs(gain) <= LARGEST_DOUBLE && all_finite(velocity, card.velocities(m)) && card.is_valid(*this, task);
      for (int i = 0; i < m && task.bounded; ++i)
        takes &= (leaves[LOWER] < 0 || leaf(leaves[LOWER]).at[i] < INFINITE) && leaf(leaves[UPPER]).at[i] > -INFINITE;
      if constexpr (!card.MOVES) card.add(*this, task, given, velocity, gain > 1 / dt ? 1 / dt : gain);
      else if (task.valid && alone) own.add(k);
      for (int i = 0; i < m; ++i) task.valid &= fabs(task.weight[i]) <= LARGEST_DOUBLE;
      return takes && are_taken(task);
    }
  }
  // Whether a solver takes the rows of a task.
  bool are_taken(const Task& task) {
    bool takes = task.bounded || all_finite(task.rows.lower, task.m);
    for (int i = 0; i < task.m; ++i) {
      const bool counts = task.weight[i] > 0 || s.scheme != WEIGHTED;  // a row of weight 0 has no bounds
      takes &= task.weight[i] >= 0 || counts || task.bounded || task.diagonal;
      if (task.bounded && counts && task.rows.lower[i] > task.rows.upper[i]) ordered = false;
    }
    // squared lengths are finite only where all entries of the rows are
    return takes && (task.dofs || all_finite(task.rows.squares, task.m) || all_finite(task.rows.jacobian, task.m * s.nv));
  }
  // rows of the identity, and their squared lengths
  void put_dofs(const Task& task) {
    for (int i = 0; i < task.m; ++i) {
      task.rows.squares[i] = 1;
      for (int j = 0; j < s.nv && !task.diagonal; ++j) task.rows.jacobian[i * s.nv + j] = j == task.dofs[i];
    }
  }
};
}  // namespace osik
