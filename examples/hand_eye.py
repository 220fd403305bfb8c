"""Hand-eye: where a camera sits on a UR5's tool, from pixels of a board that it saw from 25 configurations."""

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import calibration

jax.config.update("jax_enable_x64", True)

robot = osik.load_robot("ur5")
looking = np.array([0.0, -1.6, 1.6, -1.6, -1.57, 0.0])
focus = 600.0, 600.0, 320.0, 240.0  # fx, fy, cx, cy [pixels]
corners = 0.06 * np.array([(x, y, 0.0) for x in (-1, 1) for y in (-1, 1)])  # on the board [m]
place, board = (0.0, 0.05, 0.04), (0.48, 0.11, -0.3)  # guesses: camera on the tool, board in the world [m]

# what the camera sees: it is 2 cm and 3 degrees off the guess, the board 3 cm; noise of 0.3 pixels
rng = np.random.default_rng(0)
q = np.repeat(looking + rng.uniform(-0.35, 0.35, (25, 6)), 4, 0)
point = np.tile(corners, (25, 1))
position, turn = jax.vmap(lambda q: osik.forward_kinematics(robot, q).frame_pose(robot, "tool0"))(q)
true_place, true_turn = place + np.array([0.012, -0.016, 0.004]), Rotation.from_euler("xyz", [2.0, -1.5, 1.7], True)
world = point + board + np.array([0.02, -0.02, 0.01])
inside = true_turn.inv().apply(np.einsum("nji,nj->ni", turn, world - position) - true_place)
pixels = inside[:, :2] / inside[:, 2:] * focus[:2] + focus[2:] + 0.3 * rng.normal(size=(100, 2))

found = calibration.calibrate(
    robot,
    calibration.Pixels("board", "camera", q, pixels, focus, point=point, sigma=0.3),
    [calibration.Unknown(kind, name) for name in ("camera", "board") for kind in ("frame_position", "frame_rotation")],
    frames={"camera": calibration.FixedFrame("tool0", place), "board": calibration.FixedFrame(position=board)},
)
print(found.explain())
camera = found.frames["camera"]
missed = 1e3 * np.linalg.norm(np.asarray(camera.position) - true_place)
turned = np.degrees((Rotation.from_matrix(np.asarray(camera.rotation)) * true_turn.inv()).magnitude())
print(f"camera {missed:.2f} mm and {turned:.3f} degrees from where it is")
found.figure().savefig("hand_eye.png")
