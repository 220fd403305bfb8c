"""Derivatives where bounds coincide and where squares of small numbers underflow, and names that are given once."""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from task_checks import square

import osik_jax as osik
from osik_jax.numerics._guarded import clipped, greatest, positive_root, quotient, safe_norm

SIZES = [1e-30, 1e-20, 1e-12, 1.0, 1e12]


@pytest.mark.parametrize("size", SIZES)
def test_derivatives_of_a_quotient_in_single_precision(size):
    a, b = np.float32(3.0 * size), np.float32(2.0 * size)
    # compiled: XLA turns (a / s) / (b / s) into (a s) / (s b)
    value, (by_a, by_b) = jax.jit(jax.value_and_grad(quotient, argnums=(0, 1)))(a, b)
    assert value.dtype == np.float32
    np.testing.assert_allclose([value, by_a * size, by_b * size], [1.5, 0.5, -0.75], rtol=1e-6)


def test_a_quotient_has_the_value_and_the_second_derivative_of_a_division(rng):
    a, b = rng.normal(size=(2, 20))
    np.testing.assert_array_equal(quotient(a, b), a / b)
    second = jax.vmap(jax.grad(jax.grad(quotient, 1), 1))(a, b)
    np.testing.assert_allclose(second, 2.0 * a / b**3, rtol=1e-12)


@pytest.mark.parametrize("size", SIZES)
def test_a_norm_in_single_precision(size):
    vector = np.array([3.0 * size, 0.0, -4.0 * size], np.float32)
    value, gradient = jax.jit(jax.value_and_grad(safe_norm))(vector)
    np.testing.assert_allclose(value, 5.0 * size, rtol=1e-6)
    np.testing.assert_allclose(gradient, [0.6, 0.0, -0.8], atol=1e-6)
    np.testing.assert_array_equal(jax.grad(safe_norm)(0.0 * vector), 0.0)


def test_a_root_is_continuous_where_its_argument_is_rounded_in_two_ways():
    a = jnp.array([4.0, 0.0, -1.0, jnp.nan])
    np.testing.assert_array_equal(positive_root(a), [2.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(jax.vmap(jax.grad(positive_root))(a), [0.25, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(jax.vmap(jax.grad(jax.grad(positive_root)))(a), [-1.0 / 32.0, 0.0, 0.0, 0.0])


def test_a_clip_between_equal_bounds_has_their_derivative():
    def at(t, pinned):
        return clipped(1.0 + 3.0 * t, 1.0 + pinned * t, 1.0 + pinned * t)

    for pinned in (0.0, 2.0):
        np.testing.assert_allclose(jax.grad(at)(0.0, pinned), pinned)
    x = jnp.array([-2.0, -1.0, 0.5, 1.0, 2.0])
    np.testing.assert_array_equal(clipped(x, -jnp.ones(5), jnp.ones(5)), np.clip(x, -1.0, 1.0))
    slopes = jax.vmap(jax.grad(lambda x: clipped(x, -jnp.ones(()), jnp.ones(()))))(x)
    np.testing.assert_array_equal(slopes, [0.0, 0.5, 1.0, 0.5, 0.0])


def test_the_derivative_of_the_largest_entry_is_that_of_one_entry():
    """Of a tie it is that of one of the tied entries, whether compiled or not, and never their sum or NaN."""
    slopes = jnp.array([[1.0, -2.0, 4.0, 0.5], [3.0, 7.0, 3.0, -1.0]])
    places = jnp.array([[0.1, 0.3, 0.3, 0.3], [2.0, 0.0, 2.0, 2.0]])

    def at(t):
        return greatest(places + t * slopes)

    np.testing.assert_array_equal(at(0.0), [0.3, 2.0])
    one_sided = np.array([at(h) - at(0.0) for h in (1e-6, -1e-6)]) / np.array([[1e-6], [-1e-6]])
    for found in (jax.jacfwd(at)(0.0), jax.jit(jax.jacrev(at))(0.0)):
        assert found[0] in (-2.0, 4.0, 0.5) and found[1] in (3.0, -1.0)
        assert (np.min(one_sided, 0) - 1e-6 <= found).all() and (found <= np.max(one_sided, 0) + 1e-6).all()


def test_the_distance_to_a_polygon_on_the_bisector_of_a_corner_has_the_derivative_of_an_edge():
    places = jnp.array([[0.3, 0.3], [0.2, 0.7], [0.0, 0.0]])
    np.testing.assert_allclose(square(1.0).distance(places), [0.7, 0.3, 1.0])
    found = jax.jit(jax.vmap(jax.grad(square(1.0).distance)))(places)
    assert found[0].tolist() in ([-1.0, 0.0], [0.0, -1.0]) and found[1].tolist() == [0.0, -1.0]
    assert np.abs(found[2]).sum() == 1.0


ARM = osik.load_robot("arm7")
NOMINAL = osik.VelocityLimit(ARM, velocity={"*": 2.0})
PINNED = osik.VelocityLimit(ARM, velocity={"*": 2.0, "joint1": 0.0, "joint4": 0.0})
ONE_POSE = np.array([0.3, *ARM.position_upper[1:]])
LIMITS = {
    "range": (osik.ConfigurationLimit(ARM),),
    "speed": (osik.ConfigurationLimit(ARM), NOMINAL),
    "pinned": (osik.ConfigurationLimit(ARM), PINNED),
    "gain": (osik.ConfigurationLimit(ARM, gain=0.3), PINNED),
    "return speed": (osik.ConfigurationLimit(ARM, return_speed={"*": 0.5, "joint1": 1e-9}), NOMINAL),
    "one pose": (osik.ConfigurationLimit(ARM, lower={"joint1": 0.3}, upper={"joint1": 0.3}), NOMINAL),
    "acceleration": (
        osik.AccelerationLimit(ARM, {"*": 5.0}, velocity={"*": 0.1}),
        osik.ConfigurationLimit(ARM),
        NOMINAL,
    ),
    "acceleration, pinned": (osik.AccelerationLimit(ARM, {"*": 5.0}), osik.ConfigurationLimit(ARM), PINNED),
}


@pytest.mark.parametrize("name", LIMITS)
def test_the_box_has_the_slopes_of_differences(name, rng):
    """At the ends of ranges, beyond them and inside: the derivative is between the slopes of both sides."""
    step = 1e-7
    box = jax.jit(jax.vmap(lambda q: jnp.stack(osik.limit_box(ARM, q, LIMITS[name], 0.005))))
    low, high = (np.asarray(a, float) for a in (ARM.position_lower, ARM.position_upper))
    inside = rng.uniform(low, high, (20, ARM.nq))
    near = high - rng.exponential(0.01, (20, ARM.nq))
    q = np.concatenate([[low, high, high + 0.1, low - 0.1, ONE_POSE, ARM.q0], inside, near])
    # each bound depends on its own joint alone, so one direction has all slopes
    _, slopes = jax.jvp(box, (q,), (np.ones_like(q),))
    here, after, before = (np.asarray(box(q + shift)) for shift in (0.0, step, -step))
    sides = np.stack([(after - here) / step, (here - before) / step])
    finite = np.isfinite(here)
    assert np.isfinite(slopes).all() and finite.any()
    slack = 1e-5 * (1.0 + np.abs(slopes))
    assert (slopes >= sides.min(0) - slack)[finite].all() and (slopes <= sides.max(0) + slack)[finite].all()


ROD = """<mujoco><worldbody><body><joint name="ball" type="ball" range="0 60"/><geom size=".05" pos=".2 0 0"/>
  <body pos=".4 0 0"><joint name="slide" type="slide" axis="1 0 0" range="-1 1"/><geom size=".05"/></body></body>
  </worldbody></mujoco>"""
TIMES = np.array([1e-3, 1e-8, 1e-14, 1e-20, 1e-26, 1e-36])


def _rates_of_limits_by_dt(precision, angle):
    """Return the rates by dt of the bounds of a ball and a slide, boxes and rows, in both modes."""
    with jax.enable_x64(precision == "float64"):
        robot = osik.Robot.from_mjcf(ROD)
        q = jnp.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0, 0.7])
        ranges, braking = osik.ConfigurationLimit(robot), osik.AccelerationLimit(robot, {"*": 5.0})
        kinematics = osik.forward_kinematics(robot, q)

        def bounds(dt):
            rows = ranges.rows(robot, kinematics, q, dt)
            assert rows is not None
            boxes = [jnp.stack(osik.limit_box(robot, q, (limit,), dt)) for limit in (ranges, braking)]
            return jnp.concatenate([*(jnp.ravel(box) for box in boxes), rows.upper])

        def rates(dt):
            value, rate = jax.jvp(bounds, (dt,), (jnp.ones_like(dt),))
            finite = jnp.isfinite(value)
            total = jax.grad(lambda dt: jnp.sum(jnp.where(finite, bounds(dt), 0.0)))(dt)
            return jnp.where(finite, rate, 0.0), total

        return [np.asarray(a, float) for a in jax.jit(jax.vmap(rates))(jnp.asarray(TIMES, precision))]


@pytest.mark.slow
@pytest.mark.variants(release=["0.1"])
@pytest.mark.parametrize("angle", [0.1, 1.04, 1.2])
def test_rates_of_limits_by_tiny_times_in_single_precision(angle):
    """Of a ball far from the end of its range, near to it and beyond it: 1 / dt^2 overflows from 1e-19 down."""
    (single, total), (double, _) = (_rates_of_limits_by_dt(p, angle) for p in ("float32", "float64"))
    assert np.abs(double[0]).max() > 1e3
    np.testing.assert_allclose(single, double, rtol=2e-4, atol=1e-3)
    np.testing.assert_allclose(total, double.sum(1), rtol=2e-3, atol=1e-2)


def _rates_of_saturated(precision, distances, directions, shifts):
    """Return the rate of the velocity as hand and posture move from their targets, by the scale of both."""
    with jax.enable_x64(precision == "float64"):
        arm = osik.load_robot("arm7")
        hand, posture = osik.FrameTask(arm, "hand", priority=1), osik.PostureTask(arm, weight=1.0, priority=2)
        scheme = osik.NullSpace(method="saturated")
        p, R = hand.target

        def rate(distance, direction, shift):
            def velocity(s):
                own = {
                    "hand": hand.replace(target=(p + (distance + s) * direction, R)),
                    "posture": posture.replace(target=arm.q0 + s * shift),
                }
                return osik.solve(arm, arm.q0, own, scheme=scheme).velocity

            return jax.jvp(velocity, (jnp.zeros_like(distance),), (jnp.ones_like(distance),))[1]

        given = (jnp.asarray(a, precision) for a in (distances, directions, shifts))
        return jax.jit(jax.vmap(rate))(*given)


@pytest.mark.release
def test_derivatives_of_the_saturated_null_space_near_a_target_in_single_precision(rng):
    """Steps of roundoff: a division of XLA that underflows, and whether all of a step is worth its cost."""
    distances = np.concatenate([[1e-2, 1e-3, 1e-4, 1e-6], 10.0 ** rng.uniform(-6, -2, 12)])
    given = distances, rng.normal(size=(16, 3)), 0.1 * rng.normal(size=(16, ARM.nv))
    single, double = (np.asarray(_rates_of_saturated(p, *given)) for p in ("float32", "float64"))
    np.testing.assert_allclose(single, double, atol=2e-5 * np.abs(double).max())


SMALL = np.array([1e-4, 1e-10, 1e-16, 1e-20, 1e-25, 1e-30])
SCHEMES = {
    "weighted": osik.WeightedQP,
    "hierarchy": osik.HierarchicalQP,
    "classical": osik.NullSpace,
    "saturated": lambda: osik.NullSpace(method="saturated"),
}
LEAST_WEIGHT = {"weighted": 0.0, "hierarchy": 1e-26, "classical": 1e-11, "saturated": 1e-26}
"""Weights below this are among the limitations: derivatives by them may be wrong there."""


def _rates_by_weight_and_dt(precision, name):
    """Return the rates of the velocity by a task's weight and by dt, in forward and in reverse mode; by sizes."""
    with jax.enable_x64(precision == "float64"):
        arm = osik.load_robot("arm7")
        hand, posture = osik.FrameTask(arm, "hand", priority=1), osik.PostureTask(arm, priority=2)
        p, R = hand.target
        tasks = {"hand": hand.replace(target=(p + np.array([0.05, -0.03, 0.02]), R)), "posture": posture}
        scheme = SCHEMES[name]()

        def velocity(weight, dt):
            own = tasks | {"hand": tasks["hand"].replace(weight=weight)}
            return osik.solve(arm, arm.q0, own, scheme=scheme, dt=dt).velocity

        def rates(weight, dt, by):
            def moved(s):
                return velocity(weight + s * by, dt + s * (1.0 - by))

            value, rate = jax.linearize(moved, jnp.zeros_like(dt))
            return rate(jnp.ones_like(dt)), jax.linear_transpose(rate, dt)(jnp.ones_like(value))[0]

        ones = np.ones_like(SMALL)
        lanes = np.r_[SMALL, ones], np.r_[0.01 * ones, SMALL], np.r_[ones, 0.0 * ones]
        # what rounding of the velocity by one part in 1 makes of the rate
        size = np.abs(jax.vmap(velocity)(*(jnp.asarray(a, precision) for a in lanes[:2]))).max(1) / np.r_[SMALL, SMALL]
        found = jax.jit(jax.vmap(rates))(*(jnp.asarray(a, precision) for a in lanes))
        return [np.asarray(a, float) for a in (*found, size)]


@pytest.mark.release
@pytest.mark.parametrize("name", SCHEMES)
def test_derivatives_by_tiny_weights_and_times_in_single_precision(name):
    (single, reverse, _), (double, _, size) = (_rates_by_weight_and_dt(p, name) for p in ("float32", "float64"))
    tolerance = 1e-5 * np.maximum(np.abs(double).max(1), size)
    kept = np.r_[LEAST_WEIGHT[name] < SMALL, SMALL > 0.0]
    assert (np.abs(single - double).max(1) <= tolerance)[kept].all()
    assert (np.abs(reverse - double.sum(1)) < 10.0 * tolerance)[kept].all()


def test_no_module_gives_a_name_to_two_values():
    """The second value of a constant stands silently against the text and the tables of the first."""
    twice = []
    for path in sorted(Path(osik.__file__).parent.rglob("*.py")):
        statements = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.Assign | ast.AnnAssign)]
        targets = [a for node in statements for a in (node.targets if isinstance(node, ast.Assign) else [node.target])]
        inside = [a for target in targets for a in ast.walk(target) if isinstance(a, ast.Name)]
        names = [a.id for a in inside if isinstance(a.ctx, ast.Store)]
        twice += [f"{path.name}: {name}" for name in sorted(set(names)) if names.count(name) > 1]
    assert not twice
