"""One file a library: how its users would write the workload. Nothing here loads a library before it is asked for."""

from __future__ import annotations

import importlib
from typing import Any

from ._peer import Peer as Peer
from ._peer import versions as versions

PEERS = {
    "osik_jax": "ours",
    "mink": "with_mink",
    "pink": "with_pink",
    "placo": "with_placo",
    "mjinx": "with_mjinx",
    "mink-warp": "with_mink_warp",
}
"""Names, and the modules here that speak to them."""
BATCHED = frozenset({"osik_jax", "mjinx", "mink-warp"})
"""Those that run many robots in one process. They compile, too, and keep what they compiled."""


def peer(name: str) -> type[Any]:
    """The class that runs a library.

    Raises:
        KeyError: no such peer.
        ImportError: it is not installed.
    """
    if name not in PEERS:
        raise KeyError(f"no peer {name!r}; peers: {', '.join(PEERS)}")
    return importlib.import_module(f".{PEERS[name]}", __name__).Runner
