// Constants of the methods, with the values of numerics/_constants.py, which says what each is (a test compares them).
#pragma once

namespace osik {

constexpr double EPSILON = 2.220446049250313e-16;

// damping of a level, and the box that it leaves to the levels below
constexpr int DAMPING_ITERATIONS = 3;
constexpr double BLOCKING_PART = 1e-5, DAMPING_RIDGE = 1e-13, NEGLIGIBLE_DAMPING = 1e-13, COST_FRACTION = 0.1,
                 MIN_RADIUS = 1e-6, NEGLIGIBLE_CURVATURE = 1e-6, TIE_ROUNDOFF = 100.0;

// hierarchy
constexpr int MAX_STALLED = 20, MAX_ATTEMPTS = 4;
constexpr double STATIONARITY_TOL = 10.0, DAMPED_RANK = 1e-14, EXTRA_DAMPING = 1e-9, FACTOR_RIDGE = 1e-14,
                 MAX_DETOUR = 100.0;

// labels of constraints
constexpr int INACTIVE = 0, AT_LOWER = -1, AT_UPPER = 1, EQUALITY = 2, REDUNDANT = 3;

// weighted QP; SINGLE_... in single precision
constexpr int KERNEL_REFINEMENTS = 10, MAX_EXCHANGES = 2, MAX_DUAL_STARTS = 8;
constexpr double KERNEL_CORRECTION = 1e-20, SINGLE_CORRECTION = 1e-6, MIN_DECREASE = 0.25, SMALL_CORRECTION = 1e-3,
                 VIOLATION_TOL = 10.0, SINGLE_RIDGE = 1.0, KERNEL_PIVOT = 1e2, ZERO_TOL = 100.0, BOUND_MULTIPLIER = 1.0,
                 SINGLE_BOUND_MULTIPLIER = 0.03, KERNEL_DEPENDENCE = 1e-14, REDUNDANCY_TOL = 1e3;

// certificates, and the point without one
constexpr int GRADIENT_STEPS = 100;
constexpr double VALUE_TOL = 30.0, SIGN_TOL = 2.0, GRADIENT_TOL = 4.0, ROW_MULTIPLIER = 1e-3, BOX_TOLERANCE = 10.0,
                 MAX_RESIDUAL = 10.0;

// tasks of a step
constexpr double DIAGONAL_RATIO = 30.0, BELOW_OTHERS = 2.0, LEVER_ROUNDOFF = 1e-6, UNHELD_PART = 0.04,
                 NEAR_ERROR = 0.06, NEAR_PART = 0.4, FARTHEST_ERROR = 1e6, RANGE_ROUNDOFF = 8.0;

// rotations, collision
constexpr double SMALL_SINE_SQUARED = 1e-6, SMALL_ANGLE_SQUARED = 1e-2, SMALL_TURN_SQUARED = 1e-6, PARALLEL = 1e-6;

// null space
constexpr double INDEPENDENT_ROWS = 1e-7, NARROW_RANGE = 1e4;

// saturation
constexpr int STRAIGHT = 1, PART = 2, WHOLE = 3;
constexpr int PATH_SEARCHES = 6, SIGN_CHECKS = 3, MAX_SATURATION_CHANGES = 5;
constexpr double NEGLIGIBLE_STEP = 1e-11, FULL_STEP = 0.999999999, PATH_STEP = 1e-9, PATH_END = 1e-6, BLOCKING_RANK = 1e-6,
                 BOUND_DISTANCE = 1e-9, SATURATION_RESIDUAL = 2e-9, SATURATION_LOSS = 1e-8, SATURATION_RANK = 1e-9,
                 SATURATION_COMPLIANCE = 1e-12, STIFFER_SATURATION_COMPLIANCE = 1e-13, SOFT_SATURATION_RANK = 1e-11,
                 LARGEST_RATE = 10.0, SATURATION_ROUNDOFF = 1e-11, NEGLIGIBLE_ENTRY = 1e-7;

}  // namespace osik
