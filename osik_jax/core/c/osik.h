/* Control steps of a controller that osik_jax.save_controller wrote, without Python.
 *
 * Configurations q and velocities are as in osik_jax: radians, metres, quaternions w x y z. Entries have names, because
 * their order is that of the robot's tree, which no other program has to share: osik_find tells where each is.
 *
 * A controller holds the working memory of its steps: one thread at a time may use it. Load one for each thread. Its
 * answers depend on their arguments alone. Only osik_load and osik_free allocate or free memory. No function throws.
 */
#ifndef OSIK_H
#define OSIK_H
#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif
#if defined(__GNUC__)
#define OSIK_API __attribute__((visibility("default")))
#else
#define OSIK_API
#endif

typedef struct osik_controller osik_controller;

/* Result of a step; numbers and velocities are those of osik_jax.Status and osik_jax.solve. */
typedef enum {
  OSIK_SOLVED = 0,
  OSIK_MAX_ITERATIONS = 1, /* no optimum was found; the velocity is inside the limits and no worse than standing still */
  OSIK_INFEASIBLE = 2,     /* two limits contradict each other at this configuration */
  OSIK_NUMERICAL_ERROR = 3 /* q or a target is not finite, a quaternion or a direction is 0, or a matrix no rotation; the
                              velocity is 0, or the nearest one inside the limits */
} osik_status;

/* Vectors with named entries. */
typedef enum {
  OSIK_Q,        /* configuration: "elbow"; of a free joint "base.x", ..., "base.qw", ... */
  OSIK_VELOCITY, /* "elbow"; of a free joint "base.vx", ... in world axes, "base.wx", ... in its own */
  OSIK_TARGETS   /* all targets, one after another; all entries of one have its name, such as "hand.target[0]" */
} osik_vector;

/* Return the controller of a file, or NULL.
 * message: size bytes for one sentence that says why there is none; may be NULL. */
OSIK_API osik_controller* osik_load(const char* path, char* message, size_t size);
OSIK_API void osik_free(osik_controller* controller); /* NULL is allowed */

/* Return the number of entries of a vector. */
OSIK_API int osik_size(const osik_controller* controller, osik_vector vector);
/* Return the name of an entry, which lives as long as the controller; NULL if there is no such entry. */
OSIK_API const char* osik_name(const osik_controller* controller, osik_vector vector, int index);
/* Return the index of the first entry with a name, -1 if there is none. */
OSIK_API int osik_find(const osik_controller* controller, osik_vector vector, const char* name);
/* Write the file's own values: the home configuration, velocities of 0, the targets of the tasks. */
OSIK_API void osik_initial(const osik_controller* controller, osik_vector vector, double* values);
/* Return the time of a step [s]. */
OSIK_API double osik_period(const osik_controller* controller);

/* Compute the velocity of one step.
 * q: configuration.
 * targets: of all tasks; NULL for those of the file. A pose is a position [m], "NAME.target[0]", and a rotation matrix
 *   by rows, "NAME.target[1]" (9 entries; rounded ones become the nearest rotation). A centre of mass is "NAME.target"
 *   [m], a point to look at too; a direction has any length but 0. A posture is a configuration, "NAME.target".
 * velocity: the result, finite whatever the status. */
OSIK_API osik_status osik_step(osik_controller* controller, const double* q, const double* targets, double* velocity);

/* Write the configuration that is reached from q at this velocity in the time of a step; next may be q. */
OSIK_API void osik_integrate(osik_controller* controller, const double* q, const double* velocity, double* next);

#ifdef __cplusplus
}
#endif
#endif
