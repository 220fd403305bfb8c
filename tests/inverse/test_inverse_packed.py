"""Numbers that travel to and from a device as one array."""

import jax
import jax.numpy as jnp
import numpy as np

from osik_jax.inverse._packed import packed, unpacked


def test_a_pytree_comes_back_from_the_host_and_from_a_program(rng):
    device = jnp.arange(3.0)
    tree = {
        "doubles": rng.standard_normal((2, 3)),
        "singles": rng.standard_normal((4, 1)).astype(np.float32).T,
        "flags": np.array([True, False, True]),
        "short": (np.array([-3, 5], np.int8), np.array([0.5, -2.0, 1.0], np.float16)),
        "none": np.zeros((0, 7)),
        "number": (7, np.int32(-3), np.uint32(2**32 - 1), np.float32(-0.5)),
        "device": device,
        "nothing": None,
    }
    tree["doubles"][0, 0], tree["singles"][0, 0] = np.nan, -np.inf
    sent = packed(tree)
    assert len(jax.tree.leaves(sent)) == 2 and sent.apart[0] is device
    inside = jax.jit(lambda given: packed(unpacked(given)))(sent)
    assert len(jax.tree.leaves(inside)) == 1
    for back in (unpacked(sent), unpacked(jax.device_get(inside))):
        assert jax.tree.structure(back) == jax.tree.structure(tree)
        for found, expected in zip(jax.tree.leaves(back), jax.tree.leaves(tree), strict=True):
            np.testing.assert_array_equal(found, expected)
            assert found.dtype == jnp.result_type(expected)
