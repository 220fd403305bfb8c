"""Hard work of a whole robot: calm out of reach, feet that stay, derivatives at the start, steps that are none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import osik_jax as osik
from benchmarks.hard._reach import farthest
from benchmarks.robots import workload
from osik_jax.numerics._constants import COST_FRACTION, MIN_RADIUS
from osik_jax.robot._mujoco import mujoco_frame_pose, mujoco_poses
from osik_jax.solvers import Damping, Level, Status, solve_hqp, solve_least_squares_qp
from osik_jax.solvers._damping import level_damping

DT, STEPS = 0.005, 800
LATE = 400
"""The first step of those that are judged."""
CALM = 0.1
"""The rms speed of a robot at rest [rad/s]."""
FEET = ("l_sole", "r_sole")
SCHEMES = {
    "weighted": osik.WeightedQP,
    "hierarchy": osik.HierarchicalQP,
    "null space": osik.NullSpace,
    "saturated null space": lambda: osik.NullSpace(method="saturated"),
}
QUICK_METHODS = {
    "null space": osik.NullSpace,
    "damped null space": lambda: osik.NullSpace(damping=1e-4),
}
METHODS = SCHEMES | QUICK_METHODS


def places_of(robot, path, frame):
    """Places of a frame, by MuJoCo C. (T, 3)"""
    return np.array([mujoco_frame_pose(robot, data, frame)[0] for data in mujoco_poses(robot, np.asarray(path, float))])


def held(robot, tasks, scheme, places, gains):
    """Motions to each place at each gain, one compiled program: joint speeds, statuses, configurations."""
    rotation = tasks["hand"].target[1]

    @jax.jit
    @jax.vmap
    def motion(place, gain):
        aimed = {name: task.replace(gain=gain) for name, task in tasks.items()}
        aimed["hand"] = aimed["hand"].replace(target=(place, rotation))
        run = osik.rollout(robot, robot.q0, aimed, scheme=scheme, dt=DT, steps=STEPS)
        return run.solution.velocity, run.solution.status, run.q

    return [np.asarray(part) for part in motion(jnp.asarray(places), jnp.asarray(gains))]


def assert_calm(robot, velocity, status, rest, *, limits=True):
    """At rest from that step on, far from top speed after two seconds, and before never above it but without limits."""
    base = 6 if robot.floating_base else 0
    joints, top = velocity[..., base:], np.asarray(robot.velocity_limit)[base:]
    assert np.isfinite(velocity).all() and (not limits or (np.abs(joints) <= top * (1.0 + 1e-9)).all())
    assert np.sqrt((joints[:, rest:] ** 2).mean((1, 2))).max() < CALM
    assert (np.abs(joints[:, LATE:]) < 0.2 * top).all()
    assert (status == Status.SOLVED).all()


class TestOutOfReach:
    DIRECTIONS = np.array([[1.0, 0.0, 0.2], [0.3, 1.0, 0.1], [0.3, 0.3, 1.0]])
    GAINS = (10.0, 200.0)

    def lanes(self, middle, away):
        """Places ``away`` from a point, each at each gain."""
        units = self.DIRECTIONS / np.linalg.norm(self.DIRECTIONS, axis=1, keepdims=True)
        places = middle + away * units
        return np.repeat(places, len(self.GAINS), 0), np.tile(self.GAINS, len(places))

    @pytest.mark.variants(release=["saturated null space-True", "hierarchy-False"])
    @pytest.mark.variants(release=["hierarchy-True"])
    @pytest.mark.parametrize(
        ("scheme", "posture"),
        [
            ("weighted", False),
            ("hierarchy", True),
            pytest.param("hierarchy", False, marks=pytest.mark.slow),
            pytest.param("null space", True, marks=pytest.mark.slow),
            pytest.param("saturated null space", True, marks=pytest.mark.slow),
        ],
    )
    def test_an_arm_comes_to_rest(self, arm, scheme, posture):
        """The target is 1.4 m from its shoulder; the hand gets as near as Pinocchio's farthest place is.

        A posture of a lower priority pulls at the stretched arm all the time.
        """
        shoulder = places_of(arm, [arm.q0], "link2")[0]
        places, gains = self.lanes(shoulder, 1.4)
        work = workload("arm7")
        tasks: dict[str, osik.Task] = {"hand": osik.FrameTask(arm, "hand", rows="position")}
        if posture:
            tasks["posture"] = osik.PostureTask(arm, target=jnp.full(7, 0.4), gain=10.0, priority=2, weight=1.0)
        velocity, status, path = held(arm, tasks, METHODS[scheme](), places, gains)
        assert_calm(arm, velocity, status, LATE, limits=scheme != "null space")
        for lane, place in enumerate(places):
            nearest = farthest(work, (place - shoulder) / 1.4)
            left = np.linalg.norm(places_of(arm, path[lane, -1:], "hand")[0] - place)
            assert left == pytest.approx(np.linalg.norm(nearest - place), rel=0.01)

    @pytest.mark.release
    @pytest.mark.parametrize(("scheme", "rest"), [("weighted", 400), ("hierarchy", 600)])
    def test_a_nao_comes_to_rest_on_its_feet(self, nao, scheme, rest):
        """The hand's target is 0.6 m from where it is; the hierarchy takes 3 s for the last of the way."""
        tasks: dict[str, osik.Task] = {foot: osik.FrameTask(nao, foot, weight=100.0, priority=1) for foot in FEET}
        tasks["com"] = osik.ComTask(nao, weight=25.0, priority=2)
        tasks["hand"] = osik.FrameTask(nao, "l_gripper", rows="position", priority=3)
        places, gains = self.lanes(places_of(nao, [nao.q0], "l_gripper")[0], 0.6)
        velocity, status, path = held(nao, tasks, SCHEMES[scheme](), places, gains)
        assert_calm(nao, velocity, status, rest)
        for foot in FEET:
            start = places_of(nao, [nao.q0], foot)[0]
            for lane in path:
                assert np.linalg.norm(places_of(nao, lane[LATE::50], foot) - start, axis=1).max() < 2e-3

    @pytest.mark.release
    def test_a_g1_whose_balance_is_a_polygon_comes_to_rest(self):
        """Rows of the polygon stop the hand's level, whose gain is low; feet stay within 0.1 mm by MuJoCo C."""
        bent = {"hip_pitch": -0.3, "knee": 0.6, "ankle_pitch": -0.3}
        home = {f"{side}_{joint}_joint": angle for side in ("left", "right") for joint, angle in bent.items()}
        g1 = osik.load_robot("g1", home=home)
        feet = ("left_ankle_roll_link", "right_ankle_roll_link")
        sole = [[x, y, -0.03] for x in (-0.05, 0.12) for y in (-0.025, 0.025)]
        polygon = osik.support_polygon(g1, g1.q0, feet, margin=0.02, corners=dict.fromkeys(feet, sole))
        tasks: dict[str, osik.Task] = {foot: osik.FrameTask(g1, foot, priority=1) for foot in feet}
        tasks["com"] = osik.ComTask(g1, polygon=polygon, priority=2)
        tasks["hand"] = osik.FrameTask(g1, "right_rubber_hand", rows="position", priority=3)
        tasks["posture"] = osik.PostureTask(g1, priority=4)
        middle, away = places_of(g1, [g1.q0], "right_rubber_hand")[0], np.array([[0.7, 0.0, -0.42], [0.8, 0.0, -0.48]])

        @jax.jit
        @jax.vmap
        def motion(place):
            aimed = tasks | {"hand": tasks["hand"].replace(gain=2.0, target=(place, jnp.eye(3)))}
            run = osik.rollout(g1, g1.q0, aimed, scheme=osik.HierarchicalQP(), dt=DT, steps=STEPS)
            return run.solution.velocity, run.solution.status, run.q

        velocity, status, path = (np.asarray(part) for part in motion(jnp.asarray(middle + away)))
        assert_calm(g1, velocity, status, 600)
        for foot in feet:
            start = places_of(g1, [g1.q0], foot)[0]
            for lane in path:
                assert np.linalg.norm(places_of(g1, lane[LATE::50], foot) - start, axis=1).max() < 1e-4


@pytest.mark.variants(release=["weighted"])
@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["weighted", "hierarchy"])
def test_a_hand_follows_a_curve_within_reach_while_the_feet_are_hard(nao, scheme):
    """The benchmark's curve of 4 to 6 cm; feet that bend no path must not damp the hand. Places by MuJoCo C."""
    work, steps = workload("nao"), 400
    tasks: dict[str, osik.Task] = {foot: osik.FrameTask(nao, foot, hard=True, gain=200.0) for foot in FEET}
    priority = 1 if scheme == "weighted" else 2
    tasks["com"] = osik.ComTask(nao, weight=25.0, gain=200.0, priority=1)
    tasks["hand"] = osik.FrameTask(nao, work.hand, rows="position", gain=200.0, priority=priority)
    curve = np.array([work.hand_at(k) for k in range(steps)])
    start = places_of(nao, [nao.q0], work.hand)[0]
    curve += start - curve[0]
    run = osik.rollout(nao, nao.q0, tasks, scheme=SCHEMES[scheme](), dt=DT, steps=steps, targets={"hand": curve})
    assert (np.asarray(run.solution.status) == Status.SOLVED).all()
    path = np.asarray(run.q)[1:]
    off = np.linalg.norm(places_of(nao, path[100::5], work.hand) - curve[100::5], axis=1)
    assert np.ptp(curve, axis=0).max() > 0.05 and off.max() < 1e-3
    for foot in FEET:
        assert np.linalg.norm(places_of(nao, path[::20], foot) - places_of(nao, [nao.q0], foot)[0], axis=1).max() < 1e-4


@pytest.mark.release
@pytest.mark.parametrize(
    "method", [name if name in QUICK_METHODS else pytest.param(name, marks=pytest.mark.slow) for name in METHODS]
)
def test_derivatives_at_the_start_are_central_differences(arm, rng, method):
    """Every robot starts with errors of exactly 0, where clipping between equal bounds would split derivatives."""
    tasks = {
        "hand": osik.FrameTask(arm, "hand", rows="position"),
        "posture": osik.PostureTask(arm, priority=2, weight=1.0),
    }
    along, mix = rng.normal(size=(2, arm.nv))
    scheme = METHODS[method]()

    def cost(t):
        return osik.solve(arm, arm.q0 + t * along, tasks, scheme=scheme, dt=0.01).velocity @ mix

    both, h = jax.jit(jax.value_and_grad(cost)), 1e-7
    expected = float(both(h)[0] - both(-h)[0]) / (2.0 * h)
    assert abs(expected) > 1.0
    assert float(both(0.0)[1]) == pytest.approx(expected, rel=1e-7)
    assert float(jax.jvp(cost, (0.0,), (1.0,))[1]) == pytest.approx(expected, rel=1e-7)


def test_the_share_that_is_out_of_reach_in_single_precision():
    """Dependent rows that ask for what cannot be had, with a damping under the rounding of their squares.

    What the rows leave is NumPy's lstsq's: as little damping changes nothing of it.
    """
    rng, count, n = np.random.default_rng(1), 200, 7
    rows = rng.normal(size=(count, 12, 4)) @ rng.normal(size=(count, 4, n))
    unmet = 10.0 ** rng.uniform(-10.0, -6.0, count) * (rows**2).sum((1, 2))
    goal = rng.normal(size=(count, 12))
    left = [b - A @ np.linalg.lstsq(A, b, rcond=1e-10)[0] for A, b in zip(rows, goal, strict=True)]
    expected = np.linalg.norm(left, axis=1) / np.linalg.norm(goal, axis=1)
    assert expected.min() > 0.3

    @jax.jit
    @jax.vmap
    def found(rows, goal, unmet):
        damping = Damping(jnp.zeros_like(unmet), unmet, jnp.linalg.norm(goal))
        nothing = jnp.zeros(n, rows.dtype)
        free = jnp.full_like(nothing, jnp.inf)
        return level_damping(damping, Level(rows, goal), nothing, jnp.eye(n, dtype=rows.dtype), -free, free)

    for dtype, atol in ((jnp.float64, 1e-4), (jnp.float32, 1e-3)):
        share = np.asarray(found(*(jnp.asarray(a, dtype) for a in (rows, goal, unmet)))) / unmet
        np.testing.assert_allclose(share, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("backend", ["auto", "jax"])
@pytest.mark.parametrize("pull", [1.5, 0.0])
def test_a_level_below_ends_at_its_room_and_names_no_bound(pull, backend):
    """The level asks for a motion of x, which it gets, and for 2 of what nothing moves; y is free of its rows.

    Without progress next to nothing is left of y's room.
    """
    first = Level(jnp.array([[1.0, 0.0], [0.0, 0.0]]), jnp.array([pull, 2.0]))
    wanted, free = Level(jnp.eye(2), jnp.array([1.0, 1.0])), jnp.full(2, jnp.inf)
    damping = Damping(0.0, 1e-6, np.hypot(pull, 2.0), jnp.array([0.0, 0.5])), 0.0
    found = solve_hqp([first, wanted], -free, free, damping=damping, backend=backend)
    room = np.sqrt(COST_FRACTION * pull**2 / (2.0 * 0.5)) + MIN_RADIUS
    np.testing.assert_allclose(found.x, [pull, room], rtol=1e-5, atol=1e-9)
    assert found.status == Status.SOLVED and (np.asarray(found.active) == 0).all()


@pytest.mark.variants(slow=["scheme0", "scheme1"])
@pytest.mark.parametrize("scheme", [osik.WeightedQP(), osik.HierarchicalQP(), osik.NullSpace(method="saturated")])
def test_steps_are_solved_at_rest(nao, scheme):
    """A hand near its target, and a posture that pulls back."""
    first, then = (1, 1) if isinstance(scheme, osik.WeightedQP) else (1, 2)
    tasks: dict[str, osik.Task] = {foot: osik.FrameTask(nao, foot, weight=100.0, priority=first) for foot in FEET}
    tasks["com"] = osik.ComTask(nao, weight=10.0, priority=first)
    place, turn = osik.forward_kinematics(nao, nao.q0).frame_pose(nao, "l_gripper")
    target = place + jnp.array([0.03, -0.02, 0.04]), turn
    tasks["hand"] = osik.FrameTask(nao, "l_gripper", rows="position", target=target, priority=then)
    tasks["posture"] = osik.PostureTask(nao, weight=1e-3, gain=10.0, priority=then)
    found = osik.rollout(nao, nao.q0, tasks, scheme=scheme, dt=0.02, steps=400).solution
    assert (found.status == Status.SOLVED).all()
    assert jnp.abs(found.velocity[-20:]).max() < 1e-12


def test_no_search_follows_the_core_at_rest(rng):
    """Residuals that balance each other: the answer is 0 but for roundoff, and so is all that it is measured by."""
    A, weight = rng.normal(size=(20, 9, 6)), 10.0 ** rng.uniform(-3, 2, (20, 9))
    pulls = np.linalg.svd((weight[..., None] * A).transpose(0, 2, 1))[2][:, -1]  # A' W pulls = 0
    limit = np.tile([np.inf, np.inf, np.inf, 0.5, 0.5, 0.5], (20, 1))
    solve = jax.jit(jax.vmap(lambda *a: solve_least_squares_qp(*a, backend="core")))
    found = solve(A, pulls, weight, -limit, limit)
    assert (found.status == Status.SOLVED).all() and jnp.abs(found.x).max() < 1e-10
    np.testing.assert_array_equal(found.factorizations, 1)
