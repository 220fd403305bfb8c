"""Collision shapes of a URDF that are mesh files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..._errors import OsikValueError
from .._load_report import LoadNote
from ._meshes import SUFFIXES, compiled_mesh, is_read_by_mujoco, joined, read_mesh, shell
from ._packages import Packages
from ._urdf_elements import Shape, Urdf

_THICKNESS = 1e-3
"""Thickness given to a flat mesh [m]."""
_LINE = 1e-6
"""A mesh whose extent in a second direction is less than this share of its extent in the first is a line."""


def meshes_of(
    urdf: Urdf, packages: Packages, beside: Path | None, *, checked: bool
) -> tuple[list[tuple[str, Shape, dict[str, Any]]], list[LoadNote]]:
    """Return the collision shapes that are meshes: link, shape and the arguments of ``MjSpec.add_mesh``.

    Shapes with the same file and scale have the same arguments. If ``checked``, each mesh is tried alone: a flat one is
    thickened, one that MuJoCo cannot read is left out, and the notes say so. Without, all are returned as they are,
    which is quicker.
    """
    known: dict[tuple[Path, tuple[float, ...]], tuple[dict[str, Any] | None, str]] = {}
    found, notes = [], []
    for link in urdf.links.values():
        for shape in link.shapes:
            if shape.kind != "mesh" or shape.visual:
                continue
            path = packages.path(shape.file, beside=beside)
            _check_mesh(path, link.name)
            key = path, shape.size
            if key not in known:
                made = dict(name=f"{path.stem}_{len(known)}", scale=shape.size)
                known[key] = _repaired(path, made) if checked else (made | _source(path), "")
            form, done = known[key]
            if form is not None:
                found.append((link.name, shape, form))
            if done:
                notes.append(LoadNote("collision mesh", link.name, f"{path} {done}"))
    return found, notes


def _check_mesh(path: Path, link: str) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise OsikValueError(
            f"link {link!r}: the mesh {str(path)!r} is of no kind that can be read: {', '.join(SUFFIXES)}"
        )


def _source(path: Path) -> dict[str, Any]:
    """Return where MuJoCo takes a mesh from: its file, or the triangles of a file that MuJoCo cannot read."""
    if is_read_by_mujoco(path):
        return dict(file=str(path))
    vertices, faces = joined(read_mesh(path))
    return dict(uservert=vertices.ravel(), userface=faces.ravel())


def _repaired(path: Path, made: dict[str, Any]) -> tuple[dict[str, Any] | None, str]:
    """Return the mesh to add in place of a file (None for nothing), and what was done (empty if unchanged)."""
    form: dict[str, Any] | None = None
    try:
        form = made | _source(path)
        compiled_mesh(form, collides=True)
    except ValueError as error:
        reason = " ".join(str(error).partition("\n")[0].removeprefix("Error: ").removeprefix(f"{path}: ").split())
    else:
        return form, ""
    if form is None:
        return None, f"is left out: {reason}"
    try:
        points, _ = shell(**{**form, "scale": (1.0, 1.0, 1.0)})
        thick = dict(name=form["name"], uservert=thickened(points * np.array(form["scale"])).ravel())
        compiled_mesh(thick, collides=True)
    except ValueError:
        return None, f"is left out: {reason}"
    return thick, f"is flat, and {1e3 * _THICKNESS:g} mm thick here"


def thickened(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return points on both sides of the plane that the given ones are in; ValueError where they are on one line."""
    _, extents, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    if not extents[1] > _LINE * extents[0]:
        raise OsikValueError("the points are on one line")
    aside = 0.5 * _THICKNESS * axes[2]
    return np.concatenate([points + aside, points - aside])
