"""What must not matter: the order of joints, the order of rows in a level, and where the world's origin is."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SO3

import osik_jax as osik
from osik_jax.solvers import Level, Status, solve_hqp, solve_least_squares_qp, solve_nullspace

LANES, N, SIZES = 100, 12, (4, 3, 5)


def qp(levels, lower, upper, secondary):
    A, b = (jnp.concatenate(parts) for parts in zip(*levels, strict=True))
    s = solve_least_squares_qp(A, b, jnp.ones(len(b)), lower, upper, damping=1e-6)
    return s.x, s.status


def hqp(levels, lower, upper, secondary):
    s = solve_hqp(
        [Level(A, b - 0.1, b + 0.1) if k == 1 else Level(A, b) for k, (A, b) in enumerate(levels)], lower, upper
    )
    return s.x, s.status


def null_space(**options):
    def solve(levels, lower, upper, secondary):
        box = (lower, upper) if options.get("order") is None else ()
        s = solve_nullspace([Level(*level) for level in levels], *box, secondary=secondary, **options)
        return s.x, s.status

    return solve


METHODS = {
    "weighted": qp,
    "hierarchical": hqp,
    "saturated": null_space(),
    "forward": null_space(damping=1e-3),
}


@pytest.mark.variants(release=["saturated", "hierarchical", "forward"])
@pytest.mark.parametrize(
    "method", [pytest.param(name, marks=pytest.mark.slow if name == "saturated" else ()) for name in METHODS]
)
def test_the_order_of_joints_and_of_rows(rng, method):
    """Tight boxes: most lanes have a dozen changes of the active set."""
    levels = [(rng.normal(size=(LANES, m, N)), 3.0 * rng.normal(size=(LANES, m))) for m in SIZES]
    lower, upper = -rng.uniform(0.1, 1.0, (LANES, N)), rng.uniform(0.1, 1.0, (LANES, N))
    secondary = rng.normal(size=(LANES, N))
    solve = jax.jit(jax.vmap(METHODS[method]))
    x, status = solve(levels, lower, upper, secondary)
    joints, rows = rng.permutation(N), [rng.permutation(m) for m in SIZES]
    mixed = [(A[:, r][..., joints], b[:, r]) for (A, b), r in zip(levels, rows, strict=True)]
    y, _ = solve(mixed, lower[:, joints], upper[:, joints], secondary[:, joints])
    assert (status == Status.SOLVED).all()
    np.testing.assert_allclose(y, x[:, joints], rtol=0, atol=1e-9)


SCHEMES = {
    "weighted": osik.WeightedQP(),
    "hierarchical": osik.HierarchicalQP(),
    "null-space": osik.NullSpace(damping=1e-3),
    "saturated": osik.NullSpace(method="saturated"),
}


@pytest.mark.release
@pytest.mark.parametrize("scheme", SCHEMES)
def test_where_the_world_is(rng, scheme):
    """The base and all targets turned and moved: the same joint velocities, a base velocity turned with them."""
    robot = osik.load_robot("nao")
    start = robot.q0.at[7:].add(rng.uniform(-0.1, 0.1, robot.nq - 7))
    kin = osik.forward_kinematics(robot, start)
    (p, R), centre = kin.frame_pose(robot, "r_wrist"), osik.center_of_mass(robot, kin)
    speed = 0.2 * rng.normal(size=6)
    tasks = {
        "foot": osik.FrameTask(robot, "l_sole", target=kin.frame_pose(robot, "l_sole"), priority=1),
        "com": osik.ComTask(robot, target=centre + jnp.array([0.02, 0.05, -0.1]), priority=2),
        "hand": osik.FrameTask(robot, "r_wrist", target=(p + jnp.array([0.1, -0.2, 0.3]), R), priority=3),
        "posture": osik.PostureTask(robot, weight=1e-2, priority=4),
    }
    limits = osik.ConfigurationLimit(robot), osik.VelocityLimit(robot, velocity={"*": 0.5})

    @jax.jit
    @jax.vmap
    def solved(turn, shift):
        def moved(task):
            if isinstance(task, osik.FrameTask):
                return task.replace(target=(turn @ task.target[0] + shift, turn @ task.target[1]))
            return task.replace(target=turn @ task.target + shift) if isinstance(task, osik.ComTask) else task

        here = {name: moved(task) for name, task in tasks.items()}
        here["foot"] = here["foot"].replace(target_velocity=jnp.concatenate([turn @ speed[:3], turn @ speed[3:]]))
        base = SO3.from_matrix(turn) @ SO3(start[3:7])
        q = jnp.concatenate([turn @ start[:3] + shift, base.wxyz, start[7:]])
        return osik.solve(robot, q, here, scheme=SCHEMES[scheme], limits=limits)

    turns = SO3.exp(jnp.vstack([np.zeros(3), rng.normal(size=(4, 3))])).as_matrix()
    answer = solved(turns, jnp.vstack([np.zeros(3), rng.normal(size=(4, 3))]))
    v = np.asarray(answer.velocity)
    assert (answer.status == Status.SOLVED).all()
    assert (np.abs(v[0, 6:]) > 0.4999).sum() > (0 if "null" in scheme else 3)
    np.testing.assert_allclose(v[:, 3:], np.broadcast_to(v[0, 3:], v[:, 3:].shape), rtol=0, atol=1e-7)
    np.testing.assert_allclose(v[:, :3], turns @ v[0, :3], rtol=0, atol=1e-7)
