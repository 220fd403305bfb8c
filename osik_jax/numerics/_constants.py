"""The table of tolerances and tuning numbers of solvers, schemes and tasks, each with its reason.

Numbers that depend on the precision of the data have one value for each precision. Most are relative: to machine
epsilon, to roundoff (a tolerance times the scale of a constraint, ``constraint_scales``), or to the quantity named in
their line. ``core/constants.hpp`` has the same numbers for the kernels, which decide alike, and those of kernels alone.

Not here, because they are no tolerances of a solver:

- sizes of blocks, tiles, workspaces and shared memory, which change the time and not the answer;
- guards against division by 0 (1e-300, 1e-37, ``finfo.tiny``), which stand in the line that needs them;
- limits on iterations in proportion to a problem's size, in the docstring of the public function;
- options of users, such as ``damping``, whose defaults stand in the signatures of solvers and schemes;
- parts of a task's own formula, with a unit and a meaning there: the cone's rounded tip or the cosine that counts as
  behind (``tasks/_pointing.py``), the least distance of a look-at task, the default weight of a posture;
- tolerances of checks when a robot, task, limit or shape is made (a unit quaternion, collinear corners), and the
  distances that limits keep from their bounds (``limits/``);
- searches that use the solvers: ``inverse/``, ``retargeting/``.
"""

import jax.numpy as jnp
import numpy as np

INACTIVE, AT_LOWER, AT_UPPER, EQUALITY = 0, -1, 1, 2
"""Labels of a constraint in an active set."""
REDUNDANT = 3
"""Label in a kernel's candidate: inactive, for it depends on active constraints and holds up to roundoff if they do."""

EPSILON = float(np.finfo(np.float64).eps)
"""Machine epsilon of double precision, the precision of the CPU kernels."""

# ---- damping of levels, shared with kernels

DAMPING_ITERATIONS = 3
"""Iterations towards the fixed point of a level's damping; each shrinks the error by the factor unmet / s^2."""
BLOCKING_PART = 1e-5
"""Length inside the null space of frozen rows, relative to the whole row, up to which a row above blocks no step."""
DAMPING_RIDGE = 1e-13
"""Ridge relative to the trace of the Gram matrix of a level's rows; it keeps the Cholesky factor positive."""
DAMPING_RIDGE_ROUNDOFF = 10.0
"""Least value of that ridge in units of machine epsilon; it applies in single precision."""
NEGLIGIBLE_DAMPING = 1e-13
"""Damping relative to the square of the level's longest row whose gradients are below roundoff."""
TIE_ROUNDOFF = 100.0
"""Machine epsilons of a row's terms: a row that leaves its interval by less is not in the damped step."""
COST_FRACTION = 0.1
"""Share of a level's cost decrease that lower levels may undo at second order."""
MIN_RADIUS = 1e-6
"""Least half-width of the trust region of lower levels; a box of zero width would be an equality."""
NEGLIGIBLE_CURVATURE = 1e-6
"""Curvature cost of a variable relative to the largest one, below which it may be roundoff and restricts nothing."""

NARROW_RANGE = 1e4
"""Range of a joint relative to its limits, in units of ``EPSILON``, up to which it has no potential."""

# ---- saturation, shared with kernels

NEGLIGIBLE_STEP = 1e-11
"""Step length relative to the norm of its starting point, below which it counts as zero."""
FULL_STEP = 1.0 - 1e-9
"""Step lengths above this are a full step up to roundoff."""
STRAIGHT, PART, WHOLE = 1, 2, 3
"""Endings of a finished level; 0 is an unfinished one. STRAIGHT: the fraction of the straight line to the end of its
path at which its damped cost is least. PART: the scale of least cost on the path. WHOLE: the end of the path.
"""
PATH_SEARCHES = 6
"""Largest number of searches for the scale of least damped cost; two or three are usual."""
PATH_STEP = 1e-9
"""Correction relative to that scale, below which the search ends."""
PATH_END = 1e-6
"""Tolerance relative to the largest scale: within it, the saturated joints are those of the end of the path."""
BLOCKING_RANK = 1e-6
"""Part of a blocking joint's unit vector in the null space, outside the others' span, below which it is dependent."""
BOUND_DISTANCE = 1e-9
"""Distance relative to the bound, above which a joint is not at its bound."""
SATURATION_RESIDUAL = 2e-9
"""Largest residual of the active bounds of an accepted answer, relative to the terms that add up to x."""

# ---- answers and certificates

KKT_TOLERANCE = {jnp.dtype("float64"): 1e-9, jnp.dtype("float32"): 1e-5}
"""Largest ``kkt_residual`` of a SOLVED answer, by the precision of the data."""
FEASIBILITY = 1e-12
"""Violation, or multiplier of the wrong sign, relative to the scale of a constraint, below which it counts as zero."""
FARKAS_RADIUS = 1e3
"""Largest |x|, relative to the problem's numbers, that a Farkas certificate considers for unbounded variables."""
FARKAS_ROUNDOFF = 1e-14
"""Sum relative to its absolute terms, below which it counts as 0."""
FARKAS_MARGIN = 1e-3
"""Part by which a Farkas certificate exceeds its bound: where rows just hold, the two differ by roundoff alone."""
SINGLE_TOL = 1e-7
"""Least tolerance of a kernel in single precision and of its certificate; the search uses the requested one."""
BOX_TOLERANCE = 10.0
"""Largest distance of a candidate outside its box before it is clipped and certified, in units of the rank tolerance. A
bound that a step approaches by less than the rank tolerance of the step does not stop it.
"""
MAX_RESIDUAL = 10.0
"""Largest ``kkt_residual`` of a SOLVED hierarchy in units of the rank tolerance; by default ``KKT_TOLERANCE``."""

# ---- weighted QPs

ZERO_TOL = 100.0
"""Size of x in units of machine epsilon times the Newton step at x, below which x counts as 0."""
SEARCH_TOLERANCES = 0.01, 0.1, 0.1
"""Violation of hard rows at the end of each projected Newton search for a problem, in units of ``KKT_TOLERANCE``. Where
a search ends without an answer, the next one begins at its end.
"""
ZERO_MULTIPLIERS = 1e-9, 1e-8, 1e-7
"""Multiplier relative to the gradient's terms, below which its constraint is not active in the exact solve after each
of these searches: what a large penalty makes of roundoff.
"""
RELAXED = {jnp.dtype("float64"): 1e3, jnp.dtype("float32"): 1e2}
"""Violations in units of roundoff up to which an exact solve after projected Newton is accepted."""
ROW_MULTIPLIER = 1e-3
"""Multiplier of a row relative to all rows' sum in a variable's gradient, below which its sign is not significant."""
INFEASIBLE_COMPLIANCE = {jnp.dtype("float64"): 1e-11, jnp.dtype("float32"): 1e-6}
"""Compliance of infeasible hard rows relative to C diag(H)^-1 C'; it makes the least violation differentiable.

A larger one moves the derivative, a smaller one loses it to rounding. It changes neither x nor the status. Largest
relative errors beside central differences in float64, of random families and of a NAO's recorded problems: 1e-10: 3e-5
and 1e-4; 1e-11: 3e-6 and 5e-4; 1e-12: 3e-5 and 4e-3; 1e-13: 9e-4 and 7e-2. In single precision the median error of
random families is 0.9 with 1e-11, and 2e-3 with 1e-6."""
KKT_RIDGE = {jnp.dtype("float64"): 10.0, jnp.dtype("float32"): 1.0}
"""Ridge in units of machine epsilon times the diagonal; it keeps the factor of a semidefinite Hessian positive."""
QUADRATIC_RIDGE = 10.0
"""The same for the square root of a Hessian given as a matrix, relative to its largest diagonal element."""
SCHUR_RIDGE = 10.0
"""The same for the system of the active rows."""
LAST_CORRECTION = {jnp.dtype("float64"): 1e-9, jnp.dtype("float32"): 1e-6}
"""Correction relative to the answer, below which it is the last; the next would be its square, or roundoff."""
MAX_REFINEMENTS = 5
"""Largest number of iterative refinements; two are usual."""
GRADIENT_STEPS = 100
"""Steps of the projected gradient method that follow a MAX_ITERATIONS answer."""

# ---- weighted QPs in kernels: double precision is the core's, single precision CUDA's

BOUND_MULTIPLIER = {jnp.dtype("float64"): 1.0, jnp.dtype("float32"): 0.03}
"""Multiplier of the wrong sign in units of machine epsilon times the gradient's terms, above which a variable leaves
its bound. A tolerance relative to the cost's curvature would be too large: a weak task such as a posture pulls with
less. In single precision the sum of all terms would be too, as their roundoff mostly cancels. A row leaves its bound if
its multiplier exceeds this in an entry of the gradient (double precision).
"""

# ---- projected Newton

PENALTY = 1e5
"""Curvature of a hard row relative to the cost's largest one; an update reduces its violation to about 1e-5."""
LARGEST_PENALTY, SLOW_DECREASE = 1e7, 0.25
"""The same where updates are slow: that leave more than the second times the violation before."""
SHORTEST_STEP, STEP_LENGTHS = 1e-9, 31
"""Shortest step of the line search, and number of lengths tried from 1 down to it."""
NEWTON_ROUNDOFF = 4e-15
"""Gradient of a variable relative to its terms, below which the variable is stationary."""
SMALL_STEP, SMALLER_STEP, SMALLER_STEPS = 1e-13, 1e-14, 8
"""Newton step relative to x, below which it is the last on its face. After an update of the multipliers the second
number counts for as many steps as the third says: beside a large penalty the first leaves a gradient. Then the first
counts, for a search may cycle above the second.
"""
FULL_STEP_ROUNDOFF = 4.0
"""Improvement of a shorter step in units of the roundoff of the cost, below which the full step is taken."""
FEASIBLE_AT_ONCE, FEASIBLE_DECREASE = 1e-3, 0.7
"""End of the multiplier updates, in units of the feasibility tolerance: a violation below the first, or below 1 if an
update leaves more than the second times the violation before.
"""
MAX_JOINT_RELEASES = 10
"""Iterations in which all bounds are released together that the gradient points away from; afterwards one at a time."""
MAX_STEPS = 100
"""Steps after which the multipliers are updated though a bound still comes and goes."""
MAX_UPDATES = 40
"""Largest number of updates of the multipliers of hard rows."""
COMPLIANCE_DECREASE = 0.1
"""Factor on the compliance of infeasible hard rows, applied while a bound keeps x from the least violation."""
ZERO_GRADIENT = 1e-9
"""Cosine of the angle between the violation and a column of C, below which it counts as 0."""
UNCHANGED = 1e-9
"""Change of x by an update relative to x, below which the least violation has been found."""

# ---- hierarchies

HIERARCHY_RANK = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-6}
"""Part of a row outside the span of other rows, below which it is dependent. In single precision roundoff makes
dependent rows look independent, so the value is larger.
"""
STEP_TOL = 1e-13
"""Step relative to the scale of a level's rows, below which it counts as zero."""
MULTIPLIER_TOL = 1e-10
"""Multiplier relative to the level's gradient, below which it counts as 0."""
HARD_ROW_TOL = 1e-11
"""Violation relative to the scale of a row, below which it counts as zero."""
STATIONARITY_TOL = 10.0
"""Gradient along free directions (in kernels) that counts as 0, in units of multiplier tolerance and roundoff."""
SINGULAR_TOL = 100.0
"""Singular values in units of machine epsilon of the data, below which they are not inverted in derivatives."""
ZERO_PIVOT = 1e-2
"""Pivot in units of the rank tolerance that counts as 0, whatever rank another factorisation found."""
DAMPED_RANK = 1e-14
"""Least pivot that counts in a damped level's step, relative to its longest row; all above roundoff count."""
EXTRA_DAMPING = 1e-9
"""Damping in units of the square of the level's longest row, with which a kernel takes one step along directions that
the rank tolerance left out.
"""
WORKING_SET_SOLVES = 2
"""Solves per factorisation, each against exact residuals: the first, and one refinement."""
MAX_STALLED = 20
"""Consecutive steps of zero length after which the least index decides; shared with kernels."""

# ---- null spaces

NULL_SPACE_RANK = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-5}
"""Part of a row outside the span of other rows relative to the level's Frobenius norm, below which it is dependent. In
single precision roundoff makes dependent rows look independent, so the value is larger.
"""
SATURATION_ROUNDOFF = 1e-11
"""Violation of a bound relative to the terms that add up to x, below which it counts as zero."""
NEGLIGIBLE_ENTRY = 1e-7
"""Entry in the combination of joints, below which a joint does not block the motion."""
ENTRY_ROUNDOFF = 2.0
"""Entry in units of machine epsilon times the row's largest entry, below which it is the rounding of 0."""
DERIVATIVE_RANK = 1e-7
"""Part of a saturated joint's projector column outside the others' span, below which it has no own derivative."""

# ---- schemes

CONSTRAINT_TOL = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-4}
"""Violation of a hard row relative to the magnitude of its terms, below which the row holds."""
STANDING_SPEED = 1e-4
"""Least speed [rad/s or m/s] in that magnitude: a robot at rest has only roundoff."""
DIAGONAL_RATIO = 30.0
"""Curvature damping is reduced where it is below this many times a dof's other diagonal terms."""
BELOW_OTHERS = 2.0
"""Factor on a priority's curvature damping if other priorities are above it: their rows bend too, and balance the part
that it cannot meet.
"""
SINGLE_DAMPING = 4.0
"""Least damping of a kernel in single precision, in units of epsilon times the largest weight times squared row norm; a
weaker damping would be lost in the Hessian's roundoff.
"""

# ---- tasks, shared with kernels

SMALL_SINE_SQUARED = 1e-6
"""Squared sine of half an angle, below which a series for the logarithm of a rotation is exact to roundoff."""
SMALL_ANGLE_SQUARED = 1e-2
"""Squared angle [rad^2] below which a series for the derivative of that logarithm is exact to roundoff."""
PARALLEL = 1e-6
"""Squared sine of the angle between segments, below which they count as parallel."""
TOUCH = 1e-6
"""Distance beyond the clearance that solutions in a scene keep, against rounding [m]."""
SINGLE_TOUCH = 2e-5
"""The same in single precision."""

# ---- tasks

POINTING_SINE_SQUARED = 1e-3
"""Squared sine of the angle to a direction, below which a series for angle over sine is exact to roundoff."""
BEHIND = -0.5
"""Cosine below which a direction counts as behind. The formulas for behind divide by the cosine, those for ahead by one
plus the cosine.
"""
LEAST_SINE = 0.1
"""Least sine of the error's angle that is divided by; angle / sine has no bound near the opposite direction."""
NEAREST_SIGHT = 1e-3
"""Distance [m] below which there is no line of sight."""
CONE_TIP = 0.01
"""Angle [rad] below which a cone's angle is rounded off, so that its gradient is 0 at 0."""
LEVER_ROUNDOFF = 1e-6
"""Lever arm relative to the longest one, below which it may be the roundoff of 0."""
UNHELD_PART = 0.04
"""Share of the bound on a task's curvature for joints that bend without moving the frame across its pull."""
NEAR_ERROR = 0.06
"""Error in lever arms, below which the whole bound is used: a stretched arm does not oscillate at its boundary."""
NEAR_PART = 0.4
"""Fraction of the curvature bound that counts at the target."""
FARTHEST_ERROR = 1e6
"""Largest error that is considered, in units of ``NEAR_ERROR``; a larger one makes no difference."""
ROW_ROUNDOFF = 10.0
"""Part of a Jacobian row left by the rows before it, in machine epsilons per dof, below which it is dependent."""
INERTIA_ROUNDOFF = 4.0
"""Inertia given to a motion without any, in units of machine epsilon per dof, relative to the inertia of its dofs."""
RANGE_ROUNDOFF = 8.0
"""Machine epsilons of the way to a bound that are kept clear of it, so that q + v dt stays within."""
