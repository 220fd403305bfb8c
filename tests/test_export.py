"""Programs of ``backend="jax"`` as ``jax.export`` takes them: a step under each scheme, and the same numbers."""

import jax
import numpy as np
import pytest

import osik_jax as osik

pytestmark = pytest.mark.slow
PIVOTED_QR = jax.export.DisabledSafetyCheck.custom_call("lapack_dgeqp3_ffi")
"""LAPACK's call, of which JAX does not promise that another release knows it."""
SCHEMES = {
    "weighted": osik.WeightedQP(backend="jax"),
    "hierarchical": osik.HierarchicalQP(backend="jax"),
    "classical": osik.NullSpace(backend="jax"),
    "reverse": osik.NullSpace(method="reverse", backend="jax"),
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
        limits = osik.no_limits if name in ("classical", "reverse") else None
        return jax.jit(lambda q: osik.solve(robot, q, tasks, scheme=SCHEMES[name], limits=limits).velocity)

    return made, robot.q0 + 0.1


@pytest.mark.variants(release=["classical", "reverse", "saturated"])
@pytest.mark.parametrize("name", SCHEMES)
def test_a_step_is_exported(name, step):
    made, q = step
    checks = [PIVOTED_QR] if name == "hierarchical" else []
    exported = jax.export.export(made(name), disabled_checks=checks)(q)
    np.testing.assert_allclose(exported.call(q), made(name)(q), atol=1e-12)


def test_a_hierarchy_is_not_exported_unasked(step):
    """``docs/solvers.md`` says what to ask for; where this fails, it need not any more."""
    made, q = step
    with pytest.raises(ValueError, match="lapack_dgeqp3_ffi"):
        jax.export.export(made("hierarchical"))(q)
