// Constants of the methods, with the values of numerics/_constants.py, which says what each is (a test compares them).
#pragma once

namespace osik {

// damping of a level, and the box that it leaves to the levels below
constexpr int DAMPING_ITERATIONS = 3;
constexpr double DAMPING_RIDGE = 1e-13, NEGLIGIBLE_DAMPING = 1e-13, COST_FRACTION = 0.1, MIN_RADIUS = 1e-6,
                 NEGLIGIBLE_CURVATURE = 1e-6;

// hierarchy
constexpr int MAX_STALLED = 20, MAX_ATTEMPTS = 4;
constexpr double STATIONARITY_TOL = 10.0, EXTRA_DAMPING = 1e-9, FACTOR_RIDGE = 1e-14;

}  // namespace osik
