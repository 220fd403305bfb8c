"""Clips retargeted to robots of all shapes, and judged from their files: python -m benchmarks.shapes CLIP... [--help].

    python -m benchmarks.shapes clips/*.bvh --dogs dogs/*.npz --robots g1 nao talos h1.urdf baxter:fixed go2 allegro

A robot is a name of ``load_robot`` or ``robots_table``, or a file; ``:fixed`` behind it fixes its base. Profiles are
bundled or guessed. Each robot takes the clips of people (robots on four feet those of ``--dogs``, hands the grasps of
``benchmarks.hands``). The judge reads the motion that was written: ranges and speeds from the text of the URDF, poses
from MuJoCo C's kinematics of that file, overlaps of the profile's capsules from MuJoCo's collision detection. The
kinematics of this library take no part. The exit code is 1 if a bar of ``FIGURES`` is not met.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import jax
import mujoco
import numpy as np

import osik_jax as osik
from osik_jax.retargeting import HumanMotion, Profile, Retargeted, Retargeter, load_motion
from osik_jax.robot.loading import example_urdf
from osik_jax.robot.loading._named import EXAMPLES
from osik_jax.runtime import configure_cpu

from .data_file import write_csv
from .hands import grasps
from .robots_table import ROBOTS as TESTED
from .robots_table import file_of

JUMP = 15.0
"""A change of joint speed from one frame to the next that is a jump [rad/s]."""
APART = 3
"""Joints between two links, at least, where their shapes are kept apart."""
FIGURES = {
    "over": ("rad or m", 3, 1e-9),
    "speed": ("of the limit", 3, 1.0 + 1e-6),
    "jumps": ("frames", 0, 0.0),
    "slip": ("mm", 2, 0.5),
    "float": ("mm", 2, 0.5),
    "below": ("mm", 2, 0.5),
    "overlap": ("mm", 2, 1.0),
    "angle": ("deg", 1, np.inf),
}
"""Unit, digits and bar of what is judged: beyond ranges, speed over its limit, frames with a jump, slip of standing
points, their height, soles below the floor, overlap of capsules, and the mean angle between segments.
"""


class Source(NamedTuple):
    """A robot's file, and whether its base moves freely; None: as the file says."""

    name: str
    file: Path
    free: bool | None


def source_of(text: str) -> Source:
    """The file of a robot by name or path."""
    name, _, fixed = text.partition(":")
    if name in EXAMPLES:
        return Source(name, example_urdf(name), False if fixed else EXAMPLES[name][1])
    if name in TESTED and TESTED[name][0]:
        return Source(name, file_of(name), False if fixed else TESTED[name][1])
    embedded = Path(str(resources.files("osik_jax") / "robot" / "models" / f"{name}.xml"))
    return Source(Path(name).stem, embedded if embedded.is_file() else Path(name), False if fixed else None)


def robot_of(source: Source) -> osik.Robot:
    """The robot; a URDF's base floats unless it says otherwise."""
    if source.file.suffix == ".xml":
        return osik.Robot.from_mjcf(source.file, floating_base=source.free)
    return osik.Robot.from_urdf(source.file, floating_base=source.free is not False)


class Judge:
    """MuJoCo C's model of a robot's file with a profile's capsules as its shapes, and the file's limits."""

    def __init__(self, source: Source, profile: Profile, free: bool):
        urdf = source.file.suffix == ".urdf"
        spec = _urdf_spec(source.file) if urdf else mujoco.MjSpec.from_file(str(source.file))
        if urdf and free:
            spec.worldbody.first_body().add_freejoint(name="root")
        for geom in list(spec.geoms):
            spec.delete(geom)
        for capsule in profile.capsules:
            spec.body(capsule.frame).add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=[*capsule.start, *capsule.end],
                size=[capsule.radius, 0.0, 0.0],
                mass=0.0,
            )
        self.model, self.profile = spec.compile(), profile
        self.data = mujoco.MjData(self.model)
        self.limits = _urdf_limits(source.file) if urdf else _model_limits(self.model)
        self.bodies = {self.model.body(b).name: b for b in range(self.model.nbody)}
        self.sites = {self.model.site(s).name: s for s in range(self.model.nsite)}

    def place(self, frame: str, point: Sequence[float]) -> np.ndarray:
        """A point of a body or site in the world [m]."""
        if frame in self.bodies:
            at = self.data.body(frame)
            return at.xpos + at.xmat.reshape(3, 3) @ point
        site = self.data.site(frame)
        return site.xpos + site.xmat.reshape(3, 3) @ point

    def figures(self, result: Retargeted) -> dict[str, float | None]:
        """Return the figures of ``FIGURES`` from the written motion; None where the robot has no such part."""
        with tempfile.TemporaryDirectory() as folder:
            result.save(Path(folder) / "motion.npz")
            with np.load(Path(folder) / "motion.npz") as file:
                clip = {name: file[name] for name in file.files}
        names, fps = [str(name) for name in clip["joint_names"]], float(clip["fps"])
        base = clip["qpos"].shape[1] - len(names)
        out = self._joints(names, clip["qpos"][:, base:], fps)
        address = [*range(base), *(self.model.joint(name).qposadr[0] for name in names)]
        self.data.qpos[:] = self.model.qpos0
        self.data.qpos[:base] = [0.0, 0.0, 10.0, 1.0, 0.0, 0.0, 0.0][:base]
        mujoco.mj_forward(self.model, self.data)
        at_rest = set(self._overlaps())
        human = {str(name): clip["human"][:, k] for k, name in enumerate(clip["human_names"])}
        deepest, corners, angles = 0.0, [], []
        for frame, qpos in enumerate(clip["qpos"]):
            self.data.qpos[address] = qpos
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_collision(self.model, self.data)
            deepest = max([deepest, *(depth for pair, depth in self._overlaps().items() if pair not in at_rest)])
            corners.append(self._corners())
            angles.append([self._angle(limb, human, frame) for limb in self.profile.followed])
        out |= {"overlap": 1e3 * deepest, "angle": float(np.mean(angles))}
        return out | self._feet(np.array(corners), clip["contact"].astype(bool), base > 0)

    def _joints(self, names: list[str], q: np.ndarray, fps: float) -> dict[str, float | None]:
        known = [k for k, name in enumerate(names) if name in self.limits]
        low, high, fast = np.array([self.limits[names[k]] for k in known]).T
        speed = np.diff(q[:, known], axis=0) * fps
        jumps = (np.abs(np.diff(speed, axis=0)) > JUMP).any(1)
        over = np.maximum(low - q[:, known], q[:, known] - high).max()
        return {
            "over": max(float(over), 0.0),
            "speed": float((np.abs(speed) / fast).max()),
            "jumps": float(jumps.sum()),
        }

    def _overlaps(self) -> dict[tuple[int, int], float]:
        """Depth [m] by pair of bodies with ``APART`` joints or more between them."""
        out: dict[tuple[int, int], float] = {}
        for contact in (self.data.contact[k] for k in range(self.data.ncon)):
            a, b = sorted(int(self.model.body_weldid[self.model.geom_bodyid[geom]]) for geom in contact.geom)
            if contact.dist < 0.0 and a != b and self._joints_between(a, b) >= APART:
                out[a, b] = max(out.get((a, b), 0.0), -float(contact.dist))
        return out

    def _joints_between(self, a: int, b: int) -> int:
        def above(body: int) -> list[int]:
            return [body, *(above(int(self.model.body_weldid[self.model.body_parentid[body]])) if body else [])]

        first, second = above(a), above(b)
        common = next(body for body in first if body in second)
        return first.index(common) + second.index(common)

    def _corners(self) -> np.ndarray:
        """Lowest points of the soles' corners: heel and toe of two feet, all of one on four. (4, corners, 3)."""
        rows, feet = [], self.profile.feet
        for foot in (feet[name] for name in sorted(feet)):
            down = np.array([0.0, 0.0, foot.radius])
            heel, toe = ([self.place(foot.frame, p) - down for p in part] for part in (foot.heel, foot.toe))
            rows += [heel, toe] if len(feet) == 2 else [[*heel, *toe]]
        return np.array(rows)

    def _angle(self, limb: tuple[str, str], human: dict[str, np.ndarray], frame: int) -> float:
        """Angle between a person's segment and the robot's [deg]."""
        wanted = human[limb[1]][frame] - human[limb[0]][frame]
        first, second = (self.place(*self.profile.keypoints[role]) for role in limb)
        across = np.linalg.norm(np.cross(wanted, second - first))
        return float(np.degrees(np.arctan2(across, wanted @ (second - first))))

    def _feet(self, corners: np.ndarray, contact: np.ndarray, free: bool) -> dict[str, float | None]:
        if not (self.profile.feet and free):
            return {"slip": None, "float": None, "below": None}
        points, slip = corners.mean(2), 0.0
        for k in range(4):
            landed = None
            for frame in range(len(points)):
                landed = None if not contact[frame, k] else points[frame, k, :2] if landed is None else landed
                slip = slip if landed is None else max(slip, float(np.linalg.norm(points[frame, k, :2] - landed)))
        height = points[..., 2][contact].max(initial=0.0)
        below = max(-float(corners[..., 2].min()), 0.0)
        return {"slip": None if self.profile.rolls else 1e3 * slip, "float": 1e3 * height, "below": 1e3 * below}


def _urdf_spec(file: Path) -> mujoco.MjSpec:
    """A spec of a URDF's links and joints; shapes and masses are left out."""
    root = ElementTree.parse(file).getroot()
    for link in root.findall("link"):
        for element in [*link.findall("visual"), *link.findall("collision"), *link.findall("inertial")]:
            link.remove(element)
    for old in root.findall("mujoco"):
        root.remove(old)
    options = {"fusestatic": "false", "boundmass": "1e-6", "boundinertia": "1e-9"}
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", options)
    return mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))


def _urdf_limits(file: Path) -> dict[str, tuple[float, float, float]]:
    """Lower, upper and greatest speed of each joint that has a range."""
    out = {}
    for joint in ElementTree.parse(file).getroot().findall("joint"):
        limit = joint.find("limit")
        if limit is not None and joint.get("type") in ("revolute", "prismatic"):
            low, high, fast = (float(limit.get(key, default)) for key, default in
                               (("lower", "-inf"), ("upper", "inf"), ("velocity", "inf")))  # fmt: skip
            out[str(joint.get("name"))] = low, high, fast if fast > 0.0 else np.inf
    return out


def _model_limits(model: mujoco.MjModel) -> dict[str, tuple[float, float, float]]:
    """The same of an MJCF file, whose greatest speeds are numerics ``velocity_limit/JOINT``."""
    numerics = {model.numeric(k).name: float(model.numeric(k).data[0]) for k in range(model.nnumeric)}
    return {
        model.joint(j).name: (*model.jnt_range[j], numerics.get(f"velocity_limit/{model.joint(j).name}", np.inf))
        for j in range(model.njnt)
        if model.jnt_limited[j]
    }


def judged(source: Source, people: list[HumanMotion], dogs: list[HumanMotion]) -> Iterator[tuple[str, dict]]:
    """The name and the judge's figures of each clip on a robot."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", osik.OsikWarning)
        robot = robot_of(source)
        retargeter = Retargeter(robot)
        profile = retargeter.profile
        judge = Judge(source, profile, robot.floating_base)
        clips = grasps() if profile.is_hand else dogs if len(profile.feet) == 4 and profile.walks else people
        for motion, result in zip(clips, retargeter.retarget_all(clips, progress=False), strict=True):
            yield motion.name, judge.figures(result)


def main() -> int:
    """Prints a line for each clip to stderr, and a table of the worst values; 1 if a bar is not met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="*", help="motion files of people")
    parser.add_argument(
        "--robots", nargs="+", default=["g1", "nao", "talos"], help="names or files, :fixed behind them"
    )
    parser.add_argument("--dogs", nargs="+", default=[], help="motion files of animals, for robots on four feet")
    parser.add_argument("--csv", type=Path, help="file for the figures of each clip")
    options = parser.parse_args()
    configure_cpu()
    jax.config.update("jax_enable_x64", True)
    people, dogs = ([load_motion(path) for path in paths] for paths in (options.clips, options.dogs))
    heads = [f"{key} [{unit}]" for key, (unit, _, _) in FIGURES.items()]
    table, rows, failed = [["robot", "clips", *heads], ["---"] * (2 + len(heads))], [], []
    for text in options.robots:
        source, found = source_of(text), []
        label = source.name + (", fixed" if text.endswith(":fixed") else "")
        for name, figures in judged(source, people, dogs):
            found.append([figures[key] for key in FIGURES])
            rows.append([label, name, *map(_cell, FIGURES, found[-1])])
            print(*rows[-1], sep=", ", file=sys.stderr, flush=True)
            broken = [key for key, (_, _, bar) in FIGURES.items() if (figures[key] or 0.0) > bar]
            failed += [f"{label} in {name}: {key} {figures[key]:.4g}" for key in broken]
        worst = [None if None in values else max(values) for values in zip(*found, strict=True)]
        table.append([label, str(len(found)), *map(_cell, FIGURES, worst)])
    if options.csv:
        write_csv(options.csv, ["robot", "clip", *heads], rows)
    print("\n".join([*("| " + " | ".join(row) + " |" for row in table), *failed]))
    return int(bool(failed))


def _cell(key: str, value: float | None) -> str:
    return "-" if value is None else f"{value:.{FIGURES[key][1]}f}"


if __name__ == "__main__":
    sys.exit(main())
