"""Profiles as TOML files, and the profiles bundled with the package."""

from __future__ import annotations

import dataclasses
import json
import os
import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import OsikValueError, unknown_name
from .._whole_file import write_text
from ..robot import Robot
from ._goals import Weights
from ._guess import guess_profile
from ._profile import Capsule, Foot, Limb, Place, Point, Profile

BUNDLED = ("nao", "g1", "talos")


def load_profile(path: str | os.PathLike[str]) -> Profile:
    """Read a profile from a TOML file, or a bundled one: ``"nao"``, ``"g1"``, ``"talos"``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is broken; the message says what is wrong.
    """
    if str(path) in BUNDLED:
        text = (resources.files("osik_jax") / "retargeting" / "profiles" / f"{path}.toml").read_text(encoding="utf-8")
        return _parsed(text, f"{path}.toml")
    if not Path(path).is_file():
        raise FileNotFoundError(f"no such file: {path} (profiles that come with the package: {', '.join(BUNDLED)})")
    return _parsed(Path(path).read_text(encoding="utf-8"), str(path))


def save_profile(profile: Profile, path: str | os.PathLike[str]) -> None:
    """Write a profile as a TOML file for ``load_profile``."""
    write_text(path, profile_text(profile))


def find_profile(robot: Robot) -> Profile:
    """Return the bundled profile whose frames a robot all has, else a guess."""
    for name in BUNDLED:
        profile = load_profile(name)
        if set(profile.frames) <= set(robot.frame_names):
            return profile
    return guess_profile(robot)


def check_profile(robot: Robot, profile: Profile) -> None:
    """Raise KeyError if a profile names a frame that the robot does not have."""
    for frame in profile.frames:
        robot.tree.frame(frame)


def profile_text(profile: Profile) -> str:
    """Return a profile as TOML text."""
    lines = [f'pelvis = "{profile.pelvis}"']
    lines += [] if profile.torso is None else [f'torso = "{profile.torso}"']
    lines += [] if profile.scale is None else [f"scale = {profile.scale!r}"]
    lines += [] if profile.stretch == 1.0 else [f"stretch = {profile.stretch!r}"]
    lines += ["rolls = true"] if profile.rolls else []
    given = {name: getattr(profile, name) for name in ("limbs", "reaches")}
    lines += [f"{name} = {json.dumps(limbs)}" for name, limbs in given.items() if limbs is not None]
    rows = [f'frame = "{c.frame}", start = {_point(c.start)}, end = {_point(c.end)}, radius = {c.radius!r}'
            for c in profile.capsules]  # fmt: skip
    lines += ["capsules = [", *(f"    {{ {row} }}," for row in rows), "]"] if rows else []
    lines += ["", "[keypoints]"]
    lines += [f'{role} = {{ frame = "{f}", point = {_point(p)} }}' for role, (f, p) in profile.keypoints.items()]
    for side, foot in profile.feet.items():
        lines += ["", f"[feet.{side}]", f'frame = "{foot.frame}"']
        lines += [f"{part} = [{', '.join(_point(p) for p in getattr(foot, part))}]" for part in ("heel", "toe")]
        lines += [f"radius = {foot.radius!r}"] if foot.radius else []
    lines += ["", "[weights]"]
    for field in dataclasses.fields(Weights):
        value = np.asarray(getattr(profile.weights, field.name), float)
        lines.append(f"{field.name} = {_point(value) if value.ndim else repr(float(value))}")
    return "\n".join(lines) + "\n"


def _point(values: Any) -> str:
    return f"[{', '.join(repr(float(x)) for x in values)}]"


def _parsed(text: str, source: str) -> Profile:
    try:
        data = tomllib.loads(text)
        known = {field.name for field in dataclasses.fields(Profile)}
        for name in data:
            if name not in known:
                raise unknown_name("entry", name, tuple(sorted(known)))
        return Profile(
            keypoints={role: _place(entry, f"keypoints.{role}") for role, entry in _entry(data, "keypoints").items()},
            pelvis=str(_entry(data, "pelvis")),
            torso=data.get("torso"),
            feet={name: _foot(entry, name) for name, entry in data.get("feet", {}).items()},
            capsules=tuple(_capsule(entry, i) for i, entry in enumerate(data.get("capsules", ()))),
            scale=data.get("scale"),
            stretch=data.get("stretch", 1.0),
            weights=_weights(data.get("weights", {})),
            limbs=_limbs(data, "limbs"),
            reaches=_limbs(data, "reaches"),
            rolls=data.get("rolls", False) is True,
        )
    except tomllib.TOMLDecodeError as error:
        raise OsikValueError(f"{source} is no TOML: {error}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise OsikValueError(f"{source}: {error.args[0] if error.args else error}") from None


def _entry(data: Mapping[str, Any], name: str) -> Any:
    if name not in data:
        raise OsikValueError(f"there is no {name}; there is {', '.join(data) or 'nothing'}")
    return data[name]


def _place(entry: Mapping[str, Any], what: str) -> Place:
    return str(_entry(entry, "frame")), _as_point(entry.get("point", (0.0, 0.0, 0.0)), what)


def _as_point(value: Any, what: str) -> Point:
    numbers = np.asarray(value)
    if numbers.shape != (3,) or numbers.dtype.kind not in "fi" or not np.isfinite(numbers).all():
        raise OsikValueError(f"{what} is {value!r}; a point is three numbers in metres")
    x, y, z = (float(number) for number in numbers)
    return x, y, z


def _limbs(data: Mapping[str, Any], name: str) -> tuple[Limb, ...] | None:
    pairs = data.get(name)
    if pairs is None:
        return None
    for pair in pairs:
        if not (isinstance(pair, list) and len(pair) == 2):
            raise OsikValueError(f"{name} has {pair!r}; a limb is two roles, from the first to the second")
    return tuple((str(a), str(b)) for a, b in pairs)


def _foot(entry: Mapping[str, Any], name: str) -> Foot:
    parts = []
    for part in ("heel", "toe"):
        points = _entry(entry, part)
        if len(points) != 2:
            raise OsikValueError(f"feet.{name}.{part} has {len(points)} points; it is the left and the right corner")
        parts.append((_as_point(points[0], f"feet.{name}.{part}"), _as_point(points[1], f"feet.{name}.{part}")))
    radius = float(entry.get("radius", 0.0))
    if not radius >= 0.0:
        raise OsikValueError(f"feet.{name}.radius is {radius}; it is a length in metres, 0 or more")
    return Foot(str(_entry(entry, "frame")), parts[0], parts[1], radius)


def _capsule(entry: Mapping[str, Any], number: int) -> Capsule:
    start, end = (_as_point(_entry(entry, name), f"capsules, number {number}, {name}") for name in ("start", "end"))
    radius = float(_entry(entry, "radius"))
    if not radius > 0.0 or start == end:
        raise OsikValueError(f"capsules, number {number}: the radius and the length have to be more than 0")
    return Capsule(str(_entry(entry, "frame")), start, end, radius)


def _weights(entry: Mapping[str, Any]) -> Weights:
    names = tuple(field.name for field in dataclasses.fields(Weights))
    for name, value in entry.items():
        if name not in names:
            raise unknown_name("weight", name, names)
        numbers = np.asarray(value)
        shape = np.shape(getattr(Weights(), name))
        if numbers.shape != shape or numbers.dtype.kind not in "fi" or not (numbers >= 0).all():
            raise OsikValueError(
                f"weights.{name} is {value!r}; it is {'three numbers' if shape else 'a number'}, not < 0"
            )
    return Weights(**entry)
