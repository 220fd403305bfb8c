// Constants of the methods, with the values of numerics/_constants.py, which says what each is (a test compares them).
#pragma once

namespace osik {

constexpr double EPSILON = 2.220446049250313e-16;

// damping of a level, and the box that it leaves to the levels below
constexpr int DAMPING_ITERATIONS = 3;
constexpr double DAMPING_RIDGE = 1e-13, NEGLIGIBLE_DAMPING = 1e-13, COST_FRACTION = 0.1, MIN_RADIUS = 1e-6,
                 NEGLIGIBLE_CURVATURE = 1e-6, TIE_ROUNDOFF = 100.0;

// hierarchy
constexpr int MAX_STALLED = 20, MAX_ATTEMPTS = 4;
constexpr double STATIONARITY_TOL = 10.0, DAMPED_RANK = 1e-14, EXTRA_DAMPING = 1e-9, FACTOR_RIDGE = 1e-14,
                 MAX_DETOUR = 100.0;

// labels of constraints
constexpr int INACTIVE = 0, AT_LOWER = -1, AT_UPPER = 1, EQUALITY = 2, REDUNDANT = 3;

// weighted QP, in double precision
constexpr int KERNEL_REFINEMENTS = 10, MAX_EXCHANGES = 2, MAX_DUAL_STARTS = 8;
constexpr double KERNEL_CORRECTION = 1e-10, MIN_DECREASE = 0.25, KERNEL_PIVOT = 1e2,
                 ZERO_TOL = 100.0, BOUND_MULTIPLIER = 1.0, KERNEL_DEPENDENCE = 1e-14, REDUNDANCY_TOL = 1e3;

// rotations
constexpr double SMALL_SINE_SQUARED = 1e-6, SMALL_ANGLE_SQUARED = 1e-2;

}  // namespace osik
