"""Tuning through each scheme: its gradients against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import optax
import pytest

import osik_jax as osik
from osik_jax import tuning

pytestmark = pytest.mark.slow

SCHEMES = {
    "weighted": osik.WeightedQP(damping=1e-3),
    "null-space": osik.NullSpace(damping=1e-3),
    "hierarchical": osik.HierarchicalQP(),
}


@pytest.mark.variants(release=["hierarchical", "null-space", "weighted"])
@pytest.mark.parametrize("name", SCHEMES)
def test_the_step_is_the_gradient(name, arm):
    """Plain descent with rate 1, against central differences of the loss that the same program reports."""
    tasks = {
        "hand": osik.FrameTask(arm, "hand", rows="position", gain=osik.AdaptiveGain(6.0, 2.0, 3.0)),
        "elbow": osik.FrameTask(arm, "link4", rows="position", gain=3.0, priority=2),
        "posture": osik.PostureTask(arm, weight=0.1, gain=1.0, priority=2),
    }
    limits = osik.ConfigurationLimit(arm), osik.VelocityLimit(arm, velocity={"*": 1.5})
    loop = tuning.Loop(arm, tasks, scheme=SCHEMES[name], limits=limits, dt=0.05, steps=6)
    random = np.random.default_rng(0)
    places = tasks["hand"].target[0] + 0.1 * random.normal(size=(3, 3))
    scenarios = tuning.Scenarios(q0=arm.q0 + 0.3 * random.normal(size=(3, 7)), values={"hand.target[0]": places})
    loss = tuning.Tracking("hand", "elbow") + 1e-4 * tuning.Smoothness()
    names = ["hand.gain", "posture.gain", "elbow.weight", "limits[1].velocity"]
    descent = optax.sgd(1.0)

    def first(own, iterations=1):
        options: Any = dict(optimizer=descent, iterations=iterations, progress=False)
        return tuning.tune(loss, names, scenarios, loop=own, **options)

    tuned = first(loop, iterations=2)
    gradient = tuned.history.vectors[0] - tuned.history.vectors[1]
    assert np.linalg.norm(gradient) == pytest.approx(tuned.history.gradient_norm[0]) and len(gradient) == 12
    start = tuned.space.initial
    for direction in np.random.default_rng(1).normal(size=(4, 12)):
        ends = [first(tuned.space.apply(loop, start + h * direction)).loss for h in (1e-5, -1e-5)]
        assert gradient @ direction == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-5)
