"""Small motions of a stick figure, and writers of motion files, for tests."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from osik_jax.retargeting import HumanMotion
from osik_jax.retargeting._person import Person, directions, read_person
from osik_jax.retargeting._roles import LIMBS
from osik_jax.retargeting._skeletons import find_roles

FIGURE = (
    ("Hips", -1, (0.0, 0.0, 0.0)),
    ("Spine", 0, (0.0, 0.25, 0.0)),
    ("Neck", 1, (0.0, 0.22, 0.0)),
    ("Head", 2, (0.0, 0.15, 0.0)),
    ("LeftArm", 1, (0.18, 0.18, 0.0)),
    ("LeftForeArm", 4, (0.27, 0.0, 0.0)),
    ("LeftHand", 5, (0.25, 0.0, 0.0)),
    ("RightArm", 1, (-0.18, 0.18, 0.0)),
    ("RightForeArm", 7, (-0.27, 0.0, 0.0)),
    ("RightHand", 8, (-0.25, 0.0, 0.0)),
    ("LeftUpLeg", 0, (0.09, -0.02, 0.0)),
    ("LeftLeg", 10, (0.0, -0.42, 0.0)),
    ("LeftFoot", 11, (0.0, -0.41, 0.0)),
    ("LeftToeBase", 12, (0.0, -0.06, 0.15)),
    ("RightUpLeg", 0, (-0.09, -0.02, 0.0)),
    ("RightLeg", 14, (0.0, -0.42, 0.0)),
    ("RightFoot", 15, (0.0, -0.41, 0.0)),
    ("RightToeBase", 16, (0.0, -0.06, 0.15)),
)
"""Name, parent and offset [m] of each joint: y up, facing z, arms to the sides."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """A moving tree: local rotations of each joint, and where its root is.

    Attributes:
        joints: name, parent and offset of each.
        root: position of the root in each frame. (F, 3)
        angles: Euler angles of each joint in the order of ``orders`` [deg]. (F, J, 3)
        orders: of each joint, such as ``"ZXY"``: the first turns first about the parent's axis.
        fps: frames a second.
    """

    joints: tuple[tuple[str, int, tuple[float, float, float]], ...]
    root: np.ndarray
    angles: np.ndarray
    orders: tuple[str, ...]
    fps: float

    def forward(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (F, J, 3) and rotation matrices (F, J, 3, 3) of all joints, by SciPy's rotations."""
        frames, count = self.angles.shape[:2]
        positions, turns = np.zeros((frames, count, 3)), np.zeros((frames, count, 3, 3))
        for i, (_, parent, offset) in enumerate(self.joints):
            local = Rotation.from_euler(self.orders[i], self.angles[:, i], degrees=True).as_matrix()
            if parent < 0:
                positions[:, i], turns[:, i] = self.root, local
            else:
                positions[:, i] = positions[:, parent] + turns[:, parent] @ np.array(offset)
                turns[:, i] = turns[:, parent] @ local
        return positions, turns


def dancer(frames: int = 24, fps: float = 30.0) -> Figure:
    """The figure lowers itself with both feet where they are, waves its arms and turns its head."""
    phase = np.linspace(0.0, 2.0 * np.pi, frames)
    names = [name for name, _, _ in FIGURE]
    angles = np.zeros((frames, len(FIGURE), 3))  # z, x, y
    bend = 12.0 * (1.0 - np.cos(phase))
    shank, thigh = 0.41, 0.42
    lean = np.degrees(np.arcsin(thigh * np.sin(np.radians(bend)) / shank))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        angles[:, names.index(f"{side}UpLeg"), 1] = -bend
        angles[:, names.index(f"{side}Leg"), 1] = bend + lean
        angles[:, names.index(f"{side}Foot"), 1] = -lean
        angles[:, names.index(f"{side}Arm"), 0] = -sign * (60.0 + 25.0 * np.sin(phase))
        angles[:, names.index(f"{side}ForeArm"), 2] = -sign * (30.0 + 20.0 * np.cos(phase))
    angles[:, names.index("Head"), 2] = 20.0 * np.sin(phase)
    root = np.zeros((frames, 3))
    root[:, 1] = 0.08 + 0.02 + thigh * np.cos(np.radians(bend)) + shank * np.cos(np.radians(lean))
    return Figure(FIGURE, root, angles, ("ZXY",) * len(FIGURE), fps)


def turned_dancer(frames: int = 24, fps: float = 30.0) -> Figure:
    """The dancer, turned by 25 degrees about the vertical."""
    own = dancer(frames, fps)
    angles = own.angles.copy()
    angles[:, 0, 2] = 25.0  # z, x, y
    return dataclasses.replace(own, angles=angles)


def seen(motion: HumanMotion) -> Person:
    """The person of a clip whose joints are told by their names."""
    return read_person(motion, find_roles(motion.joint_names, positions=motion.positions))


def assert_same_person(motion: HumanMotion, truth: Person, atol: float = 2e-8) -> Person:
    """The clip shows a person, whatever its file looks like."""
    person = seen(motion)
    for name in ("pelvis", "torso", "feet", "root", "contact"):
        np.testing.assert_allclose(getattr(person, name), getattr(truth, name), atol=atol, err_msg=name)
    found, known = (directions(own.points, LIMBS) for own in (person, truth))
    np.testing.assert_allclose(found, known, atol=atol)
    return person


def with_rest(own: Figure, turns: np.ndarray, orders: str = "ZXY") -> Figure:
    """The same motion of a skeleton whose joints are turned by constant rotations in its rest pose."""
    _, global_turns = own.forward()
    joints, local = [], np.zeros_like(global_turns)
    for i, (name, parent, offset) in enumerate(own.joints):
        before = turns[parent] if parent >= 0 else np.eye(3)
        joints.append((name, parent, tuple(before.T @ np.array(offset))))
        own_local = (
            global_turns[:, i] if parent < 0 else np.swapaxes(global_turns[:, parent], 1, 2) @ global_turns[:, i]
        )
        local[:, i] = before.T @ own_local @ turns[i]
    with warnings.catch_warnings():  # at gimbal lock SciPy chooses one of the equal triples
        warnings.simplefilter("ignore", UserWarning)
        angles = np.stack([Rotation.from_matrix(t).as_euler(orders, degrees=True) for t in local.swapaxes(0, 1)], 1)
    return Figure(tuple(joints), own.root, angles, (orders,) * len(joints), own.fps)


def renamed(own: Figure, names: Callable[[str], str]) -> Figure:
    """The same with other names."""
    return dataclasses.replace(own, joints=tuple((names(name), parent, offset) for name, parent, offset in own.joints))


def turned_up(own: Figure, up: str) -> Figure:
    """The same in axes with another one up: a rotation of all axes, forward stays the one after it."""
    shift = {"y": 0, "z": 1, "x": 2}[up]
    if not shift:
        return own
    change = np.roll(np.eye(3), shift, axis=0)
    joints = tuple((name, parent, tuple(change @ np.array(offset))) for name, parent, offset in own.joints)
    orders = "".join("XYZ"[("XYZ".index(axis) + shift) % 3] for axis in own.orders[0])
    return Figure(joints, own.root @ change.T, own.angles, (orders,) * len(joints), own.fps)


def with_between(own: Figure, name: str, child: str, share: float) -> Figure:
    """The same with another joint, which does not turn, at some share of the way to ``child``."""
    at = [joint for joint, _, _ in own.joints].index(child)
    joints = [(joint, parent + (parent >= at), offset) for joint, parent, offset in own.joints]
    _, parent, (x, y, z) = joints[at]
    first, rest = share, 1.0 - share
    joints[at] = (name, parent, (first * x, first * y, first * z))
    joints.insert(at + 1, (child, at, (rest * x, rest * y, rest * z)))
    orders = (*own.orders[:at], own.orders[at], *own.orders[at:])
    return Figure(tuple(joints), own.root, np.insert(own.angles, at, 0.0, 1), orders, own.fps)


def along_x(own: Figure, backwards: str = "none") -> np.ndarray:
    """Turns of a rest pose with each bone along x, or against it where the joint's name has ``backwards`` in it."""
    turns = np.tile(np.eye(3), (len(own.joints), 1, 1))
    for i, (name, _, _) in enumerate(own.joints):
        ends = [np.array(offset) for _, parent, offset in own.joints if parent == i]
        if ends and i:
            along = [np.linalg.norm(ends[0]) * (-1.0 if backwards in name else 1.0), 0.0, 0.0]
            turns[i] = Rotation.align_vectors(ends[:1], [along])[0].as_matrix()
    return turns


def bent_forward(motion: HumanMotion, most: float = 70.0) -> HumanMotion:
    """The same, with all above the hips turned forward about them, by so many degrees in the middle of the clip."""
    names, positions = motion.joint_names, motion.positions.copy()
    upper = [i for i, name in enumerate(names) if not any(leg in name for leg in ("Leg", "Foot", "Toe", "Hips"))]
    hips, ends = positions[:, [names.index("Hips")]], [names.index(f"{side}UpLeg") for side in ("Right", "Left")]
    angles = np.radians(0.5 * most) * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, len(positions))))
    left = positions[:, ends[1]] - positions[:, ends[0]]
    turns = Rotation.from_rotvec(angles[:, None] * left / np.linalg.norm(left, axis=1, keepdims=True)).as_matrix()
    positions[:, upper] = hips + np.einsum("fij,fkj->fki", turns, positions[:, upper] - hips)
    return dataclasses.replace(motion, positions=positions, rotations=None)


def with_first(frames: int, own: Figure | None = None) -> Figure:
    """The dancer with frames before it, in which it stands in its rest pose with legs and arms turned by 20 degrees."""
    own = dancer() if own is None else own
    pose = np.zeros((frames, *own.angles.shape[1:]))
    for name in ("LeftUpLeg", "RightArm"):
        pose[:, [joint for joint, _, _ in own.joints].index(name), 0] = 20.0
    root = np.tile([1.0, 0.9, 0.5], (frames, 1))
    return dataclasses.replace(own, angles=np.concatenate([pose, own.angles]), root=np.concatenate([root, own.root]))


def write_bvh(
    path: Path,
    figure: Figure,
    unit: float = 1.0,
    *,
    floor: str | None = None,
    all_move: bool = False,
    ends: Mapping[str, Sequence[float]] = MappingProxyType({}),
) -> Path:
    """A BVH file of a figure, lengths in ``unit`` metres; a joint without children gets an End Site.

    Args:
        path: the file.
        figure: the figure.
        unit: [m]
        floor: name of a root at rest on the floor, above the figure's own; None: there is none.
        all_move: whether all joints have position channels, which repeat their offsets.
        ends: offsets of End Sites by joint [m]; 0 where none is given.
    """
    children = [[j for j, (_, parent, _) in enumerate(figure.joints) if parent == i] for i in range(len(figure.joints))]
    lines, order = ["HIERARCHY"], []

    def write(i: int, depth: int) -> None:
        name, parent, offset = figure.joints[i]
        indent, order_of = "\t" * depth, figure.orders[i]
        order.append(i)
        turns = " ".join(f"{axis}rotation" for axis in order_of)
        moves = "Xposition Yposition Zposition " if parent < 0 or all_move else ""
        lines.extend([f"{indent}{'JOINT' if depth else 'ROOT'} {name}", f"{indent}{{"])
        lines.append(f"{indent}\tOFFSET {' '.join(repr(float(x) / unit) for x in offset)}")
        lines.append(f"{indent}\tCHANNELS {6 if moves else 3} {moves}{turns}")
        for child in children[i]:
            write(child, depth + 1)
        if not children[i]:
            end = " ".join(repr(float(x) / unit) for x in ends[name]) if name in ends else "0 0 0"
            lines.extend([f"{indent}\tEnd Site", f"{indent}\t{{", f"{indent}\t\tOFFSET {end}", f"{indent}\t}}"])
        lines.append(f"{indent}}}")

    if floor is not None:
        turns = " ".join(f"{axis}rotation" for axis in figure.orders[0])
        lines += [f"ROOT {floor}", "{", "\tOFFSET 0 0 0", f"\tCHANNELS 6 Xposition Yposition Zposition {turns}"]
    write(0, int(floor is not None))
    lines += ["}"] * (floor is not None)
    lines += ["MOTION", f"Frames: {len(figure.root)}", f"Frame Time: {1.0 / figure.fps:.9f}"]
    for root, angles in zip(figure.root, figure.angles, strict=True):
        numbers = [0.0] * 6 * (floor is not None)
        for i in order:
            _, parent, offset = figure.joints[i]
            if parent < 0 or all_move:
                numbers += [x / unit for x in (root if parent < 0 else offset)]
            numbers += [*angles[i]]
        lines.append(" ".join(repr(float(x)) for x in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


def sliding(frames: int, far: float) -> HumanMotion:
    """A person whose feet move apart by ``2 far`` [m] and are said to stand all the time."""
    way, points = far * (1.0 - np.cos(np.linspace(0.0, np.pi, frames))), {}
    heights = dict(hip=0.9, shoulder=1.4, elbow=1.1, wrist=0.9, knee=0.5, ankle=0.08, heel=0.0, toe=0.0)
    shares = dict(knee=0.5, ankle=1.0, heel=1.0, toe=1.0)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for name, z in heights.items():
            x, y = {"heel": -0.05, "toe": 0.15, "knee": 0.05}.get(name, 0.0), 0.1 + shares.get(name, 0.0) * way
            points[f"{side}_{name}"] = np.stack([np.full(frames, x), sign * y, np.full(frames, z)], 1)
    positions = np.stack(list(points.values()), 1)
    return HumanMotion("slides", 30.0, tuple(points), positions, contact=np.ones((frames, 4), bool))
