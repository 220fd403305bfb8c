// The rows of a step's tasks that follow from where the bodies are: for one robot, or for a pack of them (lanes.hpp).
#pragma once
#include <type_traits>
#include <vector>

#include "lanes.hpp"
#include "step_layout.hpp"
#include "tasks/kinds.hpp"

namespace osik {

// The rows of task k, given what is at each of their places.
template <class Out, class F> Rows<Out> rows_at(const RowPlaces& of, const StepLayout::Task& task, int k, int nv, F at) {
  const size_t i = task.first;
  Rows<Out> rows{};
  rows.error = at(of.error + i), rows.jacobian = at(of.J + i * nv), rows.lower = at(of.low + i);
  rows.curvature = at(of.curvature + k), rows.pull = at(of.pull + i), rows.levers = at(of.levers + size_t(k) * nv);
  if (task.bounded) rows.upper = at(of.high + i);
  rows.squares = at(of.square + i);
  return rows;
}

// The bodies, and the rows of tasks on frames and on the centre of mass. Real: double, or Lanes<double> for a pack.
template <class Real> struct MovingRows {
  using Number = Real;
  static constexpr bool ALONE = std::is_same_v<Real, double>;
  using In = std::conditional_t<ALONE, const double*, LaneNumbers<double>>;
  using Out = std::conditional_t<ALONE, double*, LaneResults<double>>;
  template <class At, class Number> static At numbers(Number* at, size_t apart) {
    if constexpr (ALONE) return at;
    else return {at, apart};
  }
  const StepLayout& layout;
  const StepSizes& s;
  const RowPlaces at;
  std::vector<Real> q, poses, frames, below, masses, weights;
  std::vector<double> zeros, unbounded;
  Placed<Real*> placed;
  DofColumns<In> columns;
  const double* const* arrays;
  const size_t* apart;
  double* rows;
  Real most_gain;  // 1 / dt

  Leaf<In> leaf(int k) const {
    const StepLayout::Place& place = layout.places[k];
    return {numbers<In>(arrays[place.array] + place.offset, apart[place.array]), place.size};
  }
  In robot(int k) const { return leaf(layout.of_robot[k]).at; }
  // the target velocity of a task
  In velocity(const StepLayout::Task& task) const {
    const int k = task.leaves[TARGET_VELOCITY];
    return k < 0 ? numbers<In>(zeros.data(), 0) : leaf(k).at;
  }

  explicit MovingRows(const StepLayout& layout)
      : layout(layout), s(layout.s), at(s), q(s.nq), poses(12 * s.bodies + 9 * s.dofs), frames(12 * s.nv + 24),
        below(4 * s.bodies), masses(s.bodies), weights(s.rows), zeros(s.rows + 6), unbounded(s.rows, -INFINITE) {
    Real *body = poses.data(), *dof = body + 12 * s.bodies;
    placed = {body, body + 3 * s.bodies, dof, dof + 3 * s.dofs, dof + 6 * s.dofs};
  }
  // Take the arrays of a robot or of a pack, in each of which the robots are `apart`, and place the bodies. constants: as
  // in StepData; rows: of the robots, RowPlaces::end apart
  void place(const double* constants, const double* const* given, const size_t* between, double* to) {
    arrays = given, apart = between, rows = to;
    const Real dt = leaf(layout.of_step[StepLayout::DT]).at[0];
    most_gain = Real(1) / select((dt > Real(0)) & (dt <= Real(LARGEST_DOUBLE)), dt, Real(1));
    const In from = leaf(layout.of_step[StepLayout::Q]).at, offset = robot(StepLayout::OFFSET);
    for (int i = 0; i < s.nq; ++i) q[i] = Real(constants[i]) * from[layout.source[i]] + offset[i];
    place_bodies(Tree<In>{s.bodies, s.joints, s.dofs, layout.parents, layout.types, layout.owners,
                          robot(StepLayout::REFERENCE), robot(StepLayout::POSITION), robot(StepLayout::QUATERNION),
                          robot(StepLayout::ANCHOR), robot(StepLayout::AXIS)},
                 q.data(), placed);
    columns = {s.dofs, s.nv, layout.column, numbers<In>(constants + s.nq, 0)};
  }
  // The rows of task k, if they follow from where the bodies are.
  void add(int k) {
    const StepLayout::Task& task = layout.tasks[k];
    TaskKinds::with(task.kind, [&](auto card) {
      if constexpr (card.MOVES) add(card, task, k);
    });
  }

 private:
  template <class Card> void add(Card card, const StepLayout::Task& task, int k) {
    const int* leaves = task.leaves;
    const Real own_gain = leaf(leaves[GAIN]).at[0], gain = select(own_gain > most_gain, most_gain, own_gain);
    Bounds<In> interval;
    if (task.bounded) {  // a polygon has upper bounds alone
      interval.lower = leaves[LOWER] < 0 ? numbers<In>(unbounded.data(), 0) : leaf(leaves[LOWER]).at;
      interval.upper = leaf(leaves[UPPER]).at;
    }
    auto out = [&](size_t first) { return numbers<Out>(rows + first, at.end); };
    const Rows<Out> to = rows_at<Out>(at, task, k, s.nv, out);
    card.add(*this, task, interval, &gain, to);
    for (int i = 0; i < task.m; ++i) out(at.weight + task.first)[i] = weights[i];
  }
};
}  // namespace osik
