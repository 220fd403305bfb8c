// Constants of the methods. Those that plain JAX has too are in numerics/_constants.py, which says what each is; a test
// compares them.
#pragma once

namespace osik {

constexpr double EPSILON = 2.220446049250313e-16;

// damping of a level, and the box that it leaves to the levels below
constexpr int DAMPING_ITERATIONS = 3;
constexpr double BLOCKING_PART = 1e-5, DAMPING_RIDGE = 1e-13, NEGLIGIBLE_DAMPING = 1e-13, COST_FRACTION = 0.1,
                 MIN_RADIUS = 1e-6, NEGLIGIBLE_CURVATURE = 1e-6, TIE_ROUNDOFF = 100.0;

// hierarchy
constexpr int MAX_STALLED = 20;
constexpr double STATIONARITY_TOL = 10.0, DAMPED_RANK = 1e-14, EXTRA_DAMPING = 1e-9;

// labels of constraints
constexpr int INACTIVE = 0, AT_LOWER = -1, AT_UPPER = 1, EQUALITY = 2, REDUNDANT = 3;

// weighted QP; SINGLE_... in single precision
constexpr double SINGLE_CORRECTION = 1e-6, SINGLE_RIDGE = 1.0, ZERO_TOL = 100.0, BOUND_MULTIPLIER = 1.0,
                 SINGLE_BOUND_MULTIPLIER = 0.03, INFEASIBLE_COMPLIANCE = 1e-11, SINGLE_INFEASIBLE_COMPLIANCE = 1e-6,
                 FARKAS_RADIUS = 1e3, FARKAS_ROUNDOFF = 1e-14, FARKAS_MARGIN = 1e-3;

// certificates, and the point without one
constexpr int GRADIENT_STEPS = 100;
constexpr double ROW_MULTIPLIER = 1e-3, BOX_TOLERANCE = 10.0, MAX_RESIDUAL = 10.0;

// tasks of a step
constexpr double DIAGONAL_RATIO = 30.0, BELOW_OTHERS = 2.0, LEVER_ROUNDOFF = 1e-6, UNHELD_PART = 0.04, NEAR_ERROR = 0.06,
                 NEAR_PART = 0.4, FARTHEST_ERROR = 1e6, RANGE_ROUNDOFF = 8.0, POINTING_SINE_SQUARED = 1e-3, BEHIND = -0.5,
                 LEAST_SINE = 0.1, NEAREST_SIGHT = 1e-3, CONE_TIP = 0.01;

// rotations, collision
constexpr double SMALL_SINE_SQUARED = 1e-6, SMALL_ANGLE_SQUARED = 1e-2, PARALLEL = 1e-6, TOUCH = 1e-6, SINGLE_TOUCH = 2e-5;

// null space
constexpr double NARROW_RANGE = 1e4;

// saturation
constexpr int STRAIGHT = 1, PART = 2, WHOLE = 3;
constexpr int PATH_SEARCHES = 6;
constexpr double NEGLIGIBLE_STEP = 1e-11, FULL_STEP = 0.999999999, PATH_STEP = 1e-9, PATH_END = 1e-6, BLOCKING_RANK = 1e-6,
                 BOUND_DISTANCE = 1e-9, SATURATION_RESIDUAL = 2e-9, SATURATION_ROUNDOFF = 1e-11, NEGLIGIBLE_ENTRY = 1e-7;

// ---- of kernels alone

// Saturation: two limits of an accepted answer. The scale may be larger by at most this much, according to the change by the null
// space of the combination of joints that stops the motion. A joint may leave its bound according to its multiplier
// by at most this much, relative to the terms that add up to x.
constexpr double SATURATION_LOSS = 1e-8;
// A joint is dependent if the part of its unit vector in the null space and outside the span of the saturated joints
// is below this. A joint whose entry in a combination is below this share of the largest does not stop the motion.
constexpr double SATURATION_RANK = 1e-9;
// Compliance of the missing part of the motion in the second and third attempt, which follow if nearly dependent
// joints spoil the first answer. It is the squared length of x that the missing part outweighs. A larger compliance
// makes it more certain that no larger scale is possible.
constexpr double SATURATION_COMPLIANCE = 1e-12, STIFFER_SATURATION_COMPLIANCE = 1e-13;
// SATURATION_RANK in these attempts: the missing part is a coordinate there, so few joints depend on others.
constexpr double SOFT_SATURATION_RANK = 1e-11;
// Number of times that a search resumes because rounding gave a multiplier of the wrong sign at its end.
constexpr int SIGN_CHECKS = 3;
// Changes of the active set per variable after which the first attempt ends, because rounding makes it cycle. Later
// attempts may use all remaining iterations.
constexpr int MAX_SATURATION_CHANGES = 5;
// Factor by which a joint's coefficient in a dependent combination must exceed the entering joint's to take its
// place.
constexpr double LARGEST_RATE = 10.0;
// Part of a constraint's diagonal left by the active constraints, relative to the square of the constraint's normal,
// below which it is dependent: the factors are orthogonal.
constexpr double KERNEL_DEPENDENCE = 1e-14;
// Hierarchy: largest intermediate x of a warm start, in units of the answer. Tolerances are relative to x, and HARD_ROW_TOL
// of an x larger by this factor is still the residual of a SOLVED answer.
constexpr double MAX_DETOUR = 100.0;
// Compliance of contradicting rows while their active set is searched for, and roundoff of a sum in a Farkas certificate in
// single precision.
constexpr double SEARCHED_COMPLIANCE = 1e-7, SINGLE_FARKAS_ROUNDOFF = 2e-6;
// Certificate of a weighted QP, in units of the tolerance: distance of a value from its bound or of a gradient from 0, and
// size of a multiplier of the wrong sign. The second is smaller: a multiplier of the wrong sign means a wrong active set,
// whose cost grows as the curvature left by the rows weakens.
constexpr double VALUE_TOL = 30.0, SIGN_TOL = 2.0;
// Largest certified gradient of a free variable, in units of machine epsilon times the gradient's terms.
constexpr double GRADIENT_TOL = 4.0;
// Violation in units of roundoff, below which a dependent constraint is redundant and above which the problem is infeasible.
constexpr double REDUNDANCY_TOL = 1e3;
// Weighted QP: largest number of corrections.
constexpr int KERNEL_REFINEMENTS = 10;
// Predicted next correction, relative to the answer, below which none follows; in single precision it is
// SINGLE_CORRECTION. With weak dampings the correction itself is up to 10^4 times larger: the prediction assumes that
// corrections shrink alike, and the first one is small by chance in a few problems of 10,000.
constexpr double KERNEL_CORRECTION = 1e-20;
// Ratio of two corrections above which the second one was roundoff, if it was also below that part of the answer. A
// larger one follows where the first was small by chance, or where weak directions shrink slowly. From the third on,
// one that is not smaller than the one before is the last.
constexpr double MIN_DECREASE = 0.25, SMALL_CORRECTION = 1e-3;
// Pivot in units of machine epsilon times the diagonal element, below which rows are dependent.
constexpr double KERNEL_PIVOT = 1e2;
// Violation in units of roundoff, in single precision, below which a bound holds.
constexpr double VIOLATION_TOL = 10.0;
// Exchanges without fewer wrong labels, before the dual active-set method starts.
constexpr int MAX_EXCHANGES = 2;
// Starts and restarts of the dual active-set method: its answer, solved anew, may violate another bound slightly.
constexpr int MAX_DUAL_STARTS = 8;
// Hierarchy: solves and corrections on a guessed working set, before the primal active-set method.
constexpr int MAX_ATTEMPTS = 4;
// Ridge relative to the square of the longest row; it keeps a kernel's factor of a damped level positive.
constexpr double FACTOR_RIDGE = 1e-14;
// Least eigenvalue of a Gram matrix relative to its trace, above which its factors are accurate enough.
constexpr double INDEPENDENT_ROWS = 1e-7;
// Squared angle [rad^2] below which a kernel integrates a rotation by a series.
constexpr double SMALL_TURN_SQUARED = 1e-6;

}  // namespace osik
