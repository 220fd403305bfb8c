// Levenberg and Marquardt's method for the plan of a clip: descended of retargeting/_plan.py, which says what each
// number is for.
#pragma once
#include "clip_frames.hpp"
#include "manifold.hpp"

namespace osik {

// Numbers of the method, as in retargeting/_plan_kernel.py.
struct ClipMethod {
  double largest_step, stiffening, slowing, fixed, least, stiff, most, calmer, careful, little, settled;
  double stiffness, damping, iterations, until_ready, until_settled;
};

struct ClipPlan {
  ClipRobot& robot;
  const ClipGoals& goals;
  const ClipMethod& method;
  int frames, nq, n, N;
  Banded banded;
  ClipFrames clip;
  Manifold manifold;
  ClipSystem here, there;
  double *before, *step, *damping, *right, *move;  // [n], [n], [F], [F, n], [F, n]

  static size_t doubles(const ClipRobot& robot, int frames) {
    const int n = robot.c.dofs, N = Banded::stride(n);
    return Banded::doubles(frames, N) + ClipFrames::doubles(robot.c, N) + 2 * ClipSystem::doubles(frames, n, N) + 2 * n +
           frames * (1 + 2 * n) + Banded::TILE;
  }
  ClipPlan(ClipRobot& robot, const ClipGoals& goals, const ClipMethod& method, int frames, int nq, double* next)
      : robot(robot), goals(goals), method(method), frames(frames), nq(nq), n(robot.c.dofs), N(Banded::stride(n)),
        banded(n, frames, next), clip(robot, goals, N, next + Banded::doubles(frames, N)),
        manifold{robot.c.scalars, robot.c.quaternions, robot.scalar, robot.quaternion} {
    next += Banded::doubles(frames, N) + ClipFrames::doubles(robot.c, N);
    next = there.place(here.place(next, frames, n, N), frames, n, N);
    before = next, step = before + n, damping = step + n, right = damping + frames, move = right + frames * n;
  }

  // A step beyond the limits of speed, in frames f and f + 1.
  double limit_step(double present, int f, const ClipSystem& out) const {
    double cost = 0.0;
    for (int j = 0; j < n; ++j) {
      const double value = present * step[j], bound = robot.step[j];
      const double over = value - ClipFrames::inside(value, -bound, bound);
      if (over == 0.0) continue;
      const double beyond = robot.weight[ClipRobot::SPEED] / (bound * bound);
      const double weight = robot.weight[ClipRobot::STIFFNESS] * beyond, pull = weight * over;
      const int at = f * n + j, next = at + n;
      cost += 0.5 * beyond * over * over;
      out.alone[at] += weight, out.alone[next] += weight, out.first[next] -= weight;
      out.gradient[at] -= pull, out.gradient[next] += pull;
    }
    return cost;
  }
  // A change of steps, and one beyond the limits of acceleration, in frames f to f + 2.
  Cost limit_change(double present, int f, const ClipSystem& out) const {
    const double* w = robot.weight;
    Cost cost;
    for (int j = 0; j < n; ++j) {
      const double value = present * (step[j] - before[j]), bound = robot.change[j];
      const double smooth = present * (robot.joints[j] >= 0 ? w[ClipRobot::SMOOTH] : w[ClipRobot::SMOOTH_BASE]);
      const double over = value - ClipFrames::inside(value, -bound, bound);
      const double beyond = over != 0.0 ? w[ClipRobot::SPEED] / (bound * bound) : 0.0;
      const double c = smooth + w[ClipRobot::STIFFNESS] * beyond,
                   a = smooth * value + w[ClipRobot::STIFFNESS] * beyond * over;
      const int at = f * n + j, next = at + n, last = next + n;
      cost += {0.5 * smooth * value * value, 0.5 * beyond * over * over};
      out.alone[at] += c, out.alone[next] += 4.0 * c, out.alone[last] += c;
      out.first[next] -= 2.0 * c, out.first[last] -= 2.0 * c, out.second[last] += c;
      out.gradient[at] += a, out.gradient[next] -= 2.0 * a, out.gradient[last] += a;
    }
    return cost;
  }
  // Gauss-Newton's system at the configurations q [F, nq], and the cost there.
  Cost linearise(const double* q, const ClipSystem& out) {
    Cost cost = clip.ask_clip(q, frames, nq, out);
    for (int e = 0; e < frames * n; ++e) out.first[e] = out.second[e] = 0.0;
    for (int f = 0; f + 1 < frames; ++f) {
      const double present = goals.present[f + 1];
      if (present == 0.0) {
        for (int j = 0; j < n; ++j) before[j] = 0.0;
        continue;
      }
      manifold.difference(q + f * nq, q + (f + 1) * nq, step);
      cost.penalty += limit_step(present, f, out);
      if (f > 0) cost += limit_change(present, f - 1, out);
      for (int j = 0; j < n; ++j) before[j] = step[j];
    }
    return cost;
  }
  // Solve the damped system at q and take the step, no longer than the linear model is good for.
  // free: [F] 1 for frames that may move
  void take_step(const ClipSystem& system, const double* free, double its_damping, const double* q, double* candidate) {
    for (int f = 0; f < frames; ++f) {
      damping[f] = free[f] == 1.0 ? its_damping : method.fixed;
      for (int j = 0; j < n; ++j) right[f * n + j] = free[f] * system.gradient[f * n + j];
    }
    banded.solve(system, damping, right, move, frames);
    for (int f = 0; f < frames; ++f) {
      double longest = method.largest_step, *own = move + f * n;
      for (int j = 0; j < n; ++j) own[j] *= -free[f], longest = larger(longest, std::fabs(own[j]));
      for (int j = 0; j < n; ++j) own[j] *= method.largest_step / longest;
      manifold.integrate(q + f * nq, own, candidate + f * nq);
    }
  }
  // Improve q [F, nq]; `other` is space of the same size. Returns the number of iterations; cost: [2] goals, bounds.
  int descend(const double* free, double* q, double* other, double* cost) {
    double stiffness = method.stiffness, its_damping = method.damping, growth = method.careful, settled = 0.0;
    bool ready = false;
    int iterations = 0;
    double* const answer = q;
    robot.weight[ClipRobot::STIFFNESS] = stiffness;
    ClipSystem *now = &here, *next = &there;
    Cost cost_now = linearise(q, *now);
    while (iterations < method.iterations) {
      if ((method.until_settled != 0.0 && settled >= method.settled) || (method.until_ready != 0.0 && ready)) break;
      const double stiffer = ready ? (stiffness * method.stiffening < 1.0 ? stiffness * method.stiffening : 1.0) : stiffness;
      robot.weight[ClipRobot::STIFFNESS] = stiffer;
      take_step(*now, free, its_damping, q, other);
      const Cost cost_next = linearise(other, *next);
      const double old = cost_now.soft + stiffness * cost_now.penalty;
      const double after = cost_next.soft + stiffness * cost_next.penalty, small = method.little * cost_now.soft;
      const bool better = after < old;
      if (stiffness >= 1.0 && old - after < small) settled += int(better) + int(cost_now.penalty < small);
      else if (better) settled = 0.0;
      if (!better && its_damping >= method.most) settled = method.settled;
      const double least = !better || stiffer >= 1.0 ? method.stiff : method.least;
      its_damping = osik::clip(its_damping * (better ? method.calmer : growth), least, method.most);
      growth = better ? method.careful : 2.0 * growth;
      if (better) {
        ready = old - after < method.slowing * old;
        cost_now = cost_next, stiffness = stiffer;
        ClipSystem* const system = now;
        double* const place = q;
        now = next, next = system, q = other, other = place;
      }
      ++iterations;
    }
    cost[0] = cost_now.soft, cost[1] = cost_now.penalty;
    if (q != answer)
      for (int e = 0; e < frames * nq; ++e) answer[e] = q[e];
    return iterations;
  }
};

}  // namespace osik
