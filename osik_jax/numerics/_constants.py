"""Constants that a method in plain JAX shares with its kernels, so that both decide alike.

Solvers and kernels import them from here; neither imports the other's.
"""

INACTIVE, AT_LOWER, AT_UPPER, EQUALITY = 0, -1, 1, 2
"""Labels of a constraint in an active set."""

DAMPING_ITERATIONS = 3
"""Steps towards the fixed point of a level's damping; each shrinks an excess by the factor unmet / s^2."""
DAMPING_RIDGE = 1e-13
"""Relative to the trace of the Gram matrix of a level's rows: keeps its Cholesky factor from breaking."""
NEGLIGIBLE_DAMPING = 1e-13
"""Relative to the square of the level's longest row: gradients of a smaller damping are below roundoff."""
COST_FRACTION = 0.1
"""Of a level's decrease of cost, the fraction that the levels below may cost it at second order."""
MIN_RADIUS = 1e-6
"""The smallest half-width of the trust region of the levels below: a box with a width is no equality."""
NEGLIGIBLE_CURVATURE = 1e-6
"""Relative to the largest curvature cost of a variable: a smaller one may be roundoff and restricts nothing."""

NEGLIGIBLE_STEP = 1e-11
"""Relative to the norm of the point where it begins: a shorter step counts as none."""
FULL_STEP = 1.0 - 1e-9
"""Step lengths from here on are a full step but for roundoff."""
BLOCKING_RANK = 1e-6
"""The part of a blocking joint's unit vector in the null space outside the span of others; with less it depends on
them."""
BOUND_DISTANCE = 1e-9
"""Relative to the bound: a joint at a larger distance is not at its bound."""
SATURATION_RESIDUAL = 2e-9
"""Relative to the terms that x is made of: the largest residual of the active bounds with which an answer is taken."""
