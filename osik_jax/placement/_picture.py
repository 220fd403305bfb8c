"""Picture of a placement from above."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

from ..collision import Scene
from ..collision._table import ShapeKind
from ..reachability._picture import NOTHING, cell_edges, share_colors

_INK, _GREY, _BEST = "#2b2f36", "#5b636d", "#f08c3a"


def draw_placement(found: Any) -> Figure:
    """Return the grid of a ``Placement`` from above: the most poses reached at each x and y, over yaws and heights."""
    figure, place = _page()
    share = found.reached.max((2, 3)).T / len(found.q)
    stands = found.stands_free.any((2, 3)).T
    edges = cell_edges((found.x, found.y))
    place.pcolormesh(*edges, np.ma.masked_where(~stands, np.zeros_like(share)), cmap=ListedColormap([NOTHING]))
    reached = np.ma.masked_where(share == 0.0, 100.0 * share)
    cells = place.pcolormesh(*edges, reached, cmap=share_colors(), vmin=0.0, vmax=100.0)
    bar = figure.colorbar(cells, shrink=0.8)
    bar.set_label(f"of {len(found.q)} poses reached, best yaw and height [%]", color=_INK)
    _draw_scene(place, found.scene)
    met = np.repeat(found.is_reached, len(found.poses) // len(found.is_reached))  # poses of all frames
    for kind, chosen, label in ((".", met, "reached"), ("x", ~met, "not reached")):
        if chosen.any():
            place.plot(
                *found.poses[chosen, :2].T, kind, color="#c0392b", ms=7, mew=0.6 if kind == "." else 1.5, label=label
            )
    label = f"best base: {found.is_reached.sum()} poses, height {found.best[3]:.3g} m"
    _draw_base(place, found.best, _BEST, label)
    _finish(place, "grey: no pose reached; white: the base does not stand free, or is not tried")
    return figure


def draw_team(team: Any) -> Figure:
    """Return a ``Team`` from above: the robots at home, the scene, and the poses in the colour of who takes them."""
    figure, place = _page()
    _draw_scene(place, team.members[0].task.scene)
    poses = np.asarray(team.members[0].task.goal.position)[..., :2]  # (poses, frames, 2)
    if not team.is_reached.all():
        place.plot(*poses[~team.is_reached].reshape(-1, 2).T, "x", color=_GREY, ms=6, label="reached by none")
    for k, (name, base, member) in enumerate(zip(team.names, team.bases, team.members, strict=True)):
        color, taken = f"C{k}", team.robot == k
        _draw_scene(place, Scene({name: member.shapes_at(base, member.home)}), edgecolor=color, alpha=0.7)
        place.plot(*poses[taken].reshape(-1, 2).T, ".", color=color, ms=8, mec="white", mew=0.6)
        _draw_base(place, base, color, f"{name}: takes {taken.sum()} poses, height {base[3]:.3g} m")
    _finish(place, "outlines of the robots at home; poses in the colour of the robot that takes them")
    return figure


def _page() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.0, 6.0), dpi=130, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots()


def _draw_scene(place: Axes, scene: Scene | None, **style: Any) -> None:
    """Draw the outlines of the shapes in the world."""
    for outline in [] if scene is None else _outlines(scene):
        place.fill(*outline.T, **{"facecolor": "none", "edgecolor": _INK, "linewidth": 1.2} | style)


def _draw_base(place: Axes, base: Float[np.ndarray, "4"], color: str, label: str) -> None:
    """Draw a base as a dot with an arrow along its x axis."""
    (x, y, yaw, _), length = base, 0.08 * float(np.ptp(place.get_xlim()))
    place.plot(x, y, "o", color=color, ms=9, label=label)
    place.annotate(
        "",
        (x + length * np.cos(yaw), y + length * np.sin(yaw)),
        (x, y),
        arrowprops=dict(arrowstyle="->", color=color, lw=2),
    )


def _finish(place: Axes, title: str) -> None:
    place.set_aspect("equal")
    place.set_xlabel("x [m]", color=_INK)
    place.set_ylabel("y [m]", color=_INK)
    place.set_title(title, fontsize=9, color=_GREY)
    place.legend(frameon=False, fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)


def _outlines(scene: Scene) -> list[Float[np.ndarray, "k 2"]]:
    """Return the outlines of the shapes in the world from above; half spaces have none."""
    table, held = scene.table, np.asarray(scene.body) >= 0
    drawn = ~held & ~np.isin(table.kind, (ShapeKind.ABSENT, ShapeKind.HALF_SPACE))
    return [_outline(scene, int(k)) for k in np.flatnonzero(drawn)]


def _outline(scene: Scene, row: int) -> Float[np.ndarray, "k 2"]:
    """Return the convex outline of one shape: of its vertices, or of points of its surface, in the world's x and y."""
    table = scene.table
    kind, size = int(table.kind[row]), np.asarray(table.size[row])
    if kind == ShapeKind.HULL:
        points = np.asarray(table.vertices[table.first[row] : table.first[row] + table.count[row]])
    elif kind == ShapeKind.BOX:
        points = size * (np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3))
    else:  # the ends of the axis; a cylinder's discs, or balls
        points = _disc(size[0]) if kind == ShapeKind.CYLINDER else np.zeros((1, 3))
        end = np.array([0.0, 0.0, size[1]])
        points = np.concatenate([points - end, points + end])
    flat = (np.asarray(table.position[row]) + points @ np.asarray(table.rotation[row]).T)[:, :2]
    if kind in (ShapeKind.SPHERE, ShapeKind.CAPSULE, ShapeKind.HULL) and size[0] > 0.0:
        flat = (flat[:, None] + _disc(size[0])[:, :2]).reshape(-1, 2)
    return flat[ConvexHull(flat).vertices]


def _disc(radius: float) -> Float[np.ndarray, "64 3"]:
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(64)], -1)
