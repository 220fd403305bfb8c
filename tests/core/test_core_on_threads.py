"""The GPU's text of kinematics, rows and searches for poses, on a CPU, beside the CPU's own call.

It is about the orders of arrays in memory, which differ.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import one_warp
import pytest
from core_checks import needs_core
from model_files import mjcf

import osik_jax as osik
from osik_jax.core import _cuda, _library
from osik_jax.inverse._chain_kernel import advanced
from osik_jax.inverse._chain_problem import ChainRoute, Settings
from osik_jax.inverse._chain_search import Goal
from osik_jax.kinematics import _kernels
from osik_jax.tasks import _com, _frame, _pose

pytestmark = needs_core
LANES = 3


def made(name):
    """A robot, whose joints each have a column of their own or not, and one of its frames."""
    if name == "coupled":
        return osik.Robot.from_mjcf(mjcf("coupled"), locked_joints={"stiff": 0.4}), "end"
    return osik.load_robot(name), "LThigh" if name == "nao" else "link4"


def with_lanes(tree, of_each, lanes=LANES):
    """Arrays with a leading axis: of all lanes, with a factor of each, or of length 1."""
    factor = 1.0 + 0.1 * np.arange(lanes)
    return jax.tree.map(lambda a: a * factor.reshape(-1, *[1] * a.ndim) if of_each else a[None], tree)


def everything(call, robot, q, tasks, frames):
    kinematics: Any = _kernels.bodies(call, robot, q)
    positions, rotations, jacobians = moving = _kernels.moving_frames(call, robot, kinematics, frames)
    found = [kinematics, moving, _kernels.center_of_mass(call, robot, kinematics)]
    found.append(_com._fields_by_kernel(call, tasks["com"], robot, kinematics))
    if len(robot.tree.dof_body) == robot.tree.nv:
        found.append(_frame._fields_by_kernel(call, tasks["frame"], robot, kinematics))
    pose = (jnp.asarray(a[:, 0]) for a in (positions, rotations, jacobians))
    found.append(_pose._fields_by_kernel(call, tasks["frame"], *pose))
    return found


@pytest.mark.variants(ordinary=["arm7-3-True", "coupled-3-True"], slow=["nao-3-False", "coupled-1-False"])
@pytest.mark.parametrize(("lanes", "of_each"), [(1, False), (LANES, False), (LANES, True)])
@pytest.mark.parametrize("name", ["arm7", "nao", "coupled"])
def test_the_text_of_a_gpu_is_that_of_a_cpu(name, lanes, of_each, tmp_path, rng, monkeypatch):
    monkeypatch.setattr(_cuda, "call", partial(one_warp.call_of_lanes, tmp_path))
    robot, frame = made(name)
    q = jnp.asarray(robot.q0 + 0.2 * rng.standard_normal((lanes, robot.nq)))
    target = osik.forward_kinematics(robot, robot.q0).frame_pose(robot, frame)
    tasks = dict(
        com=osik.ComTask(robot, axes="xz", target=[0.1, 0.3]),
        frame=osik.FrameTask(robot, frame, target=target, orientation_weight=0.3),
    )
    given = with_lanes(robot, of_each, lanes), q, with_lanes(tasks, of_each, lanes), [robot.tree.frame(frame), 1]
    expected, found = (jax.tree.leaves(everything(call, *given)) for call in (_library.call, _cuda.call_lanes))
    for a, b in zip(found, expected, strict=True):
        near = 1e-12 if np.ndim(b) > 1 else 1e-8  # a curvature is the root of a sum whose terms may cancel
        np.testing.assert_allclose(a, b, rtol=0, atol=near * max(1.0, float(np.abs(b).max())))


@pytest.mark.slow
def test_searches_for_poses(tmp_path, rng, monkeypatch):
    monkeypatch.setattr(_cuda, "call", partial(one_warp.call_of_lanes, tmp_path))
    robot, frame = made("arm7")
    route, lower, upper = ChainRoute((frame,), ((True,) * 6,)), robot.position_lower, robot.position_upper
    settings = Settings(robot.q0, jnp.asarray(lower), jnp.asarray(upper), 0, jnp.array([1e-3, 1e-2]), 64)
    search = route.search(robot, settings, warm=False, near=False)
    q = robot.q0 + 0.4 * rng.standard_normal((LANES, robot.nq))
    goal = Goal(*jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_poses(robot, route.frames))(q))
    given = with_lanes(search, False), jnp.asarray(search.begin(jnp.arange(LANES), goal)), goal
    for steps in (1, 3):
        run = partial(advanced, steps=steps, damping=(0.01, 1e-6))
        found, expected = (jax.tree.leaves(run(call, *given)) for call in (_cuda.call_lanes, _library.call))
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10)
