"""How regular the control loop of a live view is, with a visitor connected: python -m benchmarks.live [--robot g1].

Leads both hands along circles that leave the reach, for a minute; prints periods, step times, what broke a limit and
how the memory grew. A visitor is a websocket, in a process of its own, that reads all that the page sends. Beside it a
loop runs that only sleeps.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import osik_jax as osik
from osik_jax.cli import read_robot
from osik_jax.robot._guesses import guess_feet
from osik_jax.runtime import configure_cpu
from osik_jax.viewer.live import _open
from osik_jax.viewer.live._loop import Stopwatch
from osik_jax.viewer.live._open import find_hands
from osik_jax.viewer.live._page import LiveView

_IDLE = """
import json, sys, time
import numpy as np
dt, seconds = map(float, sys.argv[1:])
starts, begin = [], time.perf_counter()
deadline = begin
while deadline - begin < seconds:
    starts.append(time.perf_counter())
    deadline += dt
    time.sleep(max(deadline - time.perf_counter(), 0.0))
    deadline = max(deadline, time.perf_counter() - 5.0 * dt)
print(json.dumps(np.percentile(np.diff(starts), (50.0, 99.0, 100.0)).tolist()))
"""
"""A loop of the same rate that does nothing, in a process of its own: what the machine alone makes of the periods."""


def idle(dt: float, seconds: float) -> subprocess.Popen[str]:
    """Starts that loop."""
    return subprocess.Popen([sys.executable, "-c", _IDLE, str(dt), str(seconds)], stdout=subprocess.PIPE, text=True)


_VISITOR = """
import asyncio, sys
from websockets.asyncio.client import connect

async def read(url, protocol):
    size = 0
    async with connect(url, subprotocols=[protocol], max_size=None) as socket:
        print("here", flush=True)
        end = asyncio.get_running_loop().run_in_executor(None, sys.stdin.readline)
        while not end.done():
            try:
                size += len(await asyncio.wait_for(socket.recv(), 0.5))
            except TimeoutError:
                continue
    print(size)

asyncio.run(read(*sys.argv[1:]))
"""
"""Reads what the page sends until it is told to end; a process of its own, as browsers are."""


def visit(url: str) -> subprocess.Popen[str]:
    """Starts a visitor; returns once it is connected."""
    import viser

    arguments = [url.replace("http", "ws"), f"viser-v{viser.__version__}"]
    visitor = subprocess.Popen(
        [sys.executable, "-c", _VISITOR, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert visitor.stdout is not None and visitor.stdout.readline() == "here\n", "the visitor did not get in"
    return visitor


def lead(view: LiveView, robot: osik.Robot, seconds: float, radius: float) -> None:
    """Leads the hands in circles at 30 targets a second."""
    tasks: Any = view.session.tasks
    hands = {hand: tasks[hand].target for hand in find_hands(robot)}
    start = time.monotonic()
    while (now := time.monotonic() - start) < seconds:
        for side, (hand, (position, rotation)) in zip((1.0, -1.0), hands.items(), strict=False):
            angle = 1.5 * now * side
            view.aim(hand, (position + radius * np.array([np.sin(angle), 0.0, 1.0 - np.cos(angle)]), rotation))
        time.sleep(1.0 / 30.0)


def broken(robot: osik.Robot, q: np.ndarray, dt: float) -> dict[str, int]:
    """Steps in which a joint moves further than its speed allows, and configurations outside the ranges."""
    limited = [robot.joint_dof_index(name) for name in robot.joint_names]
    place = [robot.joint_qpos_index(name) for name in robot.joint_names]
    top, lower, upper = (
        np.asarray(part)[limited] for part in (robot.velocity_limit, robot.position_lower, robot.position_upper)
    )
    fast = np.abs(np.diff(q[:, place], axis=0)) > top * dt * (1.0 + 1e-9)
    outside = (q[:, place] < lower) | (q[:, place] > upper)
    return dict(too_fast=int(fast.any(1).sum()), outside=int(outside.any(1).sum()))


def recorded(view: LiveView) -> list[np.ndarray]:
    """Return a list that gets the configuration of each step from now on."""
    path: list[np.ndarray] = []
    step = view.loop._step

    def kept(own: Any) -> None:
        step(own)
        path.append(view.loop.snapshot.q)

    view.loop._step = kept
    return path


def resident() -> float:
    """Memory of this process [MB], on Linux."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 2**20


def measure(name: str, seconds: float) -> dict[str, object]:
    """One session."""
    robot = read_robot(name)
    feet = guess_feet(robot)
    load = os.getloadavg()[0]
    with _open.open_robot(robot, name, feet, host="127.0.0.1", port=0) as view:
        view.loop.wait_until_ready(300.0)
        visitor = visit(view.url)
        time.sleep(5.0)
        view.loop.pause()
        path = recorded(view)
        view.loop._stopwatch = Stopwatch(round(seconds / view.loop.dt))
        before = resident()
        beside = idle(view.loop.dt, seconds)
        view.loop.resume()
        lead(view, robot, seconds, radius=0.35 if robot.floating_base else 0.2)
        timing, failures = view.loop.timing, view.loop.snapshot.failures
        after, q, dt = resident(), np.array(path), view.loop.dt
        nothing = json.loads(beside.communicate()[0])
        read = int(visitor.communicate("end\n")[0])
    return {
        "robot": name,
        "seconds": seconds,
        "steps": timing.steps,
        "period p50, p99, max of the whole session [ms]": [round(1e3 * x, 2) for x in timing.period],
        "step p50, p99, max of the whole session [ms]": [round(1e3 * x, 2) for x in timing.step],
        "period of a loop beside it that does nothing [ms]": [round(1e3 * x, 2) for x in nothing],
        "failures": failures,
        **broken(robot, q, dt),
        "memory grew by [MB]": round(after - before, 1),
        "of which the recording has [MB]": round(q.nbytes / 2**20, 1),
        "visitor read [MB]": round(read / 2**20, 1),
        "load average before": round(load, 2),
        "cores": os.cpu_count(),
        "jax": jax.__version__,
    }


def main() -> None:
    """Prints one line of JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--robot", default="nao")
    parser.add_argument("--seconds", type=float, default=60.0)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    json.dump(measure(given.robot, given.seconds), sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    configure_cpu()
    main()
