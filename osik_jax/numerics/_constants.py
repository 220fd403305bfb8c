"""The one table of tolerances and other numbers that solvers, schemes and tasks are tuned by, each with its reason.

Where data in single precision take another number, there is one for each precision. Most are relative: to machine
epsilon, to roundoff (a tolerance times the scale of a constraint, ``constraint_scales``), or to what their line says.
Kernels for CPUs have them compiled in, and texts for CUDA get them as constants (``_warp.py`` in ``solvers/qp``,
``solvers/hqp`` and ``solvers/null_space``), so that methods in plain JAX and their kernels decide alike: neither
imports the other.

Not here, because they are no tolerances of a solver:

- sizes of blocks, tiles, workspaces and shared memory, which change the time and not the answer;
- guards against division by 0 (1e-300, 1e-37, ``finfo.tiny``), and limits on iterations in proportion to a problem's
  size: what they are is what the line that has them says, and for the limits the docstring of the public function;
- what a user may set: defaults of solvers and schemes, such as ``damping``, stand in their signatures;
- parts of a task's own formula, with a unit and a meaning there: the cone's rounded tip or the cosine that counts as
  behind (``tasks/_pointing.py``), the least distance of a look-at task, the default weight of a posture;
- what a robot, a task, a limit or a shape is accepted with when it is made (a unit quaternion, collinear corners), and
  how far limits stay clear of their bounds (``limits/``);
- searches that use the solvers: ``inverse/``, ``retargeting/``.
"""

import jax.numpy as jnp
import numpy as np

INACTIVE, AT_LOWER, AT_UPPER, EQUALITY = 0, -1, 1, 2
"""Labels of a constraint in an active set."""
REDUNDANT = 3
"""In a kernel's candidate: inactive, for it depends on the active ones, and holds up to roundoff where they do."""

EPSILON = float(np.finfo(np.float64).eps)
"""Machine epsilon of double precision, in which kernels for CPUs compute."""

# ---- damping of levels, shared with kernels

DAMPING_ITERATIONS = 3
"""Steps towards the fixed point of a level's damping; each shrinks an excess by the factor unmet / s^2."""
DAMPING_RIDGE = 1e-13
"""Relative to the trace of the Gram matrix of a level's rows: keeps its Cholesky factor from breaking."""
DAMPING_RIDGE_ROUNDOFF = 10.0
"""In units of machine epsilon: the ridge is no smaller, which counts in single precision."""
NEGLIGIBLE_DAMPING = 1e-13
"""Relative to the square of the level's longest row: gradients of a smaller damping are below roundoff."""
TIE_ROUNDOFF = 100.0
"""In units of machine epsilon of the terms of a row: one that is off its interval by less has no part in the damped
step."""
COST_FRACTION = 0.1
"""Of a level's decrease of cost, the fraction that the levels below may cost it at second order."""
MIN_RADIUS = 1e-6
"""The smallest half-width of the trust region of the levels below: a box with a width is no equality."""
NEGLIGIBLE_CURVATURE = 1e-6
"""Relative to the largest curvature cost of a variable: a smaller one may be roundoff and restricts nothing."""

# ---- saturation, shared with kernels

NEGLIGIBLE_STEP = 1e-11
"""Relative to the norm of the point where it begins: a shorter step counts as none."""
FULL_STEP = 1.0 - 1e-9
"""Step lengths from here on are a full step but for roundoff."""
STRAIGHT, PART, WHOLE = 1, 2, 3
"""Where a level that is done ends: at the part of the straight way to the end of its path at which its damped cost is
least; at the scale of least cost on the path; at the end. 0 is one that is not done."""
PATH_SEARCHES = 6
"""Searches at most for the scale at which a level's damped cost is least; two or three are the rule."""
PATH_STEP = 1e-9
"""Relative to that scale: a smaller correction is the last."""
PATH_END = 1e-6
"""Relative to the largest scale: from here on the joints that are saturated are those with which the path ends."""
BLOCKING_RANK = 1e-6
"""The part of a blocking joint's unit vector in the null space outside the span of others; with less it depends on
them."""
BOUND_DISTANCE = 1e-9
"""Relative to the bound: a joint at a larger distance is not at its bound."""
SATURATION_RESIDUAL = 2e-9
"""Relative to the terms that x is made of: the largest residual of the active bounds with which an answer is taken."""
SATURATION_LOSS = 1e-8
"""In kernels: how much larger the scale may be than the answer's, by what the null space changes of the combination of
joints that stops the motion; relative to the terms that x is made of, how far a joint may leave its bound by its
multiplier. An answer with more is not taken."""
SATURATION_RANK = 1e-9
"""In kernels: the part of a joint's unit vector in the null space and outside the span of saturated ones, with less of
which it depends on them; of the largest in a combination, with less of which a joint does not stop the motion."""
SATURATION_COMPLIANCE, STIFFER_SATURATION_COMPLIANCE = 1e-12, 1e-13
"""In kernels, of the missing part of the motion, in the second and the third attempt, where the answer before does not
hold: joints nearly depended on each other. The squared length of x that it outweighs; the more is missing, the more
certain is the first that no larger scale is possible."""
SOFT_SATURATION_RANK = 1e-11
"""``SATURATION_RANK`` in these attempts: what is missing is a coordinate there, so few joints depend on others."""
SIGN_CHECKS = 3
"""In kernels: how often a search that would end with a multiplier of the wrong sign, by rounding, goes on."""
MAX_SATURATION_CHANGES = 5
"""In kernels, for each variable: the first attempt ends with more changes of the active set, for it goes round by
rounding; the others may have all that are left."""
LARGEST_RATE = 10.0
"""In kernels, in units of what the entering joint has in a combination: a joint with more is what the others say most
about, and takes the entering one's place."""

# ---- answers and certificates

KKT_TOLERANCE = {jnp.dtype("float64"): 1e-9, jnp.dtype("float32"): 1e-5}
"""The largest ``kkt_residual`` of an answer that is SOLVED, by the precision of the data."""
FEASIBILITY = 1e-12
"""Relative to the scale of a constraint: a smaller violation, or multiplier of the wrong sign, counts as none."""
FARKAS_RADIUS = 1e3
"""Relative to the numbers at hand: how large an x is considered along variables without a bound."""
FARKAS_ROUNDOFF = 1e-14
"""Relative to the absolute terms of a sum: a smaller sum is 0."""
SINGLE_TOL = 1e-7
"""Smallest tolerance of a kernel in single precision, and of its certificate; the search has the one asked for."""
VALUE_TOL, SIGN_TOL = 30.0, 2.0
"""In units of the tolerance: how far a certified value may be off its bound, or a gradient from 0; and how large a
multiplier of the wrong sign may be.

The latter is smaller: such a multiplier says that the active set is not right, and what that costs is more the weaker
the curvature is that the rows leave."""
GRADIENT_TOL = 4.0
"""In units of machine epsilon times the gradient's terms: how large a certified gradient of a free variable may be."""
BOX_TOLERANCE = 10.0
"""In units of the rank tolerance: how far a candidate may be outside its box, into which it is clipped before it is
certified. A bound that a step approaches by less than the rank tolerance of the step does not stop it."""
MAX_RESIDUAL = 10.0
"""In units of the rank tolerance: the largest ``kkt_residual`` of a hierarchy that is SOLVED. With the default rank
tolerances this is ``KKT_TOLERANCE``."""
MAX_DETOUR = 100.0
"""In units of the answer: how large x may be on the way from a warm start. Tolerances are relative to x, and
``HARD_ROW_TOL`` of an x that is larger by this factor is still the residual of an answer that is SOLVED."""

# ---- the dual active-set method

DEPENDENCE_TOL = 100.0
"""In units of machine epsilon: a constraint of whose diagonal the active ones leave less depends on them."""
KERNEL_DEPENDENCE = 1e-14
"""The same in the core, which has orthogonal factors: relative to the square of the constraint's normal."""
REDUNDANCY_TOL = {jnp.dtype("float64"): 1e3, jnp.dtype("float32"): 1e1}
"""In units of roundoff: a dependent constraint that is violated by less is redundant, by more infeasible."""

# ---- weighted QPs

ZERO_TOL = 100.0
"""In units of machine epsilon times the Newton step at x: an x that is no larger counts as 0."""
MAX_ROUNDS = 12
"""Rounds of factor, check and search; where that many end without an answer, projected Newton takes over."""
RELAXED = {jnp.dtype("float64"): 1e3, jnp.dtype("float32"): 1e2}
"""In units of roundoff; an answer that the dual method does not change is accepted with violations up to this."""
MAX_INFEASIBLE = 2
"""Dual methods that end as infeasible before projected Newton takes over; one that changes nothing is enough."""
ROW_MULTIPLIER = 1e-3
"""Relative to what all rows add to a variable's gradient: a multiplier of a row that is smaller has no sign."""
INFEASIBLE_COMPLIANCE = 1e-12
"""Compliance of infeasible hard rows relative to C diag(H)^-1 C': with it the least violation has a derivative."""
KKT_RIDGE = {jnp.dtype("float64"): 10.0, jnp.dtype("float32"): 1.0}
"""In units of machine epsilon times the diagonal: keeps the factor of a semidefinite Hessian from breaking."""
QUADRATIC_RIDGE = 10.0
"""The same for the square root of a Hessian that was given as a matrix, relative to its largest diagonal element."""
SCHUR_RIDGE = 10.0
"""The same for the system of the active rows."""
LAST_CORRECTION = {jnp.dtype("float64"): 1e-9, jnp.dtype("float32"): 1e-6}
"""Relative to the answer: a smaller correction is the last; the next would be its square, or roundoff."""
MAX_REFINEMENTS = 5
"""Steps of iterative refinement at most; two are the rule."""
MAX_ROW_RATIO = 0.9
"""Rows per variable, beyond which the factor of the Hessian is as quick."""
ROW_SPACE_PIVOT = 1e4
"""In units of machine epsilon times the diagonal element: a smaller pivot says that rows depend on each other."""
MAX_CONTRACTION = 1e-4
"""The largest ratio of two corrections with which refinement is trusted to converge."""
ROW_SPACE_CORRECTION, ROW_SPACE_ACCURACY = 1e-6, 1e-13
"""The last correction is smaller than the first relative to x, and the next one would be smaller than the second."""
GRADIENT_STEPS = 100
"""Steps of the projected gradient behind an answer that is MAX_ITERATIONS."""

# ---- weighted QPs in kernels: double precision is the core's, single precision CUDA's

KERNEL_REFINEMENTS = {jnp.dtype("float64"): 10, jnp.dtype("float32"): 6}
"""Corrections at most."""
KERNEL_CORRECTION = 1e-10
"""Relative to the answer, in double precision: a smaller correction is the last. In single precision
``LAST_CORRECTION``, for the one that would come next."""
MIN_DECREASE = 0.25
"""A correction that shrinks to more than this part of the one before was roundoff."""
KERNEL_PIVOT = 1e2
"""In units of machine epsilon times the diagonal element: a smaller pivot says that rows depend on each other."""
BOUND_MULTIPLIER = 1.0
"""In units of machine epsilon times the terms of a gradient: a variable on a bound with a larger multiplier of the
wrong sign is let go. Tolerances of the cost's curvature would not do: a weak task, such as a posture, pulls with less
than those."""
VIOLATION_TOL = 10.0
"""In units of roundoff, in single precision: a bound that is violated by less holds."""
MAX_EXCHANGES = 2
"""Exchanges that leave no fewer wrong labels, before the dual active-set method."""
MAX_DUAL_STARTS = 8
"""Times that the dual active-set method begins or goes on: its end, solved anew, may be a little off another bound."""
MAX_FACTORIZATIONS = 100
"""Systems that the kernel in single precision factors at most; the rest is searched."""

# ---- projected Newton

PENALTY = 1e5
"""Curvature of a hard row relative to the largest of the cost: an update reduces its violation to about 1e-5 of it."""
SHORTEST_STEP, STEP_LENGTHS = 1e-9, 31
"""The shortest step of the line search, and how many lengths from 1 down to it are tried."""
NEWTON_ROUNDOFF = 4e-15
"""Relative to the terms of the gradient; a variable with a smaller gradient is stationary."""
SMALL_STEP = 1e-13
"""Relative to x; a Newton step that is shorter is the last on its face."""
FULL_STEP_ROUNDOFF = 4.0
"""In units of the roundoff of the cost: a full step is taken where a shorter one is not better by more."""
FEASIBLE_AT_ONCE, FEASIBLE_DECREASE = 1e-3, 0.1
"""In units of the feasibility tolerance: with less violation the updates of the multipliers end. With at most 1 they
end where an update leaves more than the second of what was violated."""
MAX_JOINT_RELEASES = 10
"""Iterations in which all bounds that the gradient points away from are released at once; then one at a time."""
MAX_UPDATES = 40
"""Updates of the multipliers of hard rows at most."""
COMPLIANCE_DECREASE = 0.1
"""Factor of the compliance of infeasible hard rows, where a bound keeps x from the least violation."""
ZERO_GRADIENT = 1e-9
"""Cosine of the angle between the violation and a column of C; a smaller one is 0."""
UNCHANGED = 1e-9
"""Relative to x; the least violation has been found where an update moves x by less."""

# ---- hierarchies

HIERARCHY_RANK = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-6}
"""The part of a row outside the span of others with less than which it depends on them; data in single precision have
more roundoff, which makes dependent rows independent."""
STEP_TOL = 1e-13
"""Relative to the scale of a level's rows: a step that changes them by less is none."""
MULTIPLIER_TOL = 1e-10
"""Relative to the level's gradient: a smaller multiplier is 0."""
HARD_ROW_TOL = 1e-11
"""Relative to the scale of a row: a smaller violation is none."""
STATIONARITY_TOL = 10.0
"""In units of the multiplier's tolerance and of roundoff: a gradient along free directions that is smaller is 0, in
kernels."""
SINGULAR_TOL = 100.0
"""In units of machine epsilon of the data: singular values that are smaller are not inverted in derivatives."""
ZERO_PIVOT = 1e-2
"""In units of the rank tolerance: a pivot up to this is 0, whatever rank another factorisation has found."""
DAMPED_RANK = 1e-14
"""Pivots of a damped level's rows that count in its step, relative to its longest row: all above roundoff."""
EXTRA_DAMPING = 1e-9
"""In units of the level's longest row, squared; whatever the level's own damping: the Hessian has to be regular. A
kernel takes one step so damped along directions that the rank tolerance left out."""
GUESS_ROUNDOFF = 1e-10
"""The roundoff tolerance of a row's value, in units of the terms that add up to it."""
WORKING_SET_SOLVES = 2
"""Solves with one factorisation, each against exact residuals: the first one, and one step of refinement."""
MAX_STALLED = 20
"""Steps of zero length in a row after which the least index decides; shared with kernels, and so are the next two."""
MAX_ATTEMPTS = 4
"""A kernel's solves on a guessed working set and its corrections, before the primal active-set method."""
FACTOR_RIDGE = 1e-14
"""Relative to the square of the longest row: keeps a kernel's factor of a damped level positive."""

# ---- null spaces

INDEPENDENT_ROWS = 1e-7
"""In a kernel, relative to the trace of a Gram matrix: its least eigenvalue, from which on its factors are accurate
enough."""
NULL_SPACE_RANK = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-5}
"""Of a level's Frobenius norm: a row with less outside the span of others depends on them; data in single precision
have more roundoff, which makes dependent rows independent."""
MISSING_COMPLIANCE = 1e-7
"""Of the missing part of the motion: the squared length of x that it outweighs."""
STIFFER_COMPLIANCE = 0.1
"""Factor of that compliance in every other attempt: a stiffer penalty on the missing part."""
SATURATION_ROUNDOFF = 1e-11
"""Relative to the terms that x is made of: a smaller violation of a bound counts as none."""
INDEPENDENCE_TOL = 1e-5
"""Relative to a combination of joints: where the null space changes it by less, it does not change it."""
PROJECTOR_ROUNDOFF = 0.1
"""Diagonals of projectors are 1 at most; a smaller one has the dependence tolerance of one as large as this."""
NEGLIGIBLE_ENTRY = 1e-7
"""Joints with a smaller entry in the combination do not block the motion."""
ENTRY_ROUNDOFF = 2.0
"""In units of machine epsilon times the largest entry of a row: a smaller entry is what rounding left of 0."""
SATURATION_ATTEMPTS = 6
"""Where an answer is not accepted, the next attempt has a lower compliance, and only the part of the motion near the
scale that was found: motions that are too large for their box by orders of magnitude lose digits."""
ATTEMPT_GROWTH = 8.0
"""Factor of the part of the motion that is considered, after an attempt that was accepted with less than all of it."""
ATTEMPT_SCALE = 1e-3, 0.25
"""Least and largest scale that a failed attempt may have found; the next considers twice as much of its motion."""
SATURATION_ACCURACY = 1e-15
"""Relative to the terms that x is made of: an answer with a smaller residual is not refined."""
MAX_SATURATION_REFINEMENTS = 5
"""Refinements of the answer at most; one is the rule."""
DERIVATIVE_RANK = 1e-7
"""A saturated joint with less of its column of the projector outside the span of the others has no derivative of its
own."""

# ---- schemes

CONSTRAINT_TOL = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-4}
"""Relative to what its numbers amount to: a hard row that is missed by less holds."""
STANDING_SPEED = 1e-4
"""Speed [rad/s or m/s] that counts at least: of a robot at rest, roundoff is all that there is."""
DIAGONAL_RATIO = 30.0
"""Little of the curvature damping is added where it is below this many times a dof's other diagonal terms."""
BELOW_OTHERS = 2.0
"""Factor of a priority's curvature damping, where others are above it: their rows, which bend too, balance what it
cannot meet."""
SINGLE_DAMPING = 4.0
"""In units of epsilon times the largest weight times row norm squared: a kernel in single precision gets no weaker
damping, which would be lost in the Hessian's roundoff."""

# ---- tasks, shared with kernels

SMALL_SINE_SQUARED = 1e-6
"""Squared sine of half an angle below which a series for the logarithm of a rotation is exact to roundoff."""
SMALL_ANGLE_SQUARED = 1e-2
"""Squared angle [rad^2] below which a series for the derivative of that logarithm is exact to roundoff."""
SMALL_TURN_SQUARED = 1e-6
"""Squared angle [rad^2] below which a kernel moves along a rotation by a series."""
PARALLEL = 1e-6
"""Squared sine of the angle under which segments count as parallel."""

# ---- tasks

POINTING_SINE_SQUARED = 1e-3
"""Squared sine of the angle from an axis to a direction, below which a series for angle over sine is exact."""
LEVER_ROUNDOFF = 1e-6
"""Relative to the longest lever: a shorter one may be roundoff of none."""
UNHELD_PART = 0.04
"""Of the bound on a task's curvature: the part for what bends where the frame does not move across its pull."""
NEAR_ERROR = 0.06
"""In lever arms: an error below which the whole bound is damped, so that a stretched arm leaves its boundary and comes
back to it calmly."""
FARTHEST_ERROR = 1e6
"""In units of ``NEAR_ERROR``: farther makes no difference."""
ROW_ROUNDOFF = 10.0
"""In units of machine epsilon for each dof: a row of a Jacobian of which those before it leave less depends on them."""
INERTIA_ROUNDOFF = 4.0
"""In units of machine epsilon for each dof: what a motion without inertia counts as, of the inertia of its dofs."""
