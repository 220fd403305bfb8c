"""Families of quadratic programs and hierarchies, drawn by the hundred: seeded NumPy, batched, one shape a family.

Every QP but the inconsistent ones is built from a known optimum: solution and multipliers are drawn first, then the
data that make them optimal. H is positive definite, so the solution is unique however degenerate the multipliers are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

VARIABLES, ROWS = 12, 14
FREE, ABOVE, BELOW, BETWEEN, AT_LOWER, AT_UPPER, EQUAL = range(7)


class QPs(NamedTuple):
    """min 1/2 x'Hx + g'x  over  lower <= x <= upper,  row_lower <= C x <= row_upper, batched."""

    H: np.ndarray
    g: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    C: np.ndarray
    row_lower: np.ndarray
    row_upper: np.ndarray
    x: np.ndarray  # the solution
    unit: np.ndarray  # natural unit of each variable: errors are measured in it

    @property
    def data(self) -> tuple[np.ndarray, ...]:
        """What the solver is given."""
        return self[:7]


def positive_definite(rng: np.random.Generator, count: int, n: int, condition: float = 1e3) -> np.ndarray:
    """Random eigenvectors, eigenvalues from 1 down to 1 / condition."""
    Q = np.linalg.qr(rng.normal(size=(count, n, n)))[0]
    eigenvalues = condition ** -np.sort(rng.random((count, n)), 1)
    eigenvalues[:, 0], eigenvalues[:, -1] = 1.0, 1.0 / condition
    return np.einsum("bij,bj,bkj->bik", Q, eigenvalues, Q)


def bounds_around(rng: np.random.Generator, s: np.ndarray, roles: Sequence[float], degenerate: float = 0.0) -> tuple:
    """Bounds and multipliers for which the values ``s`` are optimal.

    ``roles`` are the odds of FREE ... EQUAL; ``degenerate`` is the share of active constraints without a multiplier.
    """
    role = rng.choice(7, size=s.shape, p=np.asarray(roles) / np.sum(roles))
    below, above = s - rng.exponential(size=s.shape), s + rng.exponential(size=s.shape)
    lower = np.where(np.isin(role, (AT_LOWER, EQUAL)), s, np.where(np.isin(role, (FREE, BELOW)), -np.inf, below))
    upper = np.where(np.isin(role, (AT_UPPER, EQUAL)), s, np.where(np.isin(role, (FREE, ABOVE)), np.inf, above))
    push = rng.exponential(size=s.shape)
    sign = np.select([role == AT_LOWER, role == AT_UPPER, role == EQUAL], [1.0, -1.0, rng.choice([-1.0, 1.0], s.shape)])
    return lower, upper, np.where(rng.random(s.shape) < degenerate, 0.0, sign * push)


def plant(
    rng: np.random.Generator,
    H: np.ndarray,
    C: np.ndarray,
    box_roles: Sequence[float],
    row_roles: Sequence[float],
    degenerate: float = 0.0,
) -> QPs:
    """QPs whose solution and multipliers are drawn first."""
    x = rng.normal(size=H.shape[:2])
    lower, upper, z = bounds_around(rng, x, box_roles, degenerate)
    row_lower, row_upper, y = bounds_around(rng, np.einsum("bpn,bn->bp", C, x), row_roles, degenerate)
    g = -np.einsum("bij,bj->bi", H, x) + z + np.einsum("bpn,bp->bn", C, y)
    return QPs(H, g, lower, upper, C, row_lower, row_upper, x, np.ones_like(x))


_BOX = (2, 1, 1, 4, 1, 1, 0.5)
_FEW_ROWS = (2, 1, 1, 4, 1, 1, 1.5)
_FREE_ROWS = (1, 0, 0, 0, 0, 0, 0)


def mixed(rng: np.random.Generator, count: int) -> QPs:
    """Any mix of box, equality rows, two-sided rows, infinite and equal bounds."""
    H = positive_definite(rng, count, VARIABLES)
    return plant(rng, H, rng.normal(size=(count, ROWS, VARIABLES)), _BOX, _FEW_ROWS)


def boxes(rng: np.random.Generator, count: int) -> QPs:
    """A box alone: the rows are zeros without bounds."""
    H = positive_definite(rng, count, VARIABLES)
    return plant(rng, H, np.zeros((count, ROWS, VARIABLES)), (1, 1, 1, 3, 4, 4, 0.5), _FREE_ROWS)


def equality_rows(rng: np.random.Generator, count: int) -> QPs:
    """Eight equality rows and nothing else."""
    H = positive_definite(rng, count, VARIABLES)
    C = rng.normal(size=(count, ROWS, VARIABLES))
    p = plant(rng, H, C, (1, 0, 0, 0, 0, 0, 0), (0, 0, 0, 0, 0, 0, 1))
    multipliers = np.zeros((count, ROWS))
    multipliers[:, :8] = rng.normal(size=(count, 8))
    g = -np.einsum("bij,bj->bi", H, p.x) + np.einsum("bpn,bp->bn", C, multipliers)
    used = np.arange(ROWS) < 8
    return p._replace(
        g=g, row_lower=np.where(used, p.row_lower, -np.inf), row_upper=np.where(used, p.row_upper, np.inf)
    )


def dependent_rows(rng: np.random.Generator, count: int, base: int = 5) -> np.ndarray:
    """Five rows; four copies of them, scaled and turned; four combinations of them; one unit vector."""
    C = rng.normal(size=(count, base, VARIABLES))
    lanes = np.arange(count)[:, None]
    copies = C[lanes, rng.integers(base, size=(count, 4))] * rng.choice([-2.0, -1.0, 1.0, 1.0, 3.0], (count, 4, 1))
    combinations = rng.normal(size=(count, 4, base)) @ C
    units = np.eye(VARIABLES)[rng.integers(VARIABLES, size=(count, ROWS - base - 8))]
    return np.concatenate([C, copies, combinations, units], 1)


def duplicated_equalities(rng: np.random.Generator, count: int) -> QPs:
    """Equalities repeated, scaled, combined: rank 5 or 6 of 14 rows."""
    H = positive_definite(rng, count, VARIABLES)
    return plant(rng, H, dependent_rows(rng, count), (2, 1, 1, 4, 1, 1, 0.5), (0, 0, 0, 0, 0, 0, 1))


def duplicated_rows(rng: np.random.Generator, count: int) -> QPs:
    """The same rows with bounds of every kind, many active at once."""
    H = positive_definite(rng, count, VARIABLES)
    return plant(rng, H, dependent_rows(rng, count), _BOX, (1, 1, 1, 2, 3, 3, 2))


def nearly_dependent_rows(rng: np.random.Generator, count: int) -> QPs:
    """The same rows, each off by a share of 1e-12 to 1e-6: they nearly contradict each other, but do not."""
    H = positive_definite(rng, count, VARIABLES)
    off = 10.0 ** rng.uniform(-12, -6, (count, ROWS, 1)) * rng.normal(size=(count, ROWS, VARIABLES))
    return plant(rng, H, dependent_rows(rng, count) * (1.0 + off), _BOX, (1, 1, 1, 2, 2, 2, 2))


def degenerate(rng: np.random.Generator, count: int) -> QPs:
    """More active constraints than variables, most of them without a multiplier."""
    H = positive_definite(rng, count, VARIABLES)
    C = np.round(rng.normal(size=(count, ROWS, VARIABLES)))
    return plant(rng, H, C, (1, 0, 0, 1, 4, 4, 0), (1, 0, 0, 1, 6, 6, 0), degenerate=0.7)


def vertices(rng: np.random.Generator, count: int) -> QPs:
    """More active constraints than variables, all of them with a multiplier."""
    H = positive_definite(rng, count, VARIABLES)
    C = np.round(rng.normal(size=(count, ROWS, VARIABLES)))
    return plant(rng, H, C, (0, 0, 0, 1, 4, 4, 0), (0, 0, 0, 1, 4, 4, 0))


def pinned(rng: np.random.Generator, count: int) -> QPs:
    """Half of the variables pinned; all of them in every tenth problem. Some rows act on pinned variables alone."""
    H = positive_definite(rng, count, VARIABLES)
    C = rng.normal(size=(count, ROWS, VARIABLES))
    C[:, ::4, : VARIABLES // 2] = 0.0
    C[:, 1::4, VARIABLES // 2 :] = 0.0
    p = plant(rng, H, C, (1, 1, 1, 2, 1, 1, 7), (1, 1, 1, 3, 1, 1, 1))
    half = rng.random(count) < 0.5
    half[::10] = True
    low = np.arange(VARIABLES) < VARIABLES // 2
    everything = np.arange(count) % 10 == 0
    pins = (half[:, None] & low) | everything[:, None]
    return p._replace(lower=np.where(pins, p.x, p.lower), upper=np.where(pins, p.x, p.upper))


def nearly_singular(rng: np.random.Generator, count: int) -> QPs:
    """H of condition 1e10, few active constraints."""
    H = positive_definite(rng, count, VARIABLES, condition=1e10)
    return plant(rng, H, rng.normal(size=(count, ROWS, VARIABLES)), _BOX, _FEW_ROWS)


def scales(rng: np.random.Generator, count: int, n: int) -> np.ndarray:
    """From 1e-6 to 1e6: one a lane in even lanes, one an entry in odd ones."""
    exponents = rng.uniform(-6.0, 6.0, size=(count, n))
    exponents[::2] = exponents[::2, :1]
    return 10.0**exponents


def rescaled(p: QPs, variables: np.ndarray, rows: np.ndarray, cost: np.ndarray) -> QPs:
    """The same problems in other units of the variables, the rows and the cost."""
    return QPs(
        H=cost[:, None, None] * p.H / variables[:, :, None] / variables[:, None, :],
        g=cost[:, None] * p.g / variables,
        lower=p.lower * variables,
        upper=p.upper * variables,
        C=rows[:, :, None] * p.C / variables[:, None, :],
        row_lower=p.row_lower * rows,
        row_upper=p.row_upper * rows,
        x=p.x * variables,
        unit=p.unit * variables,
    )


def scaled_variables(rng: np.random.Generator, count: int) -> QPs:
    p = mixed(rng, count)
    return rescaled(p, scales(rng, count, VARIABLES), np.ones((count, ROWS)), np.ones(count))


def scaled_rows(rng: np.random.Generator, count: int) -> QPs:
    p = mixed(rng, count)
    return rescaled(p, np.ones((count, VARIABLES)), scales(rng, count, ROWS), np.ones(count))


def scaled_cost(rng: np.random.Generator, count: int) -> QPs:
    p = mixed(rng, count)
    return rescaled(p, np.ones((count, VARIABLES)), np.ones((count, ROWS)), scales(rng, count, 1)[:, 0])


def scaled_altogether(rng: np.random.Generator, count: int) -> QPs:
    p = mixed(rng, count)
    return rescaled(p, scales(rng, count, VARIABLES), scales(rng, count, ROWS), scales(rng, count, 1)[:, 0])


PLANTED = {
    f.__name__: f
    for f in (
        mixed,
        boxes,
        equality_rows,
        duplicated_equalities,
        duplicated_rows,
        degenerate,
        vertices,
        pinned,
        nearly_singular,
        scaled_variables,
        scaled_rows,
        scaled_cost,
        scaled_altogether,
    )
}


def inconsistent_equalities(rng: np.random.Generator, count: int) -> QPs:
    """Four rows, then four that repeat or combine them with other targets; a box. No x fits; ``x`` is unknown."""
    p = mixed(rng, count)
    C = np.zeros_like(p.C)
    C[:, :4] = rng.normal(size=(count, 4, VARIABLES))
    C[:, 4:8] = rng.normal(size=(count, 4, 4)) @ C[:, :4]
    C[::2, 4:6] = C[::2, :2]
    used = np.arange(ROWS) < 8
    d = rng.normal(size=(count, ROWS))
    tight = rng.random((count, VARIABLES)) < 0.7
    lower = np.where(tight, -rng.exponential(0.3, tight.shape), -np.inf)
    upper = np.where(tight, rng.exponential(0.3, tight.shape), np.inf)
    row_lower, row_upper = np.where(used, d, -np.inf), np.where(used, d, np.inf)
    return QPs(p.H, p.g, lower, upper, C, row_lower, row_upper, np.full_like(p.x, np.nan), p.unit)


def inconsistent_rows(rng: np.random.Generator, count: int) -> QPs:
    """Rows that no point of the box satisfies, beside rows that some do: equal, one-sided and two-sided bounds."""
    p = mixed(rng, count)
    lower = -rng.uniform(0.1, 1.0, size=p.lower.shape)
    upper = rng.uniform(0.1, 1.0, size=p.upper.shape)
    reach = np.einsum("bpn,bn->bp", np.abs(p.C), np.maximum(-lower, upper))
    beyond = np.arange(ROWS) < 2
    low = np.where(beyond, reach * rng.uniform(1.05, 1.5, reach.shape), -0.2 * reach)
    high = np.where(beyond, low + rng.exponential(size=low.shape), 0.2 * reach)
    high[::3, 0] = low[::3, 0]
    high[1::3, 0] = np.inf
    unused = np.arange(ROWS) >= 6
    row_lower, row_upper = np.where(unused, -np.inf, low), np.where(unused, np.inf, high)
    return QPs(p.H, p.g, lower, upper, p.C, row_lower, row_upper, np.full_like(p.x, np.nan), p.unit)


def opposite_rows(rng: np.random.Generator, count: int) -> QPs:
    """Two rows pull at one variable from both sides; the others hold, and most variables stand in these alone."""
    p = mixed(rng, count)
    C, row_lower, row_upper = p.C.copy(), p.row_lower.copy(), p.row_upper.copy()
    C[:, :2] = np.eye(C.shape[2])[0]
    apart = p.unit[..., 0] * rng.uniform(0.1, 1.0, count)
    row_lower[:, 0], row_upper[:, 0] = p.x[:, 0] + apart, np.inf
    row_lower[:, 1], row_upper[:, 1] = -np.inf, p.x[:, 0] - apart
    room = 0.1 * p.unit  # no variable is pinned: SciPy takes none
    unknown = np.full_like(p.x, np.nan)
    return QPs(p.H, p.g, p.lower - room, p.upper + room, C, row_lower, row_upper, unknown, p.unit)


class LeastSquares(NamedTuple):
    """min 1/2 sum weight (A x - b)^2 + damping/2 |x|^2  over  lower <= x <= upper, batched."""

    A: np.ndarray
    b: np.ndarray
    weight: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    x: np.ndarray


WHOLE_BODY = (30, 24)  # variables, task rows; 24 rows more are the posture
WHOLE_BODY_DAMPING = 1e-9


def whole_body(rng: np.random.Generator, count: int) -> LeastSquares:
    """Tasks of weights 1e-1 to 1e2, an unbounded base, a posture of weight 1e-4; every third target unreachable."""
    n, tasks = WHOLE_BODY
    joints = n - 6
    A = np.zeros((count, tasks + joints, n))
    A[:, :tasks] = rng.normal(size=(count, tasks, n)) * (rng.random((count, tasks, n)) < 0.5)
    A[:, :tasks, :6] = rng.normal(size=(count, tasks, 6))
    A[:, tasks:, 6:] = np.eye(joints)
    weight = np.concatenate([10.0 ** rng.uniform(-1, 2, (count, tasks)), np.full((count, joints), 1e-4)], 1)
    x = rng.normal(size=(count, n))
    lower, upper, z = bounds_around(rng, x, (0, 0, 0, 3, 1, 1, 0.2))
    lower[:, :6], upper[:, :6], z[:, :6] = -np.inf, np.inf, 0.0
    z *= 1e-4
    pull = 1e-4 * rng.normal(size=(count, tasks)) * (np.arange(count)[:, None] % 3 == 0)  # weight times residual
    base = A[:, :tasks, :6]
    missing = np.einsum("bti,bt->bi", base, pull) + WHOLE_BODY_DAMPING * x[:, :6]
    pull = pull - np.einsum("bit,bi->bt", np.linalg.pinv(base), missing)
    rest = z - WHOLE_BODY_DAMPING * x - np.einsum("bti,bt->bi", A[:, :tasks], pull)
    residual = np.concatenate([pull, rest[:, 6:]], 1) / weight
    return LeastSquares(A, np.einsum("bmn,bn->bm", A, x) - residual, weight, lower, upper, x)


def redundant(rng: np.random.Generator, count: int) -> LeastSquares:
    """Fewer rows than free variables, all reachable: the damping alone decides the rest; ``x`` is unknown."""
    p = whole_body(rng, count)
    _, tasks = WHOLE_BODY
    weight = p.weight.copy()
    weight[:, 8:tasks], weight[:, tasks:] = 0.0, 0.0
    lower = np.where(np.isfinite(p.lower), -rng.uniform(0.05, 0.6, p.lower.shape), -np.inf)
    upper = np.where(np.isfinite(p.upper), rng.uniform(0.05, 0.6, p.upper.shape), np.inf)
    inside = rng.random(lower.shape)
    bounded = np.isfinite(lower)
    within = np.where(bounded, lower, 0.0) + inside * np.where(bounded, upper - lower, 0.0)
    x = np.where(bounded, within, rng.normal(size=lower.shape))
    return LeastSquares(p.A, np.einsum("bmn,bn->bm", p.A, x), weight, lower, upper, np.full_like(x, np.nan))
