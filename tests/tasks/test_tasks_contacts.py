"""Contacts and wheels: rows against central differences and MuJoCo C, closed loops against what geometry says."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model_files import mjcf
from mujoco_states import mujoco_at
from refusals import refuses
from task_checks import (
    alone,
    assert_every_number_counts,
    assert_finite_gradients,
    assert_jacobians,
    at_each,
    rows_of_each,
)

import osik_jax as osik

NORMAL = np.array([0.2, -0.3, 0.9])
HEEL = np.array([0.05, -0.02, 0.01])
FREE: Any = dict(scheme=osik.WeightedQP(damping=1e-9), limits=osik.no_limits)


@pytest.fixture(scope="module")
def walker():
    return osik.Robot.from_mjcf(mjcf("walker"))


@pytest.fixture(scope="module")
def contacts(walker):
    made = {
        "point": dict(contact="point"),
        "sliding point": dict(contact="point", sliding=True, offset=0.1),
        "plane": dict(contact="plane", gain=4.0),
        "sliding plane": dict(contact="plane", sliding=True, axis=(0.2, 0.1, 1.0)),
    }
    return {
        name: osik.ContactTask(walker, "toe", point=HEEL, normal=NORMAL, **options) for name, options in made.items()
    }


@pytest.fixture(scope="module")
def configurations(walker):
    steps = np.random.default_rng(4).uniform(-0.4, 0.4, (4, walker.nv))
    return jax.jit(jax.vmap(osik.integrate, in_axes=(None, None, 0)))(walker, walker.q0, jnp.asarray(steps))


@pytest.fixture(scope="module")
def found(walker, contacts, configurations):
    return at_each(walker, contacts, configurations)


def _pose(robot, q, site):
    """Of MuJoCo C."""
    found = mujoco_at(robot, q).site(site)
    return found.xpos, found.xmat.reshape(3, 3)


class TestContacts:
    def test_jacobians_against_central_differences(self, found):
        assert_jacobians(*found)

    def test_errors_by_hand(self, walker, contacts, configurations, found):
        """Distances and sines from MuJoCo's poses, whatever two axes span the plane."""
        rows, _ = found
        n = NORMAL / np.linalg.norm(NORMAL)
        p0, R0 = _pose(walker, walker.q0, "toe")
        axis = np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0])
        for k, q in enumerate(configurations):
            p, R = _pose(walker, q, "toe")
            moved = p + R @ HEEL - p0 - R0 @ HEEL
            height = n @ moved
            across = np.linalg.norm(moved - height * n)
            for name in ("point", "plane"):
                assert rows[name].error[k, 2] == pytest.approx(height, abs=1e-12)
                assert np.linalg.norm(rows[name].error[k, :2]) == pytest.approx(across, abs=1e-12)
            for name, offset, at in (("sliding point", 0.1, 0), ("sliding plane", n @ (p0 + R0 @ HEEL), 0)):
                assert rows[name].error[k, at] == pytest.approx(n @ (p + R @ HEEL) - offset, abs=1e-12)
            for name, standing in (("plane", R0.T @ n), ("sliding plane", axis)):
                tilt = np.linalg.norm(np.cross(n, R @ standing))
                start = 3 if name == "plane" else 1
                assert np.linalg.norm(rows[name].error[k, start : start + 2]) == pytest.approx(tilt, abs=1e-12)
            np.testing.assert_allclose(rows["plane"].lower[k], -4.0 * rows["plane"].error[k], atol=1e-14)
        sizes = {name: row.error.shape[1] for name, row in rows.items()}
        assert sizes == {"point": 3, "sliding point": 1, "plane": 6, "sliding plane": 3}

    def test_a_turn_about_the_normal_is_the_last_row_alone(self, walker):
        """In the plane, by 0.3 rad, with the sole flat: its sine; a sliding sole may turn."""
        tasks = {"held": osik.ContactTask(walker, "trunk"), "free": osik.ContactTask(walker, "trunk", sliding=True)}
        q = walker.q0.at[3:7].set(jnp.array([np.cos(0.15), 0.0, 0.0, np.sin(0.15)]))
        rows = rows_of_each(walker, tasks, q)
        np.testing.assert_allclose(rows["held"].error, [0.0, 0.0, 0.0, 0.0, 0.0, np.sin(0.3)], atol=1e-14)
        np.testing.assert_allclose(rows["free"].error, 0.0, atol=1e-14)

    @pytest.mark.slow
    def test_a_sole_lands_flat_and_stays(self, walker):
        """From a tilt, a turn and a height to the anchor's pose in MuJoCo, while a push moves the rest of the robot."""
        anchor = np.array([0.3, 0.1, 0.2]), np.eye(3)
        tasks = {
            "sole": osik.ContactTask(walker, "toe", anchor=anchor, axis=(0.0, 0.0, 1.0), gain=10.0, hard=True),
            "push": osik.ComTask(walker, target=[0.5, 0.0, 0.9], gain=2.0),
        }
        path = osik.rollout(walker, walker.q0, tasks, dt=0.02, steps=500, **FREE)
        assert (np.asarray(path.solution.status) == osik.Status.SOLVED).all()
        p, R = _pose(walker, path.q[-1], "toe")
        np.testing.assert_allclose(p, anchor[0], atol=1e-6)
        np.testing.assert_allclose(R, anchor[1], atol=1e-6)
        assert np.linalg.norm(path.q[-1] - path.q[60]) > 0.01

    @pytest.mark.slow
    def test_a_point_slides_on_a_ramp(self, walker):
        """A toe pulled along and into a ramp stays on it, and goes where along it the pull is."""
        target = np.array([0.6, 0.5, -0.5]), np.eye(3)
        n = NORMAL / np.linalg.norm(NORMAL)
        tasks = {
            "ramp": osik.ContactTask(walker, "toe", contact="point", sliding=True, normal=NORMAL, hard=True),
            "pull": osik.FrameTask(walker, "toe", rows="position", target=target, gain=5.0),
        }
        p0, _ = _pose(walker, walker.q0, "toe")
        path = osik.rollout(walker, walker.q0, tasks, dt=0.02, steps=200, **FREE)
        p, _ = _pose(walker, path.q[-1], "toe")
        assert n @ p == pytest.approx(n @ p0, abs=1e-6)
        expected = target[0] - (n @ (target[0] - p0)) * n
        np.testing.assert_allclose(p, expected, atol=1e-4)

    @pytest.mark.release
    def test_every_number_counts_and_gradients_are_finite(self, walker, contacts, configurations):
        assert_every_number_counts(walker, contacts, configurations[0])
        assert_finite_gradients(rows_of_each, *alone(walker, {"plane": contacts["plane"]}, walker.q0))

    def test_mistakes(self, walker):
        refuses(ValueError, "contact is 'line'", osik.ContactTask, walker, "toe", contact="line")
        refuses(TypeError, "has no axis", osik.ContactTask, walker, "toe", contact="point", axis=(0, 0, 1))
        with pytest.raises(ValueError, match="normal is .* a direction is finite and not 0"):
            osik.ContactTask(walker, "toe", normal=(0, 0, 0))
        task = osik.ContactTask(walker, "toe", sliding=True)
        np.testing.assert_allclose(task.replace(normal=(0.0, 3.0, 4.0)).normal, [0.0, 0.6, 0.8])
        refuses(TypeError, "no 'anchor' to replace", task.replace, anchor=np.eye(4))


RADIUS, TRACK = 0.1, 0.4
"""Of the wheels of the cart, and the distance between them [m]."""


@pytest.fixture(scope="module")
def cart():
    return osik.Robot.from_mjcf(mjcf("cart"))


class TestWheels:
    def test_rows_against_mujoco(self, walker, configurations):
        """The velocity of the wheel's material at its lowest point, found by search; the height is a real error."""
        options: dict[str, Any] = dict(radius=0.2, axis=(0.3, 1.0, -0.2), normal=NORMAL, offset=0.05, gain=3.0)
        tasks = {
            "wheel": osik.WheelTask(walker, "shin", **options),
            "rollers": osik.WheelTask(walker, "shin", roller_angle=0.7, **options),
        }
        rows, slopes = at_each(walker, tasks, configurations)
        model, n = walker.mj_model, NORMAL / np.linalg.norm(NORMAL)
        axis = np.array([0.3, 1.0, -0.2]) / np.linalg.norm([0.3, 1.0, -0.2])
        angles = np.linspace(0.0, 2.0 * np.pi, 100_001)
        for k, q in enumerate(configurations):
            data = mujoco_at(walker, q)
            body = model.body("shin").id
            axle = data.xmat[body].reshape(3, 3) @ axis
            one = np.cross(axle, [1.0, 0.0, 0.0])
            one /= np.linalg.norm(one)
            rim = data.xpos[body] + 0.2 * (
                np.outer(np.cos(angles), one) + np.outer(np.sin(angles), np.cross(axle, one))
            )
            lowest = rim[np.argmin(rim @ n)]
            linear = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, linear, None, lowest, body)
            ahead = np.cross(axle, n) / np.linalg.norm(np.cross(axle, n))
            aside = np.cross(n, ahead)
            expected = np.array([ahead, aside, n]) @ linear
            np.testing.assert_allclose(rows["wheel"].jacobian[k], expected, atol=2e-5)
            np.testing.assert_allclose(rows["wheel"].error[k], [0.0, 0.0, lowest @ n - 0.05], atol=1e-9)
            np.testing.assert_allclose(rows["wheel"].lower[k], -3.0 * rows["wheel"].error[k], atol=1e-14)
            along = np.cos(0.7) * expected[0] + np.sin(0.7) * expected[1]
            np.testing.assert_allclose(rows["rollers"].jacobian[k], [along, expected[2]], atol=2e-5)
        for name in tasks:
            np.testing.assert_allclose(rows[name].jacobian[:, -1], slopes[name][:, -1], atol=1e-8)

    @pytest.mark.slow
    def test_a_cart_is_a_unicycle(self, cart):
        """Wheels at given speeds: at each step its equations, over many the arc of a circle, to the steps' error."""
        speeds, dt, steps = np.array([3.0, 5.0]), 0.002, 500
        tasks = {
            "left": osik.WheelTask(cart, "left", radius=RADIUS, hard=True),
            "right": osik.WheelTask(cart, "right", radius=RADIUS, hard=True),
            "motors": osik.PostureTask(cart, joints=("left", "right"), gain=0.0, target_velocity=speeds),
        }
        start = cart.configuration({"z": 0.05, "yaw": 0.3})
        path = osik.rollout(cart, start, tasks, dt=dt, steps=steps, **FREE)
        v, q = np.asarray(path.solution.velocity), np.asarray(path.q)
        yaw = q[:-1, 3]
        ahead, turn = RADIUS * speeds.mean(), RADIUS * (speeds[1] - speeds[0]) / TRACK
        np.testing.assert_allclose(v[:, 0], ahead * np.cos(yaw), atol=1e-6)
        np.testing.assert_allclose(v[:, 1], ahead * np.sin(yaw), atol=1e-6)
        np.testing.assert_allclose(v[:, 3], turn, atol=1e-6)
        np.testing.assert_allclose(v[:, 4:], np.tile(speeds, (steps, 1)), atol=1e-6)
        end = 0.3 + turn * dt * steps
        circle = ahead / turn * np.array([np.sin(end) - np.sin(0.3), np.cos(0.3) - np.cos(end)])
        np.testing.assert_allclose(q[-1, :2], circle, atol=ahead * dt * steps * turn * dt)
        np.testing.assert_allclose(q[:, 2], 0.05 * (1.0 - 10.0 * dt) ** np.arange(steps + 1), atol=1e-9)
        assert (np.asarray(path.solution.status) == osik.Status.SOLVED).all()

    @pytest.mark.slow
    def test_a_cart_follows_its_nose(self, cart):
        """Pulled to its side it cannot go there, pulled ahead its wheels turn."""
        tasks = {name: osik.WheelTask(cart, name, radius=RADIUS, hard=True) for name in ("left", "right")}
        for wanted, expected in (([1.0, 0.0], [1.0, 0.0]), ([0.0, 1.0], [0.0, 0.0])):
            pull = osik.PostureTask(cart, joints=("x", "y"), gain=0.0, target_velocity=wanted)
            hold = osik.PostureTask(cart, joints=("yaw",), gain=0.0)
            answer = osik.solve(cart, cart.q0, tasks | {"pull": pull, "hold": hold}, **FREE)
            assert int(answer.status) == osik.Status.SOLVED
            np.testing.assert_allclose(answer.velocity[:2], expected, atol=1e-6)
            np.testing.assert_allclose(answer.velocity[4:], np.full(2, expected[0] / RADIUS), atol=1e-5)

    def test_mecanum_wheels_go_any_way(self):
        """The speeds of four mecanum wheels for any motion of the cart: their textbook formula."""
        robot = osik.Robot.from_mjcf(mjcf("omni_wheels"))
        signs = np.array([-1.0, 1.0, 1.0, -1.0])
        wheels = {
            f"w{i}": osik.WheelTask(robot, f"w{i}", radius=0.1, roller_angle=sign * np.pi / 4, hard=True)
            for i, sign in enumerate(signs)
        }
        x, y, turn = 0.3, -0.5, 0.7
        base = osik.PostureTask(robot, joints=("x", "y", "yaw"), gain=0.0, target_velocity=[x, y, turn])
        answer = osik.solve(robot, robot.q0, wheels | {"base": base}, **FREE)
        places = np.array([[0.3, 0.2], [0.3, -0.2], [-0.3, 0.2], [-0.3, -0.2]])
        hub = np.array([x, y]) + turn * np.stack([-places[:, 1], places[:, 0]], 1)
        np.testing.assert_allclose(answer.velocity[:4], [x, y, 0.0, turn], atol=1e-6)
        np.testing.assert_allclose(answer.velocity[4:], (hub[:, 0] + signs * hub[:, 1]) / 0.1, atol=1e-4)

    @pytest.mark.release
    def test_every_number_counts_and_gradients_are_finite(self, walker, cart, configurations):
        """Also of a wheel that lies flat."""
        tasks = {
            "wheel": osik.WheelTask(walker, "shin", radius=0.2),
            "rollers": osik.WheelTask(walker, "shin", radius=0.2, roller_angle=0.3),
        }
        assert_every_number_counts(walker, tasks, configurations[0])
        flat = {"flat": osik.WheelTask(cart, "left", radius=RADIUS, axis=(0.0, 0.0, 1.0))}
        rows = rows_of_each(cart, flat, cart.q0)["flat"]
        np.testing.assert_allclose(rows.error, [0.0, 0.0, RADIUS], atol=1e-14)
        assert_finite_gradients(rows_of_each, *alone(cart, flat, cart.q0))

    def test_mistakes(self, cart):
        refuses(ValueError, "radius is -0.1", osik.WheelTask, cart, "left", radius=-0.1)
        with pytest.raises(TypeError, match="no 'roller_angle' to replace"):
            osik.WheelTask(cart, "left", radius=0.1).replace(roller_angle=0.1)
