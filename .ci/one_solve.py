"""Solve one step: what an installation has to do on every system.

The compiled core has to be there, or must not be there: ``python .ci/one_solve.py --without-core``.
"""

import sys

import osik_jax as osik
from osik_jax.core._library import core

assert (core().library is None) == ("--without-core" in sys.argv), core().reason
robot = osik.load_robot("arm7")
step = osik.solve(robot, robot.q0, {"hand": osik.FrameTask(robot, "hand")}, dt=0.01)
assert step.status == osik.Status.SOLVED, step.status
print("one step:", osik.Status(int(step.status)).name, "-", core().reason)
