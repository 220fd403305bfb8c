"""Programs of ``backend="jax"`` as ``jax.export`` takes them: a step under each scheme, and the same numbers."""

import jax
import numpy as np
import pytest
from refusals import refuses

import osik_jax as osik

pytestmark = pytest.mark.slow
PIVOTED_QR = jax.export.DisabledSafetyCheck.custom_call("lapack_dgeqp3_ffi")
"""LAPACK's call, of which JAX does not promise that another release knows it."""
SCHEMES = {
    "weighted": osik.WeightedQP(backend="jax"),
    "hierarchical": osik.HierarchicalQP(backend="jax"),
    "classical": osik.NullSpace(backend="jax"),
    "saturated": osik.NullSpace(method="saturated", backend="jax"),
}


@pytest.fixture(scope="module")
def step():
    """A step of an arm for each scheme, and a configuration."""
    robot = osik.load_robot("arm7")
    tasks = {
        "hand": osik.FrameTask(robot, "hand", rows="position", priority=1),
        "posture": osik.PostureTask(robot, priority=2),
    }

    def made(name):
        limits = osik.no_limits if name == "classical" else None
        return jax.jit(lambda q: osik.solve(robot, q, tasks, scheme=SCHEMES[name], limits=limits).velocity)

    return made, robot.q0 + 0.1


def test_a_hierarchy_is_not_exported_unasked(step):
    """``docs/deploying.md`` says what to ask for; where this fails, it need not any more."""
    made, q = step
    refuses(ValueError, "lapack_dgeqp3_ffi", jax.export.export(made("hierarchical")), q)


@pytest.mark.variants(release=["classical", "saturated", "hierarchical", "weighted"])
@pytest.mark.parametrize("name", SCHEMES)
def test_a_symbolic_batch_is_exported(name, step):
    """One program for batches of any size: the numbers of ``vmap`` with each size."""
    made, q = step
    (n,) = jax.export.symbolic_shape("n")
    checks = [PIVOTED_QR] if name in ("hierarchical", "saturated") else []
    many = jax.jit(jax.vmap(made(name)))
    exported = jax.export.export(many, disabled_checks=checks)(jax.ShapeDtypeStruct((n, *q.shape), q.dtype))
    rng = np.random.default_rng(0)
    for count in (1, 3, 40):
        batch = q + rng.uniform(-0.2, 0.2, (count, len(q)))
        np.testing.assert_allclose(exported.call(batch), many(batch), atol=1e-9)


@pytest.mark.variants(release=["False-NullSpace"])
@pytest.mark.parametrize("scheme", [osik.NullSpace, osik.WeightedQP])
@pytest.mark.parametrize("is_symbolic", [False, True])
def test_a_program_with_a_kernel_is_refused_in_our_words(scheme, is_symbolic):
    robot = osik.load_robot("arm7")
    tasks = {"hand": osik.FrameTask(robot, "hand", rows="position")}
    step = jax.jit(jax.vmap(lambda q: osik.solve(robot, q, tasks, scheme=scheme(backend="core")).velocity))
    lanes = jax.export.symbolic_shape("n")[0] if is_symbolic else 4
    with pytest.raises(osik.OsikError, match=r"calls a compiled kernel.*jax\.export.*backend=\"jax\""):
        jax.export.export(step)(jax.ShapeDtypeStruct((lanes, robot.nq), robot.q0.dtype))
    assert np.isfinite(step(robot.q0[None])).all()  # as ever where nothing is exported
