"""The box on the velocity: its formula, exactness in both precisions, gradients."""

from pathlib import Path
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import mink
import numpy as np
import pink
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float
from model_files import mjcf
from refusals import refuses

import osik_jax as osik

SPEEDS = {"elbow": 2.0, "rail": 0.5}
SCALAR_Q, SCALAR_V = np.arange(11, 14), np.arange(9, 12)
number = st.floats(-1.0, 1.0, allow_nan=False, width=32)
triple = st.tuples(number, number, number).map(np.array)
step = st.sampled_from([1e-4, 1e-3, 1 / 300, 0.005, 0.02, 0.1, 1.0])


@pytest.fixture(scope="module")
def robot():
    return osik.Robot.from_mjcf(mjcf("every_joint"), velocity_limits=SPEEDS)


@pytest.fixture(scope="module", params=[jnp.float64, jnp.float32], ids=["float64", "float32"])
def typed(request, robot):
    """The robot in one precision."""
    return jax.tree.map(lambda x: x.astype(request.param), robot)


@jax.jit
def _box(robot, q, limits, dt):
    return osik.limits.limit_box(robot, q, limits, dt)


@jax.jit
def _move(robot, q, v, dt):
    return osik.integrate(robot, q, v, dt)


def _at(robot, values):
    return robot.q0.at[SCALAR_Q].set(jnp.asarray(values, robot.q0.dtype))


def _inside(robot, fraction):
    """Joint values in their range (in [-1, 1] where there is none), ends included. fraction: in [-1, 1], (3,)."""
    low, high = (np.asarray(x)[SCALAR_V] for x in (robot.position_lower, robot.position_upper))
    low, high = np.where(np.isinf(low), -1, low), np.where(np.isinf(high), 1, high)
    middle, half = (low + high) / 2, (high - low) / 2
    return np.clip((middle + fraction * half).astype(low.dtype), low, high)


def _limits(robot, **options):
    return (osik.ConfigurationLimit(robot, **options), osik.VelocityLimit(robot))


class TestFormula:
    @settings(max_examples=100, deadline=None, derandomize=True)
    @given(offset=triple, dt=step, lower=triple, width=triple)
    def test_against_the_formula(self, robot, offset, dt, lower, width):
        low, high = 3 * lower, 3 * lower + np.abs(width)
        names = ("elbow", "rail", "wheel")
        ranges = dict(lower=dict(zip(names, low, strict=True)), upper=dict(zip(names, high, strict=True)))
        limits = _limits(robot, **ranges, return_speed={"*": np.inf})
        ours = _box(robot, _at(robot, 4 * offset), limits, dt)
        speed = np.array([2.0, 0.5, np.inf])
        for result, bound, free in zip(ours, (low, high), (-np.inf, np.inf), strict=True):
            expected = np.clip((bound - 4 * offset) / dt, -speed, speed)
            np.testing.assert_allclose(np.asarray(result)[SCALAR_V], expected, rtol=1e-14, atol=1e-14)
            np.testing.assert_array_equal(np.asarray(result)[:9], np.full(9, free))
        assert (ours[0] <= ours[1]).all()

    def test_by_hand(self, robot):
        """The elbow at its end, the rail 0.2 outside, the wheel free."""
        q = _at(robot, [np.pi / 2, 0.5, 7.0])
        lower, upper = _box(robot, q, _limits(robot), 0.1)
        np.testing.assert_allclose(np.asarray(lower)[9:], [-2.0, -0.5, -np.inf], atol=1e-15)
        np.testing.assert_allclose(np.asarray(upper)[9:], [0.0, -0.5, np.inf], atol=1e-14)
        lower, upper = _box(robot, q, _limits(robot)[:1], 0.1)
        np.testing.assert_allclose(np.asarray(lower)[9:], [-25 * np.pi / 3, -6.0, -np.inf], rtol=1e-14)
        np.testing.assert_allclose(np.asarray(upper)[9:], [0.0, -0.5, np.inf], atol=1e-14)
        at_once = osik.ConfigurationLimit(robot, return_speed={"*": np.inf})
        np.testing.assert_allclose(np.asarray(_box(robot, q, (at_once,), 0.1)[1])[9:], [0.0, -2.0, np.inf], atol=1e-14)

    def test_the_order_given_does_not_matter(self, robot):
        q, limits = _at(robot, [2.0, 0.5, 0.0]), _limits(robot)
        for one, other in zip(_box(robot, q, limits, 0.1), _box(robot, q, limits[::-1], 0.1), strict=True):
            np.testing.assert_array_equal(one, other)


class TestExactness:
    """No tolerance anywhere: rounding included, in both precisions."""

    @settings(max_examples=150, deadline=None, derandomize=True)
    @given(fraction=triple, dt=step, pick=triple)
    def test_a_step_from_inside_ends_inside(self, typed, fraction, dt, pick):
        q = _at(typed, _inside(typed, fraction))
        low, high = map(np.asarray, _box(typed, q, _limits(typed), dt))
        assert ((low <= 0.0) & (high >= 0.0)).all()
        share = ((pick + 1) / 2).astype(low.dtype)
        finite = np.clip(low, -10, 10)[9:], np.clip(high, -10, 10)[9:]
        within = np.clip(finite[0] + share * (finite[1] - finite[0]), *finite)
        for v in (low, high, np.concatenate([np.zeros(9), within])):
            v = jnp.asarray(np.where(np.isinf(v), 0.0, v), typed.q0.dtype)
            after = _move(typed, q, v, dt)[SCALAR_Q]
            assert (after >= typed.position_lower[SCALAR_V]).all()
            assert (after <= typed.position_upper[SCALAR_V]).all()

    @settings(max_examples=150, deadline=None, derandomize=True)
    @given(offset=triple, dt=step, pick=triple)
    def test_a_joint_outside_comes_back_at_full_speed(self, typed, offset, dt, pick):
        values = (_inside(typed, 0.0) + 3 * offset).astype(typed.q0.dtype)
        q = _at(typed, values)
        low, high = map(np.asarray, _box(typed, q, _limits(typed), dt))
        assert (low <= high).all()
        below = np.asarray(typed.position_lower)[SCALAR_V] - values
        above = values - np.asarray(typed.position_upper)[SCALAR_V]
        speed = np.asarray(typed.velocity_limit)[SCALAR_V]
        v = np.where(np.isinf(low), 0.0, np.where(pick.mean() > 0, low, np.where(np.isinf(high), 0.0, high)))
        after = np.asarray(_move(typed, q, jnp.asarray(v, q.dtype), dt))[SCALAR_Q]
        tiny = 4 * np.finfo(values.dtype).eps * (1 + np.abs(values))
        for outside, rest, direction in (
            (below, np.asarray(typed.position_lower)[SCALAR_V] - after, 1),
            (above, after - np.asarray(typed.position_upper)[SCALAR_V], -1),
        ):
            for i in np.flatnonzero(outside > 0):
                toward = direction * v[9 + i]
                assert toward > 0.0
                assert rest[i] <= max(outside[i] - speed[i] * dt, 0.0) + tiny[i]
                if outside[i] <= 0.5 * speed[i] * dt:
                    assert rest[i] <= 0.0

    def test_lower_never_exceeds_upper(self, typed, rng):
        """Ranges of width 0 and other precisions of the bound included."""
        for _ in range(200):
            middle = rng.normal(size=3)
            values = {name: float(np.float32(m)) for name, m in zip(("elbow", "rail", "wheel"), middle, strict=True)}
            limits = _limits(typed, lower=values, upper=values)
            low, high = _box(
                typed, _at(typed, middle + rng.choice([0.0, 1e-8, 1.0]) * rng.normal(size=3)), limits, 0.01
            )
            assert (low <= high).all()


class Cautious(osik.Limit):
    """A user's own limit: a share of the way that is left."""

    kind: ClassVar[Literal["velocity", "position"]] = "velocity"
    bound: Float[Array, ""]

    def box(self, robot, q, dt):
        return jnp.full(robot.nv, -self.bound), jnp.full(robot.nv, self.bound) / (1 + dt)


class TestGain:
    """The share of the way to a limit that a step may take."""

    @pytest.mark.parametrize("gain", [0.5, 0.95, 1.0])
    def test_are_minks_and_pinks_bounds(self, gain, rng, arm):
        """On a NAO, and beyond the ends of the ranges too, where theirs lead back in one step."""
        at_once = {"return_speed": {"*": np.inf}}
        robot, dt = osik.load_robot("nao"), 0.004
        model = robot.mj_model
        q = np.asarray(robot.q0) + np.r_[np.zeros(7), rng.uniform(-0.5, 0.5, robot.nq - 7)]
        lower, upper = osik.limit_box(robot, q, (osik.ConfigurationLimit(robot, gain=gain, **at_once),), dt)
        full = mink.Configuration(model, q=np.asarray(robot.mujoco_qpos(jnp.asarray(q))))
        theirs = mink.ConfigurationLimit(model, gain=gain)
        bound = np.asarray(theirs.compute_qp_inequalities(full, dt).h) / dt
        assert model.nv == robot.nv + 1  # one joint of the model follows another
        leaders = {model.joint(name).dofadr[0]: robot.joint_dof_index(name) for name in robot.joint_names}
        rows = [(row, leaders[dof]) for row, dof in enumerate(theirs.indices) if dof in leaders]
        most, least = np.split(bound, 2)
        for row, dof in rows:
            np.testing.assert_allclose((upper[dof], lower[dof]), (most[row], -least[row]), rtol=1e-9, atol=1e-9)
        assert len(rows) == len(robot.joint_names)

        own = np.asarray(arm.q0) + rng.uniform(-3.0, 3.0, 7)
        pinocchio = pin.buildModelFromMJCF(str(Path(osik.__file__).parent / "robot" / "models" / "arm7.xml"))
        limit = pink.limits.ConfigurationLimit(pinocchio, config_limit_gain=gain)
        configuration = pink.Configuration(pinocchio, pinocchio.createData(), own)
        bound = limit.compute_qp_inequalities(configuration, dt)[1] / dt
        lower, upper = osik.limit_box(arm, own, (osik.ConfigurationLimit(arm, gain=gain, **at_once),), dt)
        np.testing.assert_allclose(np.concatenate([upper, -lower]), bound, rtol=1e-9, atol=1e-9)

    def test_by_joint(self, robot):
        limit = osik.ConfigurationLimit(robot, gain={"elbow": 0.25})
        whole = _box(robot, robot.q0, (osik.ConfigurationLimit(robot),), 0.01)
        share = _box(robot, robot.q0, (limit,), 0.01)
        for a, b in zip(whole, share, strict=True):
            np.testing.assert_allclose(np.asarray(b)[SCALAR_V], np.asarray(a)[SCALAR_V] * [0.25, 1.0, 1.0])
            np.testing.assert_array_equal(np.isinf(a), np.isinf(b))
        array = osik.ConfigurationLimit(robot, gain=limit.gain)
        np.testing.assert_array_equal(array.gain, limit.gain)

    @pytest.mark.variants(release=["0.5"])
    @pytest.mark.parametrize("gain", [0.5, 1.0])
    def test_a_joint_outside_comes_back(self, robot, gain):
        """Each step leaves at most the share that the gain says, whatever the tasks want; the speed limit holds."""
        dt, steps = 0.05, 40
        outward = {"posture": osik.PostureTask(robot, target=_at(robot, [4.0, 2.0, 0.0]), gain=20.0, weight=1.0)}
        limits = osik.ConfigurationLimit(robot, gain=gain), osik.VelocityLimit(robot)
        start = _at(robot, [2.0, 0.5, 0.0])
        path = osik.rollout(robot, start, outward, scheme=osik.WeightedQP(), limits=limits, dt=dt, steps=steps)
        upper = np.asarray(robot.position_upper)[SCALAR_V][:2]
        outside = np.asarray(path.q)[:, SCALAR_Q[:2]] - upper
        assert (path.solution.status == osik.Status.SOLVED).all()
        assert (outside[0] > 0.0).all()
        assert (outside[-1] < 1e-6).all()
        allowed = np.maximum((1.0 - gain) * outside[:-1], outside[:-1] - dt * np.array([2.0, 0.5]))
        assert (outside[1:] <= allowed + 1e-12).all()

    @pytest.mark.parametrize("gain", [0.0, 1.1, -0.5, np.nan, {"elbow": 2.0}])
    def test_mistakes_are_told(self, robot, gain):
        refuses(ValueError, "above 0 and up to 1", osik.ConfigurationLimit, robot, gain=gain)


class TestOwnLimits:
    def test_joins_the_others(self, robot):
        q = _at(robot, [0.0, 0.5, 0.0])
        lower, upper = _box(robot, q, (*_limits(robot), Cautious(jnp.asarray(0.25))), 0.25)
        np.testing.assert_allclose(np.asarray(lower)[9:], [-0.25, -0.25, -0.25], atol=1e-15)
        np.testing.assert_allclose(np.asarray(upper)[9:], [0.2, -0.25, 0.2], atol=1e-15)
        np.testing.assert_allclose(np.asarray(upper)[:9], 0.2, atol=1e-15)


class TestDerivatives:
    def test_finite_everywhere(self, robot):
        def total(limits, q, dt):
            return [
                jnp.sum(jnp.where(jnp.isfinite(bound), bound, 0.0)) for bound in osik.limit_box(robot, q, limits, dt)
            ]

        derivative = jax.jit(jax.jacrev(total, argnums=(0, 1, 2)))
        for values in ([0.0, 0.0, 0.0], [np.pi / 2, 0.3, 0.0], [2.0, 0.5, 9.0], [-np.pi / 3, -0.1, 0.0]):
            for leaf in jax.tree.leaves(derivative(_limits(robot), _at(robot, values), 0.01)):
                assert np.isfinite(leaf).all()

    def test_by_hand(self, robot):
        """Near its end a joint's bound is (end - q) / dt; elsewhere it is the speed."""
        limits, dt = _limits(robot), 0.1
        q = _at(robot, [np.pi / 2 - 0.05, 0.1, 0.0])

        def bounds(limits, q, dt):
            return osik.limit_box(robot, q, limits, dt)[1][9:11]

        by_limits, by_q, by_dt = jax.jit(jax.jacrev(bounds, argnums=(0, 1, 2)))(limits, q, dt)
        np.testing.assert_allclose(by_q[:, SCALAR_Q[:2]], [[-10.0, 0.0], [0.0, 0.0]], atol=1e-12)
        np.testing.assert_allclose(by_limits[0].upper[:, 9:11], [[10.0, 0.0], [0.0, 0.0]], atol=1e-12)
        np.testing.assert_allclose(by_limits[0].gain, [0.5, 0.0], atol=1e-12)
        np.testing.assert_allclose(by_limits[1].velocity[:, 9:11], [[0.0, 0.0], [0.0, 1.0]], atol=1e-12)
        np.testing.assert_allclose(by_dt, [-0.05 / 0.1**2, 0.0], atol=1e-12)

    def test_vmap_equals_a_loop_and_nothing_is_traced_again(self, robot, rng):
        traces = []

        @jax.jit
        def box(limits, q, dt):
            traces.append(1)
            return osik.limit_box(robot, q, limits, dt)

        speeds = jnp.asarray(rng.uniform(0.1, 2.0, (5, robot.nv)))
        q = jnp.stack([_at(robot, values) for values in rng.normal(size=(5, 3))])
        dts = jnp.linspace(0.01, 0.1, 5)
        make = jax.vmap(lambda speed: (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot, velocity=speed)))
        batch = jax.vmap(box)(make(speeds), q, dts)
        for i in range(5):
            limits = (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot, velocity=np.asarray(speeds[i])))
            for ours, theirs in zip(batch, box(limits, q[i], dts[i]), strict=True):
                np.testing.assert_allclose(ours[i], theirs, rtol=1e-14, atol=0)
        assert len(traces) == 1


class TestConstruction:
    def test_mappings_and_globs(self, robot):
        velocity = osik.VelocityLimit(robot, velocity={"*": 3.0, "rail": 0.25}).velocity
        np.testing.assert_array_equal(velocity, [np.inf] * 6 + [3.0, 3.0, 3.0, 3.0, 0.25, 3.0])
        velocity = osik.VelocityLimit(robot, velocity={"root": 0.5}).velocity
        np.testing.assert_array_equal(velocity, [0.5] * 6 + [np.inf] * 3 + [2.0, 0.5, np.inf])
        limit = osik.ConfigurationLimit(robot, lower={"wheel": -1.0}, upper={"el*": 1.0})
        np.testing.assert_allclose(limit.lower[9:], [-np.pi / 3, -0.1, -1.0], atol=1e-15)
        np.testing.assert_allclose(limit.upper[9:], [1.0, 0.3, np.inf], atol=1e-15)

    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            (dict(lower={"elbow": np.nan}), ValueError, "elbow"),
            (dict(lower=np.zeros(3)), ValueError, r"lower has shape \(3,\), expected \(12,\).*elbow, rail, wheel"),
            (dict(upper={"ball": -1.0}), ValueError, "lower > upper|upper of the ball joint 'ball' is"),
            (dict(upper={"root": 1.0}), ValueError, "a free joint has no range.*root"),
        ],
    )
    def test_configuration(self, robot, options, error, message):
        refuses(error, message, osik.ConfigurationLimit, robot, **options)

    def test_velocity(self, robot):
        refuses(ValueError, "elbow", osik.VelocityLimit, robot, velocity={"elbow": np.nan})
        refuses(ValueError, "velocity has shape", osik.VelocityLimit, robot, velocity=1.0)
