"""Other numbers in limits and schemes, and what robots and tasks say of themselves."""

from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refuses

import osik_jax as osik


def limits_of(robot):
    return {
        "configuration": (osik.ConfigurationLimit(robot), dict(lower=-0.5, upper=0.5, gain=0.3)),
        "velocity": (osik.VelocityLimit(robot), dict(velocity=0.1)),
        "acceleration": (osik.AccelerationLimit(robot, {"*": 3.0}), dict(acceleration=1.0, velocity=0.2, lower=-1.0)),
        "barrier": (osik.PositionBarrier(robot, "hand", upper=1.0), dict(upper=0.5, gain=2.0, normals=np.eye(3)[::-1])),
        "linear": (osik.LinearLimit(robot, np.eye(7), -1.0, 1.0), dict(matrix=2.0 * np.eye(7), upper=0.3)),
    }


class TestLimits:
    def test_are_as_if_made_with_the_new_numbers(self, arm):
        made = {
            "configuration": osik.ConfigurationLimit(arm, lower=np.full(7, -0.5), upper=np.full(7, 0.5), gain=0.3),
            "velocity": osik.VelocityLimit(arm, velocity={"*": 0.1}),
            "acceleration": osik.AccelerationLimit(arm, {"*": 1.0}, velocity={"*": 0.2}, lower=np.full(7, -1.0)),
            "barrier": osik.PositionBarrier(arm, "hand", upper=0.5, gain=2.0, normals=np.eye(3)[::-1]),
            "linear": osik.LinearLimit(arm, 2.0 * np.eye(7), -1.0, 0.3),
        }
        for name, (limit, changes) in limits_of(arm).items():
            new = limit.replace(**changes)
            assert jax.tree.structure(new) == jax.tree.structure(limit)
            for a, b in zip(jax.tree.leaves(new), jax.tree.leaves(made[name]), strict=True):
                np.testing.assert_array_equal(a, b, err_msg=name)

    def test_of_a_free_base(self, nao):
        limit = osik.FloatingBaseVelocityLimit(nao, linear=0.5)
        np.testing.assert_array_equal(limit.replace(linear=[1.0, 2.0, 3.0]).linear, [1.0, 2.0, 3.0])
        refuses(TypeError, "no 'angular' to replace; it has: linear", limit.replace, angular=1.0)
        refuses(ValueError, "speeds have to be 0 or more", limit.replace, linear=-1.0)

    @pytest.mark.parametrize(
        ("name", "changes", "error", "message"),
        [
            ("configuration", dict(gain=0.0), ValueError, "above 0 and up to 1"),
            ("configuration", dict(velocity=1.0), TypeError, "no 'velocity' to replace; it has: lower, upper, gain"),
            ("barrier", dict(gain=0.0), ValueError, "has to be positive"),
            ("barrier", dict(normals=0.0), ValueError, "finite and not 0"),
            ("linear", dict(matrix=np.nan), ValueError, "matrix is nan"),
        ],
    )
    def test_mistakes_are_told(self, arm, name, changes, error, message):
        with pytest.raises(error, match=message):
            limits_of(arm)[name][0].replace(**changes)


class TestSchemes:
    def test_new_numbers(self):
        assert osik.WeightedQP().replace(damping=1e-3).damping == 1e-3
        scheme = osik.NullSpace(method="saturated").replace(margin=0.1, potential_gain=0.0)
        assert scheme.method == "saturated"
        assert (float(scheme.margin), float(scheme.potential_gain)) == (0.1, 0.0)

    @pytest.mark.slow
    def test_inside_jit_and_in_batches(self, arm):
        scheme = osik.WeightedQP(curvature_damping=0.0)
        task = {"hand": osik.FrameTask(arm, "hand", target=(np.ones(3), np.eye(3)))}
        dampings = jnp.array([1e-4, 1.0, 1e4])

        def speed(damping):
            return jnp.abs(
                osik.solve(arm, arm.q0, task, scheme=scheme.replace(damping=damping), limits=osik.no_limits).velocity
            ).max()

        fast, slow, still = jax.vmap(speed)(dampings)
        assert fast > 2.0 * slow > 200.0 * still

    @pytest.mark.parametrize(
        ("scheme", "changes", "error", "message"),
        [
            (osik.HierarchicalQP(), dict(curvature_damping=-1.0), ValueError, "curvature_damping"),
            (osik.WeightedQP(), dict(max_iterations=3), TypeError, "it has: damping, curvature_damping"),
            (osik.NullSpace(), dict(method="saturated"), TypeError, "structure is fixed"),
        ],
    )
    def test_mistakes_are_told(self, scheme, changes, error, message):
        refuses(error, message, scheme.replace, **changes)


class TestWords:
    def test_a_robot_in_five_lines(self, nao, arm):
        lines = repr(nao).splitlines()
        assert lines == [
            "Robot 'nao': nq 32, nv 31, floating base",
            "  25 joints: HeadYaw, HeadPitch, LHipYawPitch, LHipRoll, ...; 1 mimic",
            "  74 frames of 27 bodies: torso, Neck, Head, LPelvis, ...",
            f"  mass {sum(nao.mj_model.body_mass):.4g} kg",
            "  limits: 25 ranges and 25 speeds of 25 joint coordinates",
        ]
        assert "7 joints" in repr(arm)
        assert "fixed base" in repr(arm)

    def test_a_stack_of_robots_and_a_traced_one(self, arm):
        assert "a stack of 2" in repr(osik.stack([arm, arm.scaled(length=1.1)]))
        seen = []
        jax.eval_shape(lambda robot: seen.append(repr(robot)), arm)
        assert "mass of each robot its own" in seen[0]

    def test_locked_joints_are_counted(self):
        assert "2 locked" in repr(osik.load_robot("nao", locked_joints=("Head*",)))

    def test_tasks_in_one_line(self, nao):
        hand = osik.FrameTask(nao, "l_gripper", rows="position", weight=2.0, priority=3, hard=True)
        assert repr(hand) == (
            "FrameTask(frame='l_gripper', rows='position', axes='world', error='decoupled', weight=2, gain=10, "
            "priority=3, hard=True)"
        )
        posture = osik.PostureTask(nao, joints=("Head*",), weight=[1.0, 2.0], gain=osik.AdaptiveGain(4.0, 1.0, 2.0))
        assert repr(posture) == "PostureTask(joints=<2>, weight=<2>, gain=AdaptiveGain(4, 1, 2), priority=1)"
        seen = []
        jax.eval_shape(lambda task: seen.append(repr(task)), hand)
        assert "weight=<traced>" in seen[0]

    def test_the_version_is_that_of_the_installed_package(self):
        assert osik.__version__ == version("osik-jax")
