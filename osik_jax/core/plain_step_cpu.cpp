// Control steps and integrations of one robot that Python calls by itself, without XLA (control/_plain_step.py). A step is
// used by one thread at a time.
#include <new>

#include "manifold.hpp"
#include "step.hpp"

using namespace osik;

extern "C" {
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
