"""NAO: shifts its weight onto one foot, lifts the other, and keeps its balance."""

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)

nao = osik.load_robot("nao")
both = osik.support_polygon(nao, nao.q0, ("l_sole", "r_sole"), margin=0.01)
one = osik.support_polygon(nao, nao.q0, ("l_sole",), margin=0.01)
left = osik.FrameTask(nao, "l_sole", priority=1)
right = osik.FrameTask(nao, "r_sole", priority=1, gain=20.0)
com = osik.ComTask(nao, axes="xy", priority=2, gain=3.0)
arms = osik.PostureTask(nao, joints=("*ShoulderRoll",), priority=3, gain=2.0)
posture = osik.PostureTask(nao, priority=4)
foot, level = right.target
over_left = one.vertices.mean(0)  # a point of the floor, in the middle of the left sole
spread = nao.configuration({"LShoulderRoll": 1.2, "RShoulderRoll": -1.2})


def tasks(t):
    """First the weight, then from the second second on the foot and the arms."""
    lift = jnp.clip((t - 2.0) / 2.0, 0.0, 1.0)
    up = foot + lift * jnp.array([0.0, -0.03, 0.07])
    return {
        "left": left,
        "right": right.replace(target=(up, level)),
        "weight": com.replace(target=over_left),
        "arms": arms.replace(target=nao.q0 + lift * (spread - nao.q0)),
        "posture": posture,
    }


motion = osik.rollout(nao, nao.q0, tasks, scheme=osik.HierarchicalQP(), steps=1000, dt=0.005)
points = jax.vmap(lambda q: osik.center_of_mass(nao, osik.forward_kinematics(nao, q)))(motion.q)
raised = jax.vmap(lambda q: osik.forward_kinematics(nao, q).frame_pose(nao, "r_sole")[0][2])(motion.q)
air = np.flatnonzero(raised > raised[0] + 1e-4)
print(f"the foot leaves the floor at {air[0] * 0.005:.2f} s and ends {100 * (raised[-1] - raised[0]):.1f} cm above it")
inside = 1e3 * both.distance(points[: air[0], :2]).min(), 1e3 * one.distance(points[air, :2]).min()
print(f"until then the centre of mass is at least {inside[0]:.1f} mm inside the polygon of both feet,")
print(f"and from then on {inside[1]:.1f} mm inside that of the left foot")

viewer.hero_picture(
    "nao_one_foot.png",
    nao,
    [motion.q[k] for k in (0, 400, 600, 1000)],
    support=[both.vertices, both.vertices, one.vertices, one.vertices],
    labels=["start", "2 s", "3 s", "5 s"],
    size=(1400, 480),
)
