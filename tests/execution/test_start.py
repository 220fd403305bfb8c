"""The start of a program: what an import loads, and that XLA compiles nothing while robots and tasks are made."""

from __future__ import annotations

from model_files import MJCF
from other_processes import finish, start

SCRIPT = """
import json, sys, warnings
import jax, numpy as np
import osik_jax as osik
heavy = "mujoco.mjx", "scipy.spatial", "optax", "matplotlib", "tyro", "rich"
heavy += "osik_jax.viewer", "osik_jax.demo", "osik_jax.cli"
loaded = [name for name in heavy if name in sys.modules]
import osik_jax.viewer
loaded += [name for name in ("matplotlib.pyplot",) if name in sys.modules]
from every_class import all_limits, all_tasks

warnings.simplefilter("ignore")
compiled = []
jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: compiled.append(event))
programs = lambda: sum("backend_compile" in event for event in compiled)
counts, started = {}, programs()
def count(what):
    global started
    counts[what], started = programs() - started, programs()

for name in ("nao", "arm7", "ur5", "panda", "g1"):
    robot = osik.load_robot(name)
    frame = robot.frame_names[-1]
    pose = np.array([0.2, 0.1, 0.3]), np.array([0.0, 0.71, 0.71, 0.0])
    osik.FrameTask(robot, frame, target=pose)
    osik.ComTask(robot, target=[0.0, 0.0, 0.3])
    osik.LookAtTask(robot, frame), osik.AxisAlignTask(robot, frame)
    osik.PostureTask(robot, target=np.asarray(robot.q0)).replace(weight=2.0, gain=3)
    osik.FrameTask(robot, frame, rows="position").replace(target=[0.3, 0.1, 0.2])
    count(name)
for path in sys.argv[1:]:
    robot = osik.Robot.from_mjcf(path)
    osik.FrameTask(robot, robot.frame_names[-1]), osik.ComTask(robot), osik.PostureTask(robot)
    if "equalities" in path or "loop" in path:
        osik.EqualityConstraintTask(robot)
    count(path)
nao = osik.load_robot("nao")
polygon = osik.support_polygon(nao, nao.q0, ["l_sole", "r_sole"])
osik.ComTask(nao, polygon=polygon), osik.FloatingBaseVelocityLimit(nao, linear=1.0)
count("a polygon")
arm = osik.load_robot("arm7")
all_tasks(arm), all_limits(arm)
count("every class")
arm.with_home({"joint1": 0.3}), arm.with_home(np.asarray(arm.q0) + 0.1), arm.configuration({"joint2": 0.4})
count("configurations")
osik.WeightedQP(), osik.HierarchicalQP(damping=1e-3), osik.NullSpace()
count("schemes")
osik.forward_kinematics(arm, arm.q0)
count("a program")
print(json.dumps([loaded, counts]))
"""


def test_nothing_is_compiled_while_robots_and_tasks_are_made():
    """MJX loads trimesh and networkx, a third of the time; one program takes XLA 5 to 800 ms."""
    files = [MJCF / f"{name}.xml" for name in ("manifold", "joints_of_one_body", "cart_with_a_loop", "equalities")]
    loaded, counts = finish(start(SCRIPT, *files))
    assert loaded == []
    assert counts.pop("a program") > 0  # compilations are seen
    assert counts == dict.fromkeys(counts, 0)
