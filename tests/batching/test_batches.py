"""Batches by name equal a loop, mistakes are named, and scaled links are MuJoCo's with its model edited."""

from __future__ import annotations

import copy
from fnmatch import fnmatchcase
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco_states import full_velocities
from refusals import refuses
from task_checks import moved_by

import osik_jax as osik
from osik_jax.robot._mujoco import mujoco_poses, robot_com
from osik_jax.solvers import Level, solve_hqp, solve_least_squares_qp, solve_nullspace, solve_qp

DT = 0.01
LANES = 3


@pytest.fixture(scope="module")
def tasks(arm):
    return {
        "hand": osik.FrameTask(arm, "hand", gain=osik.AdaptiveGain(6.0, 2.0, 3.0)),
        "elbow": osik.FrameTask(arm, "link4", rows="position", gain=3.0, priority=2),
        "posture": osik.PostureTask(arm, weight=0.05, gain=1.0, priority=3),
    }


@pytest.fixture(scope="module")
def limits(arm):
    return osik.ConfigurationLimit(arm), osik.VelocityLimit(arm, velocity={"*": 0.8})


@pytest.fixture(scope="module")
def start(arm):
    return arm.q0 + 0.3 * np.random.default_rng(5).normal(size=(LANES, arm.nq))


def velocity(robot, q, tasks, limits):
    return osik.solve(robot, q, tasks, scheme=osik.WeightedQP(damping=1e-3), limits=limits, dt=DT).velocity


def together(axes, *args):
    return jax.jit(jax.vmap(velocity, in_axes=axes))(*args)


def moved(task, shift):
    position, rotation = task.target
    return task.replace(target=(position + shift, rotation))


class TestBatchesEqualLoops:
    @pytest.mark.release
    def test_over_configurations_and_targets(self, arm, tasks, limits, start):
        """The batch of targets comes out of a vmapped replace, with the same axes."""
        shifts = jnp.linspace(-0.1, 0.1, LANES * 3).reshape(LANES, 3)
        axes = osik.batch_axes(tasks, "hand.target[0]")
        many = jax.vmap(lambda shift: {**tasks, "hand": moved(tasks["hand"], shift)}, out_axes=axes)(shifts)
        assert many["hand"].target[0].shape == (LANES, 3) and many["hand"].target[1].shape == (3, 3)
        got = together((None, 0, axes, None), arm, start, many, limits)
        loop = [
            velocity(arm, q, {**tasks, "hand": moved(tasks["hand"], shift)}, limits)
            for q, shift in zip(start, shifts, strict=True)
        ]
        np.testing.assert_allclose(got, np.stack(loop), atol=1e-10)

    @pytest.mark.slow
    def test_over_weights_and_gains(self, arm, tasks, limits):
        values = {"*.weight": jnp.array([0.1, 1.0, 10.0]), "hand.gain.maximum": jnp.array([2.0, 4.0, 8.0])}
        axes = osik.batch_axes(tasks, *values)
        tipped = {**tasks, "hand": moved(tasks["hand"], 0.2)}
        got = together((None, None, axes, None), arm, arm.q0, osik.batched(tipped, values), limits)
        for i, weight in enumerate((0.1, 1.0, 10.0)):
            hand = tipped["hand"].replace(weight=weight, gain=osik.AdaptiveGain(2.0 * 2**i, 2.0, 3.0))
            own = {name: task.replace(weight=weight) for name, task in tipped.items()} | {"hand": hand}
            np.testing.assert_allclose(got[i], velocity(arm, arm.q0, own, limits), atol=1e-10)
        assert np.abs(got[0] - got[2]).max() > 0.01

    def test_over_limits(self, arm, tasks, limits):
        speeds = jnp.array([0.1, 0.4, 0.8])
        tipped = {**tasks, "hand": moved(tasks["hand"], 0.2)}
        axes = osik.batch_axes(limits, "[1].velocity")
        many = osik.batched(limits, {"[1].velocity": speeds})
        got = together((None, None, None, axes), arm, arm.q0, tipped, many)
        np.testing.assert_allclose(np.abs(got).max(1), speeds, atol=1e-12)
        own = limits[0], osik.VelocityLimit(arm, velocity={"*": 0.4})
        np.testing.assert_allclose(got[1], velocity(arm, arm.q0, tipped, own), atol=1e-10)

    @pytest.mark.slow
    def test_over_task_sets_and_robots(self, arm, tasks, limits, start):
        sets = [
            {**tasks, "hand": moved(tasks["hand"], 0.1 * i), "posture": tasks["posture"].replace(gain=float(i))}
            for i in range(LANES)
        ]
        robots = [arm.scaled(length={"link[35]": 1.0 + 0.1 * i}, mass={"link7": 2.0**i}) for i in range(LANES)]
        got = together((0, 0, 0, None), osik.stack(robots), start, osik.stack(sets), limits)
        loop = [velocity(*own, limits) for own in zip(robots, start, sets, strict=True)]
        np.testing.assert_allclose(got, np.stack(loop), atol=1e-10)


def levels(A, b):
    return [Level(A[:1], b[:1]), Level(A[1:], b[1:] - 1.0, b[1:])]


SOLVERS = {
    "qp": lambda A, b, box: solve_qp(A.T @ A + jnp.eye(3), b, *box),
    "least squares": lambda A, b, box: solve_least_squares_qp(A, b, jnp.ones(3), *box, A[:1], b[:1], b[:1]),
    "hierarchy": lambda A, b, box: solve_hqp(levels(A, b), *box),
    "null space": lambda A, b, _: solve_nullspace(levels(A, b)),
    "saturated": lambda A, b, box: solve_nullspace(levels(A, b), *box),
}


class TestBatchesOfNone:
    """A batch of 0 problems gives arrays of 0, whoever computes them."""

    box = -np.ones(3), np.ones(3)

    @pytest.mark.variants(slow=["saturated"])
    @pytest.mark.parametrize("solver", SOLVERS)
    def test_solvers(self, solver):
        def solve(A, b):
            return SOLVERS[solver](A, b, self.box)

        def two_axes(A, b):
            return jax.vmap(jax.vmap(solve))(A, b)

        for batch, run in (((0, 2), jax.jit(two_axes)), ((2, 0), partial(jax.eval_shape, two_axes))):
            answer = run(jnp.zeros((*batch, 3, 3)), jnp.zeros((*batch, 3)))
            assert answer.x.shape == (*batch, 3)
            assert all(leaf.shape[:2] == batch for leaf in jax.tree.leaves(answer))

    @pytest.mark.variants(slow=["saturated"])
    @pytest.mark.parametrize(
        "scheme",
        [
            osik.WeightedQP(),
            osik.HierarchicalQP(),
            *(osik.NullSpace(method=method) for method in ("classical", "saturated")),
        ],
        ids=["weighted", "hierarchy", "classical", "saturated"],
    )
    def test_schemes(self, arm, tasks, limits, start, scheme):
        def solve(q):
            return osik.solve(arm, q, tasks, scheme=scheme, limits=limits, dt=DT)

        answer = jax.jit(jax.vmap(solve))(start[:0])
        assert answer.velocity.shape == (0, arm.nv) and answer.status.shape == (0,)


class TestNames:
    def test_axes_are_a_tree_like_the_tasks(self, tasks):
        axes = osik.batch_axes(tasks, "hand.target", "*.weight", axis=1)
        assert axes["hand"].target == (1, 1) and axes["hand"].weight == 1 and axes["posture"].weight == 1
        assert axes["hand"].gain.maximum is None and axes["elbow"].target == (None, None)
        whole = osik.batch_axes(tasks, "elbow")
        assert set(jax.tree.leaves(whole)) == {0} and len(jax.tree.leaves(whole)) == len(
            jax.tree.leaves(tasks["elbow"])
        )

    def test_a_star_stops_at_a_dot(self, tasks):
        assert osik.batch_axes(tasks, "*.gain")["hand"].gain.maximum == 0
        refuses(KeyError, "no number '\\*.maximum'", osik.batch_axes, tasks, "*.maximum")

    def test_robots_and_limits(self, arm, limits):
        axes = osik.batch_axes(arm, "body_mass", "body_position")
        assert (axes.body_mass, axes.body_position, axes.q0) == (0, 0, None)
        assert jax.tree.leaves(osik.batch_axes(limits, "[*].lower")) == [0]

    def test_unknown_names_list_what_there_is(self, tasks):
        with pytest.raises(KeyError, match="no number 'hand.wieght'; did you mean 'hand.weight'.*posture.gain"):
            osik.batch_axes(tasks, "hand.wieght")
        refuses(KeyError, "hand.target", osik.batched, tasks, {"hand.tar": jnp.zeros(3)})

    @pytest.mark.parametrize(
        "values, message",
        [
            ({"hand.weight": 1.0}, "hand.weight is one number; it needs an axis in front, the batch"),
            ({"hand.target": (np.zeros((2, 3)), np.zeros((2, 3)))}, "expected \\(3, 3\\) with an axis in front"),
            ({"hand.target": (np.zeros((2, 3)),) * 3}, "stands for 2 arrays .* but 3 are given"),
            ({"hand.weight": np.ones(2), "elbow.weight": np.ones(3)}, "lengths of the batch differ.*2.*3"),
            ({"hand.weight": np.ones(2), "*.weight": np.ones(2)}, "hand.weight is given twice"),
        ],
    )
    def test_wrong_batches(self, tasks, values, message):
        refuses(ValueError, message, osik.batched, tasks, values)


def test_lists_of_numbers_are_arrays_and_iterators_stack():
    """A whole number becomes a batch of the numbers that are given; a list of arrays is still one for each."""
    tree = {"n": 1, "w": jnp.ones(2)}
    found = osik.batched(tree, {"n": [0.5, 1.5], "w": [[1.0, 2.0], [3.0, 4.0]]})
    np.testing.assert_array_equal(found["n"], [0.5, 1.5])
    np.testing.assert_array_equal(found["w"], [[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(osik.stack({"a": x} for x in (1.0, 2.0))["a"], [1.0, 2.0])


class TestWhatDoesNotStack:
    def test_priorities(self, arm, tasks):
        other = {**tasks, "elbow": osik.FrameTask(arm, "link4", rows="position", gain=3.0, priority=1)}
        with pytest.raises(ValueError, match="item 1 .*elbow.priority is 2 in one and 1 in the other; a priority is"):
            osik.stack([tasks, other])

    def test_other_structure(self, arm, tasks):
        def with_hand(**options):
            return {**tasks, "hand": osik.FrameTask(arm, "hand", **options)}

        adaptive = osik.AdaptiveGain(6.0, 2.0, 3.0)
        cases = {
            "hand.frame is 'hand' in one and 'link7'": {**tasks, "hand": osik.FrameTask(arm, "link7", gain=adaptive)},
            "hand.gain is a AdaptiveGain in one and a ArrayImpl": with_hand(gain=3.0),
            "hand.lower is a NoneType in one": with_hand(lower=0.0, gain=adaptive),
            "other names in one than in the other \\('more'\\)": {**tasks, "more": tasks["hand"]},
            "hand is a FrameTask in one and a PostureTask": {**tasks, "hand": tasks["posture"]},
        }
        for message, other in cases.items():
            refuses(ValueError, message, osik.stack, [tasks, other])

    def test_other_robots_and_numbers(self, arm, limits):
        with pytest.raises(ValueError, match="body names and .*only lengths, masses and limits may"):
            osik.stack([arm, osik.load_robot("nao")])
        refuses(ValueError, "it has 2 parts in one and 1 in the other", osik.stack, [limits, limits[:1]])
        refuses(ValueError, "shape", osik.stack, [jnp.zeros(3), jnp.zeros(2)])
        refuses(ValueError, "nothing", osik.stack, [])


LONGER = {
    "arm7": ({"link3": 1.4, "link[57]": 0.8}, {"link2": 3.0, "link6": 0.5}),
    "nao": ({"*Thigh": 1.3, "*Tibia": 1.2, "torso": 0.9}, {"Head": 4.0, "[lr]_wrist": 2.0}),
}


def edited_model(robot, longer, heavier):
    """The MuJoCo model with the same links scaled, bodies that are fused into a link with it."""
    model = copy.copy(robot.mj_model)
    names = [model.body(int(weld)).name for weld in model.body_weldid]
    length, mass = (
        np.array([next((factor for key, factor in factors.items() if fnmatchcase(name, key)), 1.0) for name in names])
        for factors in (longer, heavier)
    )
    model.body_pos *= length[model.body_parentid][:, None]
    model.body_ipos *= length[:, None]
    model.jnt_pos *= length[model.jnt_bodyid][:, None]
    model.site_pos *= length[model.site_bodyid][:, None]
    model.geom_pos *= length[model.geom_bodyid][:, None]
    model.body_mass *= mass
    model.body_inertia *= (mass * length**2)[:, None]
    return model


class TestScaledLinks:
    @pytest.mark.parametrize("name", LONGER)
    def test_equal_an_edited_mujoco_model(self, name, rng):
        robot = osik.load_robot(name)
        length, mass = LONGER[name]
        scaled = robot.scaled(length=length, mass=mass)
        model = edited_model(robot, length, mass)
        q = moved_by(robot, robot.q0, jnp.asarray(0.4 * rng.normal(size=robot.nv)))
        data = mujoco.MjData(model)
        data.qpos[:] = np.asarray(robot.mujoco_qpos(q))
        mujoco.mj_forward(model, data)
        sites = [name for name in robot.frame_names if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) >= 0]

        @jax.jit
        def of(robot, q):
            kin = osik.forward_kinematics(robot, q)
            places = kin.frame_poses(robot, (*robot.body_names, *sites))[0]
            return places, osik.center_of_mass(robot, kin), osik.mass_matrix(robot, kin)

        places, center, inertia = map(np.asarray, of(scaled, q))
        expected = [data.body(name).xpos for name in robot.body_names] + [data.site(name).xpos for name in sites]
        np.testing.assert_allclose(places, expected, atol=1e-9)
        moving = np.where(model.body_weldid != 0, model.body_mass, 0.0)
        np.testing.assert_allclose(center, moving @ data.xipos / moving.sum(), atol=1e-9)
        v = rng.normal(size=robot.nv)
        data.qvel[:] = full_velocities(robot) @ v
        mujoco.mj_energyVel(model, data)
        np.testing.assert_allclose(v @ inertia @ v / 2.0, data.energy[1], rtol=1e-12)
        before = robot_com(robot, next(mujoco_poses(robot, q)))
        assert np.abs(center - before).max() > 1e-3

    def test_one_factor_for_all_is_a_larger_robot(self, arm):
        scaled = arm.scaled(length=2.0, mass=8.0)
        kinematics = jax.jit(osik.forward_kinematics)
        (small, origin), (large, same) = (
            [kinematics(robot, arm.q0).frame_pose(robot, frame)[0] for frame in ("hand", "link1")]
            for robot in (arm, scaled)
        )
        np.testing.assert_allclose(large - same, 2.0 * (small - origin), atol=1e-12)
        np.testing.assert_allclose(scaled.body_mass, 8.0 * arm.body_mass)

    def test_is_differentiable(self, arm):
        @jax.jit
        def height(factor):
            scaled = arm.scaled(length={"link3": factor})
            return osik.forward_kinematics(scaled, arm.q0).frame_pose(scaled, "hand")[0][2]

        numeric = (height(1.0 + 1e-6) - height(1.0 - 1e-6)) / 2e-6
        np.testing.assert_allclose(jax.grad(height)(1.0), numeric, atol=1e-8)

    def test_mistakes_are_named(self, arm):
        refuses(KeyError, "no body 'lnk3'; did you mean 'link3'\\? bodies: link1", arm.scaled, length={"lnk3": 1.1})
        with pytest.raises(ValueError, match="mass gives 'link3' twice, by 'link3' and by 'link\\*'"):
            arm.scaled(mass={"link3": 1.1, "link*": 2.0})
