"""A hand grasps as a person, beside dex-retargeting if it is installed: python -m benchmarks.hands [--help].

Grasps are made of a hand's bones and angles of its joints: from the open hand to each grasp and back, while the hand is
carried and turned. Fingertips are those of MuJoCo's kinematics of the URDF; the distance is to the person's,
seen from the palm and scaled. dex-retargeting's vector retargeting gets the same vectors from wrist to fingertips.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import re
import tempfile
import time
import warnings
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.retargeting import HumanMotion, Profile, Retargeter, guess_profile
from osik_jax.retargeting._person import palm_axes
from osik_jax.robot.loading import example_urdf
from osik_jax.runtime import configure_cpu

BONES = dict(thumb=(0.045, 0.035, 0.028), index=(0.043, 0.025, 0.022), middle=(0.046, 0.029, 0.023),
             ring=(0.042, 0.027, 0.023), little=(0.033, 0.02, 0.02))  # fmt: skip
KNUCKLES = dict(thumb=(0.015, 0.03, 0.03), index=(0.0, 0.027, 0.092), middle=(0.0, 0.004, 0.094),
                ring=(0.0, -0.017, 0.088), little=(0.0, -0.036, 0.08))  # fmt: skip
"""Lengths from the knuckle to the tip, and places of the knuckles beside the wrist [m]: fingers along z, palm to x."""
OPEN = dict.fromkeys(("index", "middle", "ring", "little"), (0.1, 0.1, 0.05)) | {"thumb": (0.4, 0.6, 0.3, 0.3)}
GRASPS = {
    "cylinder": dict.fromkeys(("index", "middle", "ring", "little"), (0.8, 0.9, 0.5)) | {"thumb": (0.8, 0.4, 0.4, 0.4)},
    "sphere": dict.fromkeys(("index", "middle", "ring", "little"), (0.5, 0.7, 0.5)) | {"thumb": (0.7, 0.5, 0.3, 0.3)},
    "point": {**dict.fromkeys(("middle", "ring", "little"), (1.2, 1.3, 0.8)), "index": (0.0, 0.05, 0.05),
              "thumb": (1.0, 0.5, 0.5, 0.4)},
    "key": dict.fromkeys(("index", "middle", "ring", "little"), (1.0, 0.9, 0.6)) | {"thumb": (0.2, 0.3, 0.2, 0.2)},
    "wave": {"index": (0.2, 0.3, 0.2), "middle": (0.5, 0.6, 0.4), "ring": (0.8, 0.9, 0.6), "little": (1.1, 1.1, 0.7),
             "thumb": (0.5, 0.4, 0.2, 0.2)},
}  # fmt: skip
"""Bends of each finger from the knuckle outwards; of the thumb first its opposition [rad]."""
FRAMES = 40


def hand(bends: dict[str, tuple[float, ...]]) -> dict[str, np.ndarray]:
    """The 21 keypoints of a bent hand [m]. (3,) each."""
    points = {"wrist": np.zeros(3)}
    for finger, lengths in BONES.items():
        at, angle, angles = np.array(KNUCKLES[finger]), 0.0, bends[finger]
        along, towards = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
        if finger == "thumb":
            along = np.array([np.sin(angles[0]), 0.8 * np.cos(angles[0]), 0.6])
            along /= np.linalg.norm(along)
            towards = np.array([0.5, -0.7, 0.5]) - np.array([0.5, -0.7, 0.5]) @ along * along
            towards, angles = towards / np.linalg.norm(towards), angles[1:]
        points[f"{finger}_1"] = at
        for joint, (length, bend) in enumerate(zip(lengths, angles, strict=True), 2):
            angle += bend
            at = at + length * (np.cos(angle) * along + np.sin(angle) * towards)
            points[f"{finger}_{joint}"] = at
    return points


def grasps(fps: float = 30.0) -> list[HumanMotion]:
    """A clip of each grasp."""
    share = 0.5 - 0.5 * np.cos(np.linspace(0.0, 2.0 * np.pi, FRAMES))[:, None, None]
    turns = Rotation.from_euler("xyz", np.linspace([0.0, 0.0, 0.0], [0.5, 0.8, 1.2], FRAMES)).as_matrix()
    path = np.linspace([0.0, 0.0, 1.0], [0.3, 0.1, 1.2], FRAMES)[:, None]
    out, first = [], hand(OPEN)
    for name, bends in GRASPS.items():
        start, end = (np.array([*points.values()]) for points in (first, hand(bends)))
        positions = np.einsum("fij,fkj->fki", turns, start + share * (end - start)) + path
        out.append(HumanMotion(name, fps, tuple(first), positions))
    return out


class Fingertips:
    """A URDF's fingertips and wrist by MuJoCo's kinematics, for the joints of ``names`` in turn."""

    def __init__(self, urdf: str, profile: Profile):
        spec = mujoco.MjSpec.from_string(urdf)
        spec.compiler.fusestatic, spec.compiler.boundmass, spec.compiler.boundinertia = False, 1e-6, 1e-9
        self.model, self.profile = spec.compile(), profile
        self.data = mujoco.MjData(self.model)
        self.tips = [role for role in profile.keypoints if role.endswith("_4")]

    def at(self, names: list[str], q: np.ndarray) -> np.ndarray:
        """Vectors from the wrist to the tips [m]. (F, tips, 3)."""
        address, out = [self.model.joint(name).qposadr[0] for name in names], []
        for own in q:
            self.data.qpos[address] = own
            mujoco.mj_kinematics(self.model, self.data)
            places = []
            for role in ("wrist", *self.tips):
                frame, point = self.profile.keypoints[role]
                places.append(self.data.body(frame).xpos + self.data.body(frame).xmat.reshape(3, 3) @ point)
            out.append(np.array(places[1:]) - places[0])
        return np.array(out)


def peer(urdf: str, profile: Profile, vectors: np.ndarray, scale: float) -> tuple[list[str], np.ndarray, float]:
    """Joint names, motion and seconds a frame of dex-retargeting for vectors from wrist to tips. (F, tips, 3)."""
    from dex_retargeting.retargeting_config import RetargetingConfig  # pyright: ignore[reportMissingImports]

    frame, point = profile.keypoints["wrist"]
    text = urdf.replace(
        "</robot>",
        f'<link name="person_wrist"/><joint name="person_wrist_fixed" type="fixed"><parent link="{frame}"/><child '
        f'link="person_wrist"/><origin xyz="{" ".join(map(str, point))}" rpy="0 0 0"/></joint></robot>',
    )
    path = Path(tempfile.mkdtemp()) / "hand.urdf"
    path.write_text(text, encoding="utf-8")
    tips = [profile.keypoints[role][0] for role in profile.keypoints if role.endswith("_4")]
    count = len(tips)
    leaders = [
        str(joint.get("name"))
        for joint in ElementTree.fromstring(urdf).findall("joint")
        if joint.get("type") in ("revolute", "prismatic") and joint.find("mimic") is None
    ]
    made = RetargetingConfig(
        type="vector", urdf_path=str(path), target_joint_names=leaders,
        target_origin_link_names=["person_wrist"] * count,
        target_task_link_names=tips, target_link_human_indices=np.array([[0] * count, range(1, count + 1)]),
        scaling_factor=scale, low_pass_alpha=1.0,
    ).build()  # fmt: skip
    began = time.process_time()
    q = np.array([made.retarget(own) for own in vectors])
    return list(made.joint_names), q, (time.process_time() - began) / len(vectors)


def speeds_of(urdf: str, joints: list[str]) -> np.ndarray:
    """Greatest speeds of joints by the text of a URDF [rad/s]."""
    limits = {str(joint.get("name")): joint.find("limit") for joint in ElementTree.fromstring(urdf).findall("joint")}
    found = [np.inf if (own := limits[name]) is None else float(own.get("velocity", "inf")) for name in joints]
    return np.array([speed if speed > 0.0 else np.inf for speed in found])


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", nargs="?", default="allegro", help="a hand by name, or a URDF")
    parser.add_argument("--fps", type=float, default=30.0, help="frames a second: a grasp takes 40, less is slower")
    parser.add_argument("--left", action="store_true", help="the hand is a left one")
    options = parser.parse_args()
    configure_cpu()
    jax.config.update("jax_enable_x64", True)
    file = Path(options.robot) if options.robot.endswith(".urdf") else example_urdf(options.robot)
    urdf = re.sub(r"<(visual|collision|inertial)\b.*?</\1>", "", file.read_text(encoding="utf-8"), flags=re.S)
    robot = osik.Robot.from_urdf(file, floating_base=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", osik.OsikWarning)
        profile = guess_profile(robot)
    own, tips = Retargeter(robot, profile=profile), Fingertips(urdf, profile)
    rows: dict[str, list[tuple[np.ndarray, float, float, float]]] = {"osik-jax": []}
    for motion in grasps(options.fps):
        if options.left:
            motion = dataclasses.replace(motion, positions=motion.positions * [1.0, -1.0, 1.0])
        scale = own._build.scale(own._prepared(motion, None, None).person)
        points = {name: motion.positions[:, k] for k, name in enumerate(motion.joint_names)}
        turn = own._build.facing @ np.swapaxes(palm_axes(points), 1, 2)
        seen = np.stack([np.einsum("fij,fj->fi", turn, points[tip] - points["wrist"]) for tip in tips.tips], 1)
        own.retarget(motion)
        began = time.process_time()
        result = own.retarget(motion)
        spent = (time.process_time() - began) / motion.frames
        motions = {"osik-jax": (list(result.motion.joint_names), result.motion.qpos, spent)}
        if importlib.util.find_spec("dex_retargeting") is not None:
            motions["dex-retargeting"] = peer(urdf, profile, seen, scale)
        for name, (joints, q, seconds) in motions.items():
            off = 1e3 * np.linalg.norm(tips.at(joints, q) - scale * seen, axis=-1)
            low, high = np.array([tips.model.joint(joint).range for joint in joints]).T
            fast = float((np.abs(np.diff(q, axis=0)) * options.fps / speeds_of(urdf, joints)).max())
            over = max(0.0, float((low - q).max()), float((q - high).max()))
            rows.setdefault(name, []).append((off, over, fast, seconds))
    fingers = [k for k, tip in enumerate(tips.tips) if not tip.startswith("thumb")]
    print(
        f"| | {', '.join(GRASPS)}: fingers at the grasp [mm] | all tips, all frames [mm] | worst [mm] "
        "| beyond [rad] | speed [of the limit] | ms a frame |"
    )
    print("|---" * 7 + "|")
    for name, found in rows.items():
        middle = ", ".join(f"{off[FRAMES // 2, fingers].mean():.1f}" for off, *_ in found)
        off, (over, fast) = np.array([one[0] for one in found]), np.max([one[1:3] for one in found], 0)
        spent = 1e3 * np.mean([seconds for *_, seconds in found])
        print(f"| {name} | {middle} | {off.mean():.1f} | {off.max():.1f} | {over:.3f} | {fast:.2f} | {spent:.2f} |")


if __name__ == "__main__":
    main()
