"""Inverse kinematics out of reach: the least error, beside SciPy's bounded minimiser on MuJoCo's kinematics."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model_files import mjcf
from scipy.optimize import minimize

import osik_jax as osik
from osik_jax.inverse._chain_problem import ChainRoute, Settings
from osik_jax.inverse._chain_search import Goal, lanes_last
from osik_jax.inverse._inverse_kinematics import joint_box

FINGER = (
    '<body pos="0 {y} 0"><joint name="{n}1" axis="0 1 0" range="-1.5 1.5"/><geom size=".01"/><body pos="0 0 .05">'
    '<joint name="{n}2" axis="0 1 0" range="-1.5 1.5"/><geom size=".01"/><site name="{n}" pos="0 0 .05"/></body></body>'
)
HEAD = "<mujoco><compiler angle='radian' autolimits='true'/><worldbody>"


RADIAN = 0.1
"""What a radian counts as [m], with the default tolerances."""


def error_and_slope(robot, site, position, rotation=None):
    """The error of a configuration, half its square in metres, and its gradient, by MuJoCo."""
    model = robot.mj_model
    data, jacobian = mujoco.MjData(model), np.zeros((6, model.nv))

    def cost(q):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], data.site(site).id)
        error = data.site(site).xpos - position
        half, slope = 0.5 * error @ error, jacobian[:3].T @ error
        if rotation is not None:
            quaternion, turn = np.zeros(4), np.zeros(3)
            mujoco.mju_mat2Quat(quaternion, (data.site(site).xmat.reshape(3, 3) @ rotation.T).ravel())
            mujoco.mju_quat2Vel(turn, quaternion, 1.0)
            half, slope = half + 0.5 * RADIAN**2 * turn @ turn, slope + RADIAN**2 * jacobian[3:].T @ turn
        return half, slope

    return cost


def least_distance(robot, cost, rng, starts=30):
    """The least error by many bounded searches [m]."""
    low, high = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    bounds = list(zip(low, high, strict=True))
    options: dict[str, Any] = dict(jac=True, method="L-BFGS-B", bounds=bounds, tol=1e-14)
    return np.sqrt(2.0 * min(minimize(cost, rng.uniform(low, high), **options).fun for _ in range(starts)))


@pytest.mark.slow
def test_least_error_beside_scipy(arm, rng):
    """Positions beyond the links, one proven so, and one inside the arm's base, by numbers and while tracing."""
    targets = np.array([[1.4, 0.1, 0.3], [0.0, 0.0, -1.5], [-0.4, 0.3, 1.2], [0.02, 0.01, -0.55]])
    least = [least_distance(arm, error_and_slope(arm, "hand", target), rng) for target in targets]
    found = osik.inverse_kinematics(arm, {"hand": targets})
    assert not np.asarray(found.converged).any() and np.asarray(found.beyond_reach)[0] > 0.0
    np.testing.assert_allclose(found.position_error, least, atol=1e-5)
    traced = jax.jit(lambda p: osik.inverse_kinematics(arm, {"hand": p}).position_error)(jnp.asarray(targets))
    np.testing.assert_allclose(traced, least, atol=1e-5)
    quick = osik.inverse_kinematics(arm, {"hand": targets}, closest=False, restarts=0)
    assert (np.asarray(quick.position_error) >= np.array(least) - 1e-5).all()
    q = np.asarray(found.q)
    assert (q >= np.asarray(arm.position_lower)).all() and (q <= np.asarray(arm.position_upper)).all()


@pytest.mark.slow
def test_least_error_of_poses_beside_scipy(arm, rng):
    """Positions beyond the links, and orientations that the ranges exclude."""
    positions = np.array([[1.1, 0.1, 0.3], [-0.2, -0.9, 0.4], [0.05, 0.0, -0.4]])
    rotations = np.linalg.qr(rng.normal(size=(3, 3, 3)))[0]
    rotations *= np.linalg.det(rotations)[:, None, None]
    found = osik.inverse_kinematics(arm, {"hand": (positions, rotations)})
    assert not np.asarray(found.converged).any()
    for q, *pose in zip(np.asarray(found.q), positions, rotations, strict=True):
        cost = error_and_slope(arm, "hand", *pose)
        assert np.sqrt(2.0 * cost(q)[0]) < least_distance(arm, cost, rng, starts=60) + 1e-4


@pytest.mark.slow
def test_limbs_that_share_no_joint_stay_on_their_targets():
    robot = osik.Robot.from_mjcf(
        HEAD + FINGER.format(y=0, n="a") + FINGER.format(y=0.1, n="b") + "</worldbody></mujoco>"
    )
    q = jnp.array([0.4, 0.5, 0.4, 0.5])
    goal = {name: np.array(osik.forward_kinematics(robot, q).frame_pose(robot, name)[0]) for name in "ab"}
    goal["a"] = goal["a"] + [0.0, 0.0, 0.2]
    straight = np.linalg.norm(goal["a"]) - 0.1  # the links in one line towards the target
    for q0 in (None, q):
        found = osik.inverse_kinematics(robot, goal, q0=q0)
        off = {name: float(np.linalg.norm(found.residual[name])) for name in "ab"}
        assert not found.converged and off["b"] < 1e-6
        assert off["a"] == pytest.approx(straight, abs=1e-6)


@pytest.mark.slow
@pytest.mark.variants(release=["rows0"])
@pytest.mark.parametrize("rows", [(True,) * 6, (True,) * 3 + (False,) * 3])
def test_hessian_of_the_error_by_central_differences(rng, rows):
    """A slide, hinges off their origins, two joints on a body and a follower."""
    robot = osik.Robot.from_mjcf(mjcf("arm_on_a_cart"))
    settings = Settings(robot.q0, *joint_box(robot, None), 0, jnp.array([1e-3, 1e-2]), 8)
    search = ChainRoute(("tip",), (rows,)).search(robot, settings, warm=False, near=False)
    rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    goal = lanes_last(Goal(jnp.asarray(rng.standard_normal((1, 1, 3))), jnp.asarray(rotation[None, None])))

    def gradient(x):
        error, matrix, _ = search.linearised(x, goal)
        return np.einsum("mnl,ml->n", matrix, error)

    x = rng.uniform(-0.4, 0.4, (len(search.lower), 1))
    _, matrix, curved = search.model(jnp.asarray(x), goal)
    hessian = np.einsum("mil,mjl->ij", matrix, matrix) + np.asarray(curved)[..., 0]
    step = 1e-5
    columns = [(gradient(x + step * e[:, None]) - gradient(x - step * e[:, None])) / (2 * step) for e in np.eye(len(x))]
    np.testing.assert_allclose(hessian, np.stack(columns, 1), atol=1e-8)


@pytest.mark.variants(slow=["two"], release=["one"])
@pytest.mark.filterwarnings("ignore::osik_jax.OsikWarning")
@pytest.mark.parametrize(
    "slide, ways", [("", 1), ('<joint name="slide" type="slide" axis="1 0 0"/>', 2)], ids=["one", "two"]
)
def test_explain_counts_the_motions_that_keep_closed_loops(slide, ways):
    """Against the rank of MuJoCo's rows of loops and frame, where the open chain would allow more."""
    text = mjcf("four_bar").replace('<joint name="rocker"', f'{slide}<joint name="rocker"')
    robot = osik.Robot.from_mjcf(text)
    tasks = {
        "loops": osik.EqualityConstraintTask(robot, hard=True),
        "end": osik.FrameTask(robot, "end", target=(np.array([0.35, 0.45, 0.1]), np.eye(3))),
    }
    found = osik.inverse_kinematics(robot, tasks, seeds=4, restarts=0)
    said = found.explain()
    model = robot.mj_model
    data, frame = mujoco.MjData(model), np.zeros((6, model.nv))
    data.qpos[:] = np.asarray(robot.mujoco_qpos(found.q))
    mujoco.mj_forward(model, data)
    mujoco.mj_jacSite(model, data, frame[:3], frame[3:], data.site("end").id)
    loops = data.efc_J.reshape(-1, model.nv)[: data.ne]
    rank = lambda *parts: np.linalg.matrix_rank(np.concatenate(parts), tol=1e-6)  # noqa: E731
    assert rank(loops, frame) - rank(loops) == ways
    assert f"end asks for 6 rows and its 2 joints move it {ways} way{'s' * (ways > 1)} under 'loops'" in said
    rows = eval(said.split("rows=")[1].split(")")[0] + ")")
    moved = frame[list(rows)] @ (np.eye(model.nv) - np.linalg.pinv(loops, rcond=1e-6) @ loops)
    assert sum(rows) == ways and np.linalg.svd(moved, compute_uv=False).min() > 1e-2


@pytest.mark.filterwarnings("ignore::osik_jax.OsikWarning")
@pytest.mark.variants(slow=["float64-1e+200"], release=["float32-1e+30"])
@pytest.mark.parametrize("kind, far", [(jnp.float64, 1e200), (jnp.float32, 1e30)])
def test_a_target_whose_square_is_not_finite_has_a_finite_answer(kind, far):
    """While tracing and from the host; the neighbour is found."""
    arm = osik.load_robot("arm7").astype(kind)
    places = jnp.array([[0.3, far, 0.6], [0.4, 0.1, 0.4]], kind)

    def find(places):
        return osik.inverse_kinematics(arm, {"hand": places}, seeds=8)

    for found in (jax.jit(find)(places), find(np.asarray(places))):
        assert np.asarray(found.converged).tolist() == [False, True]
        for leaf in jax.tree.leaves(found):
            assert jnp.isfinite(leaf).all()
        assert found.position_error[0] == jnp.finfo(kind).max and found.beyond_reach[0] > 1.0


@pytest.fixture(scope="module")
def planar():
    return osik.Robot.from_mjcf(mjcf("two_links_with_a_tip"))


def nearest_of_two_links(x, y):
    """Configuration of links of 0.5 m and 0.4 m that is nearest to a target out of reach, joints within 170 degrees."""
    end = np.radians(170.0)
    if abs(np.arctan2(y, x)) < end:
        return np.array([np.arctan2(y, x), 0.0])
    elbow = 0.5 * np.cos(end), 0.5 * np.sin(end)
    return np.array([end, np.arctan2(y - elbow[1], x - elbow[0]) % (2.0 * np.pi) - end])


def differences(function, at, step=1e-6):
    """Central differences along x and y."""
    return np.stack([(function(*at + step * e) - function(*at - step * e)) / (2.0 * step) for e in np.eye(2)], -1)


@pytest.mark.variants(slow=["a pose"], release=["a task", "a level", "hard"])
@pytest.mark.parametrize("by", ["a pose", "a task", "a level", "hard"])
def test_derivative_out_of_reach_is_that_of_the_nearest_configuration(planar, by):
    """In closed form: stretched towards the target, and with the first joint at its limit; a posture gives way."""

    def find(p):
        goal = osik.FrameTask(planar, "tip", rows="position", target=p, weight=3.0, priority=1, hard=by == "hard")
        tasks: Any = {"tip": p if by == "a pose" else goal}
        if by in ("a level", "hard"):
            tasks["posture"] = osik.PostureTask(planar, target=[1.0, 1.0], priority=2)
        found = osik.inverse_kinematics(planar, tasks, seeds=4, steps=40)
        return found.q, found.position_error, found.orientation_error

    slopes = (jax.jacfwd, jax.jacrev) if by == "a pose" else (jax.jacfwd,)
    both = jax.jit(jax.vmap(lambda p: (find(p), *(slope(find)(p) for slope in slopes))))
    targets = np.array([[1.2, 0.3, 0.0], [-1.3, 0.05, 0.0], [3.0, 0.0, 0.0], [0.9005, 0.0, 0.0]])
    (q, error, _), *rates = both(targets)
    for at, p in enumerate(targets):
        expected = nearest_of_two_links(*p[:2])
        np.testing.assert_allclose(q[at], expected, atol=2e-5)
        slope = differences(nearest_of_two_links, p[:2])
        distance = differences(lambda x, y: np.hypot(*tip_of_two_links(nearest_of_two_links(x, y)) - (x, y)), p[:2])
        assert error[at] == pytest.approx(np.hypot(*tip_of_two_links(expected) - p[:2]), abs=1e-7)
        for moved, widened, turned in rates:
            np.testing.assert_allclose(moved[at][:, :2], slope, atol=1e-4)
            np.testing.assert_allclose(widened[at][:2], distance, atol=1e-4)
            assert not np.asarray(turned[at]).any()


def tip_of_two_links(q):
    return 0.5 * np.array([np.cos(q[0]), np.sin(q[0])]) + 0.4 * np.array([np.cos(q.sum()), np.sin(q.sum())])


@pytest.mark.variants(slow=["pose"], release=["position"])
@pytest.mark.parametrize("frames", ["position", "pose"])
def test_errors_of_an_arm_out_of_reach_have_the_derivatives_of_the_answer(arm, frames):
    """Against central differences of the least error itself, which is unique where its configuration is not."""
    rotation = np.diag([1.0, -1.0, -1.0])

    def find(p):
        pose = p if frames == "position" else (p, rotation)
        found = osik.inverse_kinematics(arm, {"hand": pose}, seeds=16, steps=24)
        return found.position_error**2 + (RADIAN * found.orientation_error) ** 2, found.q

    both = jax.jit(jax.vmap(lambda p: (find(p), jax.jacfwd(find)(p))))
    positions, step = np.array([[1.5, 0.1, 0.3], [-0.4, 0.3, 1.2]]), 1e-4
    (squared, _), (slope, moved) = both(positions)
    assert np.sqrt(squared).min() > 0.05 and np.abs(moved).max() < 20.0
    for axis in np.eye(3):
        ahead, behind = (both(positions + sign * step * axis)[0][0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(slope @ axis, (ahead - behind) / (2.0 * step), atol=1e-4)


@pytest.mark.slow
def test_derivatives_by_a_link_in_reverse(planar):
    """Derivatives of q alone, without a cotangent of the errors; and of the error, which falls as the link grows."""

    def find(share, target, start):
        robot = dataclasses.replace(planar, body_position=share * planar.body_position)
        found = osik.inverse_kinematics(robot, {"tip": target}, q0=start, seeds=1, steps=40)
        return found.q, found.position_error

    start, inside, outside = jnp.array([0.1, 1.0]), jnp.array([0.5, 0.3, 0.0]), jnp.array([1.2, 0.3, 0.0])
    slope = jax.jit(jax.jacrev(lambda share: find(share, inside, start)[0]))(1.0)
    by = jax.jit(lambda share: find(share, inside, start)[0])
    np.testing.assert_allclose(slope, (by(1.0 + 1e-5) - by(1.0 - 1e-5)) / 2e-5, atol=1e-5)
    assert jax.jit(jax.grad(lambda share: find(share, outside, start)[1]))(1.0) == pytest.approx(-0.5, abs=1e-6)
