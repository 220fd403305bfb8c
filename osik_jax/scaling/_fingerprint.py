"""Fingerprint of a job's inputs, which tells whether an interrupted job may go on."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..batching._names import leaf_names


def fingerprint(tree: Any) -> dict[str, str]:
    """Return kind, shape and a hash of each array of a pytree, by name; and of its structure, under "structure"."""
    found = {name or "it": _described(leaf) for name, leaf in zip(leaf_names(tree), jax.tree.leaves(tree), strict=True)}
    structure = re.sub(r"0x[0-9a-f]+", "", str(jax.tree.structure(tree)))  # less addresses of objects
    return found | {"structure": _digest(structure.encode())}


def identifier(manifest: Mapping[str, Any]) -> str:
    """Return a hash of a manifest."""
    return _digest(json.dumps(manifest, sort_keys=True).encode())


def _described(leaf: Any) -> str:
    kind = getattr(leaf, "dtype", None)
    keys = kind is not None and jnp.issubdtype(kind, jax.dtypes.prng_key)
    array = np.asarray(jax.random.key_data(leaf) if keys else leaf)
    shape = "x".join(str(n) for n in array.shape) or "scalar"
    return f"{kind if keys else array.dtype} {shape} {_digest(np.ascontiguousarray(array).reshape(-1).view(np.uint8))}"


def _digest(data: Any) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def differences(old: Any, new: Any, name: str = "") -> list[str]:
    """Return the differences of two manifests, one line each."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        keys = [*old, *(key for key in new if key not in old)]
        return [line for key in keys for line in differences(old.get(key), new.get(key), f"{name}.{key}".lstrip("."))]
    return [] if old == new else [f"{name} was {_shown(old)}, is {_shown(new)}"]


def _shown(value: Any) -> str:
    return "absent" if value is None else str(value)
