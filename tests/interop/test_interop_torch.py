"""JAX steps on PyTorch tensors: the same numbers and memory, gradients, one compilation."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refuses

import osik_jax as osik

pytest.importorskip("torch", reason="the extra torch")

import torch
from jax.core import Tracer

from osik_jax.interop.torch import _to_torch, wrap


@pytest.fixture(scope="module")
def arm():
    """A batched step of an arm: configurations and positions to velocities and status."""
    robot = osik.load_robot("arm7")
    hand, posture = osik.FrameTask(robot, "hand", rows="position"), osik.PostureTask(robot, weight=0.1)

    def step(q, position):
        tasks = {"hand": hand.replace(target=(position, hand.target[1])), "posture": posture}
        answer = osik.solve(robot, q, tasks, scheme=osik.WeightedQP(damping=1e-3), dt=0.01)
        return {"velocity": answer.velocity, "status": answer.status}

    rng = np.random.default_rng(0)
    q = np.asarray(robot.q0) + rng.uniform(-0.1, 0.1, (3, robot.nq))
    p = np.asarray(hand.target[0]) + rng.uniform(-0.05, 0.05, (3, 3))
    return jax.vmap(step), q, p


def test_numbers_and_pytrees_are_those_of_jax(arm):
    step, q, p = arm
    out, wanted = wrap(step)(torch.tensor(q), torch.tensor(p)), jax.jit(step)(q, p)
    assert set(out) == {"velocity", "status"} and not out["status"].is_floating_point()
    np.testing.assert_allclose(out["velocity"].numpy(), wanted["velocity"], atol=1e-12)
    np.testing.assert_array_equal(out["status"].numpy(), wanted["status"])


@pytest.mark.slow
def test_gradcheck_of_a_step(arm):
    """PyTorch's own check by central differences in float64, of the targets and the configurations."""
    step, q, p = arm
    velocity = wrap(lambda q, p: step(q, p)["velocity"])
    inputs = torch.tensor(q, requires_grad=True), torch.tensor(p, requires_grad=True)
    assert torch.autograd.gradcheck(velocity, inputs, eps=1e-6, atol=1e-5, rtol=1e-5)


def test_compiled_once_and_again_for_its_derivative():
    traced = []

    def step(x, y):
        traced.append(x.shape)
        return jnp.sin(x) * y

    own = wrap(step)
    x: Any = torch.rand(4, dtype=torch.float64)
    y: Any = torch.rand(4, dtype=torch.float64, requires_grad=True)
    for _ in range(3):
        own(x, y.detach())
    after_plain = len(traced)
    for _ in range(3):
        own(x, y).sum().backward()
    after_gradients = len(traced)
    own(x + 1.0, y).sum().backward()
    own(x, y.detach())
    assert (after_plain, after_gradients, len(traced)) == (1, 2, 2)
    assert torch.allclose(y.grad, 3 * torch.sin(x) + torch.sin(x + 1.0))


def test_memory_is_shared_both_ways():
    """A result is the array's own memory, and the array that JAX sees is the tensor's."""
    seen = {}

    def look(x):
        if not isinstance(x, Tracer):
            seen["array"] = x
        return x * 2.0

    x = torch.rand(1000, dtype=torch.float64)
    with jax.disable_jit():
        result = wrap(look)(x)
    assert seen["array"].unsafe_buffer_pointer() == x.data_ptr()
    assert result.data_ptr() != x.data_ptr() and torch.equal(result, 2.0 * x)
    made = jnp.arange(1000.0)
    assert _to_torch([made])[0].data_ptr() == made.unsafe_buffer_pointer()


def test_strided_tensors_and_parts_of_a_tensor():
    x = torch.rand(5, 6, dtype=torch.float64)
    own = wrap(lambda a: jnp.cumsum(a, 1))
    for part in (x.T, x[1:, 1:], x[:, ::2], x[2:3]):
        assert torch.allclose(own(part), torch.cumsum(part, 1))


def test_a_result_that_is_an_argument_has_its_own_memory():
    x: Any = torch.rand(8, dtype=torch.float64, requires_grad=True)
    own = wrap(lambda a: (a, a + 1.0))
    same, other = own(x)
    assert same.data_ptr() != x.data_ptr() != own(x.detach())[0].data_ptr()
    (same.sum() + 2.0 * other.sum()).backward()
    assert torch.equal(x.grad, torch.full((8,), 3.0, dtype=torch.float64))


def test_a_tensor_changed_in_place_before_backward_is_noticed():
    """JAX keeps the memory of arguments and results for the derivative."""
    own = wrap(jnp.exp)
    x = torch.rand(8, dtype=torch.float64, requires_grad=True)
    loss = own(x).sum()
    with torch.no_grad():
        x += 1.0
    refuses(RuntimeError, "modified by an inplace operation", loss.backward)
    y = own(x)
    total = (y * 2.0).sum()
    with torch.no_grad():
        y.zero_()
    refuses(RuntimeError, "modified by an inplace operation", total.backward)


def test_constants_integers_and_unused_arguments():
    own = wrap(lambda tree, index, scale: {"x": tree["a"][index] * scale, "n": index + 1})
    a: Any = torch.rand(6, dtype=torch.float64, requires_grad=True)
    b: Any = torch.rand(2, dtype=torch.float64, requires_grad=True)
    out = own({"a": a, "b": b}, torch.tensor([1, 3]), 2.0)
    assert not out["n"].requires_grad and out["n"].tolist() == [2, 4]
    out["x"].sum().backward()
    assert a.grad.tolist() == [0.0, 2.0, 0.0, 2.0, 0.0, 0.0] and b.grad.tolist() == [0.0, 0.0]
    with torch.no_grad():
        assert not own({"a": a, "b": b}, torch.tensor([1, 3]), 2.0)["x"].requires_grad


def test_what_cannot_be_is_told():
    with pytest.raises(osik.OsikError, match="step is a Tensor; it is a function of arrays"):
        step: Any = torch.zeros(3)
        wrap(step)
    with jax.enable_x64(False), pytest.raises(osik.OsikError, match=r"float64 tensor.*jax_enable_x64"):
        wrap(jnp.sin)(torch.zeros(3, dtype=torch.float64))
    x = torch.rand(3, dtype=torch.float64, requires_grad=True)
    refuses(RuntimeError, "first derivatives alone", torch.autograd.grad, wrap(jnp.sin)(x).sum(), x, create_graph=True)


@pytest.mark.release
def test_the_last_layer_of_a_policy(arm):
    """A network learns through the step which target gives a velocity."""
    step, q, p = arm
    torch.manual_seed(0)
    layer, network = wrap(lambda q, p: step(q, p)["velocity"]), torch.nn.Linear(7, 3).double()
    q, p = torch.tensor(q), torch.tensor(p)
    wanted = layer(q, p)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-2)
    losses = []
    for _ in range(60):
        loss = (layer(q, network(q)) - wanted).pow(2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.05 * losses[0]
