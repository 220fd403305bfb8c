"""Profiles as TOML files, and the profiles bundled with the package."""

from __future__ import annotations

import dataclasses
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
from ._profile import Capsule, Foot, Profile

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
        names = tuple(field.name for field in dataclasses.fields(Profile))
        for name in data:
            if name not in names:
                raise unknown_name("entry", name, names)
        for name in ("keypoints", "pelvis"):
            if name not in data:
                raise OsikValueError(f"there is no {name}; there is {', '.join(data) or 'nothing'}")
        parts: dict[str, Any] = {name: _tuples(value) for name, value in data.items()}
        origin = (0.0, 0.0, 0.0)
        parts["keypoints"] = {role: (e["frame"], e.get("point", origin)) for role, e in parts["keypoints"].items()}
        parts["feet"] = {name: Foot(**entry) for name, entry in parts.get("feet", {}).items()}
        parts["capsules"] = tuple(Capsule(**entry) for entry in parts.get("capsules", ()))
        parts["weights"] = _weights(data.get("weights", {}))
        return Profile(**parts)
    except tomllib.TOMLDecodeError as error:
        raise OsikValueError(f"{source} is no TOML: {error}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise OsikValueError(f"{source}: {error.args[0] if error.args else error}") from None


def _tuples(value: Any) -> Any:
    """Return a value of a TOML file with lists as tuples, and their numbers as floats."""
    if isinstance(value, dict):
        return {name: _tuples(one) for name, one in value.items()}
    if isinstance(value, list):
        return tuple(float(one) if isinstance(one, int) else _tuples(one) for one in value)
    return value


def _weights(entry: Mapping[str, Any]) -> Weights:
    usual: dict[str, Any] = {field.name: field.default for field in dataclasses.fields(Weights)}
    for name, value in entry.items():
        if name not in usual:
            raise unknown_name("weight", name, tuple(usual))
        numbers, shape = np.asarray(value), np.shape(usual[name])
        if numbers.shape != shape or numbers.dtype.kind not in "fi" or not (numbers >= 0).all():
            raise OsikValueError(
                f"weights.{name} is {value!r}; it is {'three numbers' if shape else 'a number'}, not < 0"
            )
    return Weights(**entry)
