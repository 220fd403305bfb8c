"""Loads a robot and solves one step: what an installation has to do on every system."""

import osik_jax as osik

robot = osik.load_robot("arm7")
step = osik.solve(robot, robot.q0, {"hand": osik.FrameTask(robot, "hand")}, dt=0.01)
assert step.status == osik.Status.SOLVED, step.status
print("one step:", osik.Status(int(step.status)).name)
