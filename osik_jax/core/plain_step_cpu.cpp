// Control steps and integrations of one robot that Python calls by itself, without XLA (control/_plain_step.py). A step is
// used by one thread at a time.
#include <new>

#include "collision.hpp"
#include "manifold.hpp"
#include "near_rows.hpp"
#include "step.hpp"

using namespace osik;

namespace {
// The rows of a CollisionAvoidanceLimit of one robot.
struct PlainRows {
  const ShapedRobot<double> robot;
  std::vector<double> near, space, distance;
  std::vector<int> pair;
  NearRows<Collision<double>> rows;

  PlainRows(const int* integers, const double* numbers, int most)
      : robot(integers, numbers), near(rows.space_of(most, most, false)), space(12 * robot.bodies + 9 * robot.dofs),
        distance(most), pair(4 * most), rows(robot, most, most, false, near.data()) {}
  void find(const double* q, const double* limit, double* J, double* lower) {
    double *position = space.data(), *turn = position + 3 * robot.bodies, *axes = turn + 9 * robot.bodies;
    const int dofs = 3 * robot.dofs;
    place_bodies(robot.tree(), Configuration<const double*>{q, robot.factor, robot.offset, robot.source},
                 Placed<double*>{position, turn, axes, axes + dofs, axes + 2 * dofs});
    rows.find(Alone{}, true, Placed<const double*>{position, turn, axes, axes + dofs, axes + 2 * dofs},
              AvoidanceNumbers<double>{limit[0], limit[1], limit[2], limit[3], limit[4]}, J, lower, distance.data(),
              pair.data());
  }
};
}  // namespace

extern "C" {
// Rows that keep shapes apart. The arrays of the robot stay where they are; those of a scene are copied.
void* osik_plain_rows_new(const int* robot_integers, const double* robot_numbers, int most) {
  try {
    return new PlainRows(robot_integers, robot_numbers, most);
  } catch (const std::bad_alloc&) { return nullptr; }
}
void osik_plain_rows_free(void* rows) { delete static_cast<PlainRows*>(rows); }
void osik_plain_rows_set(void* rows, const int* scene_integers, const double* scene_numbers) {
  auto& own = *static_cast<PlainRows*>(rows);
  own.rows.set({scene_integers, scene_numbers, own.robot.shapes});
}
void osik_plain_rows(void* rows, const double* q, const double* limit, double* J, double* lower) {
  static_cast<PlainRows*>(rows)->find(q, limit, J, lower);
}

// layout: of control/_compiled_step.py. NULL: there is no memory.
void* osik_plain_new(const int* layout, int count) {
  try {
    return new Step(layout, count);
  } catch (const std::bad_alloc&) { return nullptr; }
}
void osik_plain_free(void* step) { delete static_cast<Step*>(step); }

// given: all numbers of the step; clean: whether none of them is NaN; results as in StepResult.
void osik_plain_step(void* step, const double* constants, const double* given, const int* guess, const int* guess_own,
                     int clean, double* numbers, int* integers) {
  constexpr size_t APART = 0;  // of the robots in a batch: there is one
  static_cast<Step*>(step)->take({constants, &given, &APART, 1, guess, guess_own}, {numbers, integers}, clean != 0);
}

// The fields of Manifold, then the configuration, the velocity of a unit of time, and the result.
void osik_plain_integrate(int scalars, int quaternions, const int* scalar, const int* quaternion, const double* q,
                          const double* v, double* next) {
  Manifold{scalars, quaternions, scalar, quaternion}.integrate(q, v, next);
}
}
