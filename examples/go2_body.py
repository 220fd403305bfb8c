"""Go2: the body circles and tilts over four feet that stay on the floor."""

import jax
import jax.numpy as jnp
import numpy as np

import osik_jax as osik
from osik_jax import viewer

jax.config.update("jax_enable_x64", True)

bent = {"thigh": 0.8, "calf": -1.6}
bent = {f"{leg}_{joint}_joint": angle for leg in ("FL", "FR", "RL", "RR") for joint, angle in bent.items()}
dog = osik.load_robot("go2", home=bent)
feet = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")

# hard tasks are constraints: the feet, which touch the floor at a point, do not slip
stance = {foot: osik.ContactTask(dog, foot, contact="point", hard=True) for foot in feet}
body = osik.FrameTask(dog, "base", gain=20.0)
position, rotation = body.target


def tasks(t):
    """The tasks at time t [s]: the body's target moves on a circle and leans."""
    grow = jnp.minimum(1.0, t)
    x, y = jnp.cos(2.0 * t), jnp.sin(2.0 * t)
    place = position + grow * jnp.array([0.05 * x, 0.06 * y, -0.04 * (1.0 - x)])
    half_angles = 0.5 * grow * jnp.array([-0.25 * y, 0.15 * x, 0.2 * y])
    turn = jnp.concatenate([jnp.ones(1), half_angles])  # quaternion w x y z, for small angles
    return {**stance, "body": body.replace(target=(place, turn / jnp.linalg.norm(turn)))}


motion = osik.rollout(dog, dog.q0, tasks, steps=700, dt=0.01)


def places(q):
    """Positions of the feet and of the body [m]. (5, 3)."""
    kinematics = osik.forward_kinematics(dog, q)
    return jnp.stack([kinematics.frame_pose(dog, name)[0] for name in (*feet, "base")])


where = jax.vmap(places)(motion.q)
slip = np.linalg.norm(where[:, :4] - where[0, :4], axis=-1).max()
print(f"body moved through a box of {np.round(100 * np.ptp(where[:, 4], axis=0), 1)} cm")
print(f"feet slipped by {1e3 * slip:.3f} mm at most in {len(where) - 1} steps")

viewer.hero_picture(
    "go2_body.png",
    dog,
    [motion.q[k] for k in (0, 400, 550)],
    trails=[where[100:, 4]] * 3,
    azimuth=30.0,
    size=(1400, 480),
)
