"""Robots whose frames hinges and slides carry, for tests of searches for poses."""

import osik_jax as osik

TREE = """<mujoco><compiler angle="radian"/><worldbody>
<body><joint name="lift" type="slide" axis="0 0.6 0.8" range="-1 1"/><geom size="0.1"/>
<body pos="0 0 0.3"><joint name="turn" axis="0 1 1" pos="0.1 0 0" range="-2 2"/><joint name="stiff" axis="1 0 0"/>
<geom size="0.1"/>
<body pos="0.3 0 0" euler="0.2 0.3 0.5"><joint name="one" axis="0 1 0" range="-1 2"/><geom size="0.1"/>
<site name="a" pos="0.2 0 0.1"/></body>
<body pos="-0.3 0 0"><joint name="two" axis="0 1 0" range="-2 2"/><geom size="0.1"/>
<site name="b" pos="0 0.2 0" euler="0 1.5 0"/></body></body></body></worldbody>
<equality><joint joint1="two" joint2="one" polycoef="0.2 -1.5 0 0 0"/></equality></mujoco>"""
"""A tree with a slide, two joints of one body, of which one is locked, and a joint that follows another."""


def made(name: str) -> tuple[osik.Robot, dict[str, tuple[bool, ...]]]:
    """A robot, and of some of its frames the rows that count."""
    pose, position = (True,) * 6, (True,) * 3 + (False,) * 3
    if name == "tree":
        robot = osik.Robot.from_mjcf(TREE, locked_joints={"stiff": 0.4})
        return robot, {"a": (False, True, True, True, False, True), "b": position}
    robot = osik.load_robot(name)
    return robot, {robot.frame_names[-1]: pose} if name == "arm7" else {"l_gripper": pose, "r_gripper": position}
