"""A process that plays a robot for the tests of ``osik ros2``: the arm7 in MuJoCo, its joints in another order.

python ros2_robot.py DOMAIN RATE
"""

import sys
import time

import mujoco
import numpy as np

import osik_jax as osik
from osik_jax.interop.ros2.dds import Endpoints, messages

START = [0.1, -0.6, 0.2, -2.0, 0.1, 1.4, 0.5]


def main(domain: int, rate: float) -> None:
    model = osik.load_robot("arm7").mj_model
    model.opt.timestep = 1.0 / rate / 4
    data = mujoco.MjData(model)
    data.qpos[:] = START
    names = [model.joint(number).name for number in range(model.njnt)]
    endpoints = Endpoints(domain, True)
    states = endpoints.writer("/joint_states", messages.JointState)
    topic = "/joint_trajectory_controller/joint_trajectory"
    commands = endpoints.reader(topic, messages.JointTrajectory, reliable=True)
    wanted, order = np.array(START), list(reversed(range(model.njnt)))
    due = time.monotonic()
    while True:
        for message in commands.take(N=20):
            if isinstance(message, messages.JointTrajectory):
                found = dict(zip(message.joint_names, message.points[0].positions, strict=True))
                wanted = np.array([found[name] for name in names])
        for _ in range(4):
            servo(model, data, wanted)
        stamp = messages.Time(*divmod(time.time_ns(), 1_000_000_000))
        measured = [names[j] for j in order], data.qpos[order].tolist(), data.qvel[order].tolist()
        states.write(messages.JointState(messages.Header(stamp), *measured, []))
        due = max(due + 1.0 / rate, time.monotonic() - 0.1)
        time.sleep(max(0.0, due - time.monotonic()))


def servo(model, data, wanted) -> None:
    """One step of MuJoCo with the model's own position servos, and its weight carried."""
    data.ctrl[:] = wanted
    mujoco.mj_forward(model, data)
    data.qfrc_applied[:] = data.qfrc_bias
    mujoco.mj_step(model, data)


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))
