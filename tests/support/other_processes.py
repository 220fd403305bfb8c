"""Python programs beside the tests."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
DEVICES = "--xla_force_host_platform_device_count"


def start(script: str, *args: Any, devices: int = 1) -> subprocess.Popen[str]:
    """A Python program beside the tests, with so many CPU devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {DEVICES}={devices}"
    env = os.environ | {
        "XLA_FLAGS": flags,
        "PJRT_NPROC": str(8 * devices),  # devices of one process share their workers
        "JAX_ENABLE_X64": "1",
        "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path]),
    }
    command = [sys.executable, "-c", script, *map(str, args)]
    return subprocess.Popen(command, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def finish(process: subprocess.Popen[str]) -> Any:
    """What the program printed last, as JSON."""
    try:
        out, errors = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    return json.loads(out.splitlines()[-1])


def free_port() -> int:
    """A port of this machine that no program listens on."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]
