"""What the linear model leaves out, damped: bounds against MuJoCo, calm out of reach, exact inside, differentiable."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from task_checks import kinematics_at

import osik_jax as osik
from osik_jax.numerics._dense import short_sum

DT = 0.005
KAPPA = 25.0
"""With which the whole bound is damped far out of reach, where the default damps a 25th of it."""
SCHEMES = {
    "weighted": osik.WeightedQP,
    "hierarchical": osik.HierarchicalQP,
    "null-space": osik.NullSpace,
}


def bent(arm):
    return arm.configuration({name: 0.4 * (-1) ** k for k, name in enumerate(arm.joint_names)})


@pytest.mark.slow
@pytest.mark.variants(release=["0.0001-0.4"])
@pytest.mark.parametrize(("away", "part"), [(1e-4, 0.4), (10.0, 1.0)])
def test_near_all_targets_the_bound_counts_in_part(arm, away, part):
    """A foot that stays does not make less of a hand that is far from its target."""
    q = bent(arm)
    place = kinematics_at(arm, q).frame_pose(arm, "hand")[0]
    elbow = osik.FrameTask(arm, "link4", rows="position", target=kinematics_at(arm, q).frame_pose(arm, "link4"))
    hand = osik.FrameTask(arm, "hand", rows="position", gain=1.0 / DT, target=(place.at[0].add(away), jnp.eye(3)))
    problem = osik.build_problem(arm, q, {"elbow": elbow, "hand": hand}, dt=DT)
    bound, _ = problem.curvature(["elbow", "hand"])
    assert float(bound) == pytest.approx(part * DT * float(problem.rows["hand"].curvature), rel=1e-3)


def test_met_and_linear_tasks_bend_nothing(arm):
    @jax.jit
    def curvatures(q):
        kinematics = osik.forward_kinematics(arm, q)
        met = osik.FrameTask(arm, "hand", target=kinematics.frame_pose(arm, "hand"))
        return [task.rows(arm, kinematics, q).curvature for task in (met, osik.PostureTask(arm, weight=1.0))]

    met, linear = curvatures(bent(arm))
    assert linear == 0.0 and met < 1e-14  # the target's rotation is normalised, which changes it by roundoff


@pytest.mark.variants(slow=["weighted", "hierarchical"], release=["null-space"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_inside_it_is_as_exact_as_without(scheme, arm):
    """A hand that follows a circle, the whole error asked for in one step."""
    q0 = bent(arm)
    p, rotation = kinematics_at(arm, q0).frame_pose(arm, "hand")
    t = 2.0 * np.pi * np.arange(200) * DT
    path = p + 0.05 * np.c_[1.0 - np.cos(t), np.sin(t), 0.0 * t]
    targets = {"hand": (path, np.broadcast_to(rotation, (200, 3, 3)))}
    tasks = {"hand": osik.FrameTask(arm, "hand", rows="position", gain=1.0 / DT)}

    @jax.jit
    @jax.vmap
    def errors(kappa):
        scheme_ = SCHEMES[scheme](curvature_damping=kappa)
        motion = osik.rollout(arm, q0, tasks, scheme=scheme_, limits=osik.no_limits, dt=DT, steps=200, targets=targets)
        ends = jax.vmap(lambda q: kinematics_at(arm, q).frame_pose(arm, "hand")[0])(motion.q[1:])
        return jnp.linalg.norm(ends - path, axis=1)

    damped, plain = np.asarray(errors(jnp.array([1.0, 0.0])))
    if scheme in ("hierarchical", "null-space"):  # what a level can meet is not damped
        assert damped.max() < 1.2 * plain.max()
    assert damped.max() < 1e-3


@pytest.mark.variants(slow=["weighted"], release=["null-space", "hierarchical"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_derivatives_with_the_damping_on(scheme, arm):
    """By target, gain, configuration and the damping's own share, against central differences; second ones too."""
    q0 = bent(arm)
    p, rotation = kinematics_at(arm, q0).frame_pose(arm, "hand")
    posture = osik.PostureTask(arm, weight=0.1, gain=1.0, priority=2)

    def velocity(t):
        hand = osik.FrameTask(
            arm, "hand", rows="position", target=(p + jnp.array([0.5, 0.2, 0.1 + t]), rotation), gain=20.0 + t
        )
        q = q0 + 0.1 * t * jnp.arange(7.0)
        made = SCHEMES[scheme](curvature_damping=1.0 + t)
        return osik.solve(
            arm, q, {"hand": hand, "posture": posture}, scheme=made, limits=osik.no_limits, dt=DT
        ).velocity

    def once(t):
        return jax.jvp(velocity, (t,), (1.0,))

    h, twice = 5e-5, jax.jit(lambda t: jax.jvp(once, (t,), (1.0,)))
    there = {k: twice(k * h)[0] for k in (-2, -1, 1, 2)}  # the velocity and its derivative
    (_, slope), rates = twice(0.0)
    for part, found in enumerate(rates):
        near, far = there[1][part] - there[-1][part], there[2][part] - there[-2][part]
        expected = (8.0 * near - far) / (12.0 * h)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    reverse = jax.jit(jax.jacrev(velocity))(0.0)
    np.testing.assert_allclose(reverse, slope, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.release
@pytest.mark.parametrize("scheme", [*SCHEMES, "saturated"])
def test_derivatives_where_little_room_is_left(scheme, arm):
    """On the way to a target out of reach, with a posture below: by target, gain, configuration and share."""
    make = SCHEMES.get(scheme, lambda **numbers: osik.NullSpace(method="saturated", **numbers))
    q0, away = bent(arm), 1.5 * jnp.array([1.0, 0.3, 0.2]) / jnp.linalg.norm(jnp.array([1.0, 0.3, 0.2]))
    rotation = kinematics_at(arm, q0).frame_pose(arm, "hand")[1]
    hand = osik.FrameTask(arm, "hand", rows="position", target=(away, rotation), gain=10.0)
    posture = osik.PostureTask(arm, target=q0, gain=10.0, priority=2, weight=1.0)
    tasks = {"hand": hand, "posture": posture}
    path = jax.jit(lambda q: osik.rollout(arm, q, tasks, scheme=make(curvature_damping=KAPPA), dt=DT, steps=220).q[-1])(
        q0
    )

    @jax.jit
    def velocity(t):
        aimed = tasks | {"hand": hand.replace(target=(away + jnp.array([0.0, 0.0, t]), rotation), gain=10.0 + t)}
        q = path + 0.01 * t * jnp.arange(7.0)
        return osik.solve(arm, q, aimed, scheme=make(curvature_damping=KAPPA * (1.0 + t)), dt=DT).velocity

    h = 2e-5
    near, far = velocity(h) - velocity(-h), velocity(2.0 * h) - velocity(-2.0 * h)
    expected = (8.0 * near - far) / (12.0 * h)
    found = jax.jvp(velocity, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(jax.jacrev(velocity)(0.0), found, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("error", [0.0, 0.02, 0.8])
@pytest.mark.parametrize("posture", [0.0, 3e-4, 0.1])
def test_a_posture_makes_up_for_it_in_a_weighted_program(arm, posture, error):
    """Without limits the answer is that of a linear system, here with the damping of docs/dev/derivations.md."""
    kappa, damping = 1.25, 1e-8
    q = bent(arm)
    kinematics = kinematics_at(arm, q)
    p, rotation = kinematics.frame_pose(arm, "hand")
    hand = osik.FrameTask(
        arm, "hand", rows="position", target=(p + error * jnp.array([0.6, 0.0, 0.8]), rotation), weight=4.0, gain=10.0
    )
    still = osik.PostureTask(arm, target=q + 0.1, weight=posture, gain=1.0)
    found = osik.solve(
        arm, q, {"hand": hand, "posture": still}, scheme=osik.WeightedQP(damping), limits=osik.no_limits, dt=DT
    )

    rows, ask = hand.rows(arm, kinematics, q), still.rows(arm, kinematics, q)
    J, n = np.asarray(rows.jacobian), arm.nv
    bend = DT * float(rows.curvature)
    arms = 0.0 if error == 0.0 else error * 4.0 * 10.0 * error / float(rows.curvature)
    far, stiffness = arms**2 / (0.06**2 + arms**2), 4.0 * (J**2).sum()
    bend *= 0.4 + 0.6 * far
    added = kappa * bend * (1.0 - 0.96 * far * 2.0 * stiffness / (bend + 2.0 * stiffness))
    held = damping + posture
    held += added * kappa * bend / (kappa * bend + 30.0 * held)
    right = 4.0 * J.T @ np.asarray(rows.lower) + posture * np.asarray(ask.lower)
    expected = np.linalg.solve(4.0 * J.T @ J + held * np.eye(n), right)
    np.testing.assert_allclose(found.velocity, expected, rtol=0, atol=1e-9 * np.abs(expected).max() + 1e-12)


@pytest.mark.release
def test_products_as_a_gpu_takes_them_are_the_same(arm, monkeypatch):
    """Small products are written out where JAX's default is a GPU; here that is only said."""
    q = bent(arm)
    p, turn = kinematics_at(arm, q).frame_pose(arm, "hand")
    kinds: tuple[dict[str, Any], ...] = {}, {"rows": "position", "axes": "frame"}, {"error": "se3"}
    tasks = [osik.FrameTask(arm, "hand", target=(p + 0.3, turn.T), weight=2.0, **options) for options in kinds]

    def rows(q):
        kinematics = osik.forward_kinematics(arm, q)
        found = [task.rows(arm, kinematics, q) for task in tasks]
        numbers = [(each.error, each.jacobian, each.curvature) for each in found]
        return numbers, numbers

    def with_slopes():
        return jax.jit(lambda q: jax.jacfwd(rows, has_aux=True)(q))(q)

    there = with_slopes()
    for module in ("tasks._curvature", "tasks._rotation", "kinematics._forward"):
        monkeypatch.setattr(f"osik_jax.{module}.cuda_is_default", lambda: True)
    same = partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-13)
    jax.tree.map(same, with_slopes(), there)


@pytest.mark.parametrize("count", [0, 1, 31, 32, 70])
def test_sums_in_parts_are_sums(count, rng):
    numbers = rng.normal(size=(3, count))
    np.testing.assert_allclose(short_sum(jnp.asarray(numbers)), numbers.sum(1), rtol=1e-13, atol=1e-15)
