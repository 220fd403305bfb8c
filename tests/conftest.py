"""Shared by all tests: double precision, one seed, compiled programs dropped after each file."""

from collections.abc import Iterator

import jax
import numpy as np
import pytest

import osik_jax

assert osik_jax  # imported before the first computation, as its users do: it sets up XLA's CPU client
jax.config.update("jax_enable_x64", True)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240229)


@pytest.fixture(autouse=True, scope="module")
def forget_programs() -> Iterator[None]:
    """Keeps memory flat: hundreds of compiled programs would stay until the end."""
    yield
    jax.clear_caches()
