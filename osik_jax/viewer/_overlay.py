"""Flat drawings over a picture of the stage: marks in the world and panels with curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from ._stage import Camera

GREEN, ORANGE, BLUE, INK = "#2a9d62", "#e8590c", "#1c6fb8", "#2b2f36"
DPI = 100
_CURVE_COLORS = (BLUE, GREEN, ORANGE)
_LEAST_RANGE = 1e-3
"""Range of a panel whose curves are constant, so that their rounding errors do not fill it."""
_CARD = (1.0, 1.0, 1.0, 0.82)


class Canvas:
    """Transparent matplotlib picture with a static part and moving artists."""

    def __init__(self, size: tuple[int, int], scale: float = 1.0) -> None:
        """Take width and height [pixels]; ``scale`` enlarges lines and text."""
        dpi = DPI * scale
        self.size = size
        self.figure = Figure(figsize=(size[0] / dpi, size[1] / dpi), dpi=dpi)
        self.figure.patch.set_alpha(0.0)
        self._canvas = FigureCanvasAgg(self.figure)
        self.page = self.figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, size[0]), ylim=(size[1], 0))
        self.page.set_axis_off()
        self._moving: list[Artist] = []
        self._still = None

    def title(self, x: float, y: float, words: str, fontsize: float) -> None:
        """Write a bold line starting at (x, y), shrunk if it would leave the picture."""
        text = self.page.text(x, y, words, fontsize=fontsize, color=INK, weight="bold")
        width = text.get_window_extent(self._canvas.get_renderer()).width
        text.set_fontsize(fontsize * min(1.0, (self.size[0] - 2.0 * x) / max(width, 1.0)))

    def moving(self, *artists: Artist) -> None:
        """Mark artists as such that change between pictures."""
        for artist in artists:
            artist.set_animated(True)
            self._moving.append(artist)

    def picture(self) -> np.ndarray:
        """Return the picture as RGBA with straight alpha. (height, width, 4), uint8."""
        if self._still is None:
            self._canvas.draw()
            self._still = self._canvas.copy_from_bbox(self.figure.bbox)
        self._canvas.restore_region(self._still)
        for artist in self._moving:
            if artist.axes is not None:
                artist.axes.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba()).copy()


def polygon_layer(
    vertices: Sequence[Float[np.ndarray, "m 2"]], camera: Camera, size: tuple[int, int], *, floor: float
) -> Float[np.ndarray, "height width 4"]:
    """Return a layer of support polygons on the floor, to be painted under the robots."""
    canvas = Canvas(size)
    for corners in vertices:
        points = camera.project(np.column_stack([corners, np.full(len(corners), floor)]), size)
        style = {"facecolor": to_rgba(GREEN, 0.25), "edgecolor": to_rgba(GREEN, 0.95), "lw": 2.0 * size[1] / 450}
        canvas.page.add_patch(Polygon(points, **style))
    return canvas.picture() / np.float32(255.0)


class ComMark:
    """Mark of the centre of mass: dot, plumb line, and its point on the floor."""

    def __init__(self, canvas: Canvas, camera: Camera, *, floor: float, moving: bool = True) -> None:
        """Add the artists to a canvas."""
        self._camera, self._size, self._floor = camera, canvas.size, floor
        (self._line,) = canvas.page.plot([], [], color=ORANGE, lw=1.4, ls=(0, (4, 2.5)))
        (self._foot,) = canvas.page.plot([], [], "o", ms=6.5, mfc="white", mec=ORANGE, mew=2.0)
        (self._ball,) = canvas.page.plot([], [], "o", ms=10, mfc=ORANGE, mec="white", mew=1.6)
        if moving:
            canvas.moving(self._line, self._foot, self._ball)

    def place(self, com: Float[np.ndarray, "3"]) -> None:
        """Move the mark to a centre of mass [m]."""
        (x0, y0), (x1, y1) = self._camera.project(np.array([com, [com[0], com[1], self._floor]]), self._size)
        self._line.set_data([x0, x1], [y0, y1])
        self._ball.set_data([x0], [y0])
        self._foot.set_data([x1], [y1])


class CurvePanel:
    """Curves over time, drawn up to the current frame; dashed references are drawn from the start."""

    def __init__(
        self,
        canvas: Canvas,
        rectangle: tuple[float, float, float, float],
        title: str,
        time: Float[np.ndarray, " frames"],
        curves: Mapping[str, Float[np.ndarray, " frames"]],
        wanted: Mapping[str, Float[np.ndarray, " frames"]],
    ) -> None:
        """Draw the static part; each curve has one value per frame."""
        self._time, self._curves, self._lines = time, list(curves.values()), []
        axes = canvas.figure.add_axes(rectangle)
        axes.set_facecolor(_CARD)
        axes.set_title(title, loc="left", fontsize=8.5, color=INK, pad=4)
        axes.tick_params(labelsize=7, colors=INK, length=2.5, width=0.7)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set(color="#9aa3ad", linewidth=0.8)
        values = np.concatenate([*curves.values(), *wanted.values()])
        room = max(np.ptp(values), _LEAST_RANGE)
        middle = 0.5 * (values.min() + values.max())
        axes.set_xlim(time[0], time[-1])
        axes.set_ylim(middle - 0.58 * room, middle + 0.92 * room)
        axes.set_xlabel("time [s]", fontsize=7.5, color=INK, labelpad=1)
        for values, color in zip(wanted.values(), _CURVE_COLORS, strict=False):
            axes.plot(time, values, color=color, lw=1.0, ls=(0, (3, 2)), alpha=0.65)
        for name, color in zip(curves, _CURVE_COLORS, strict=False):
            (line,) = axes.plot([], [], color=color, lw=1.9, label=name)
            (dot,) = axes.plot([], [], "o", ms=5, color=color)
            canvas.moving(line, dot)
            self._lines.append((line, dot))
        axes.legend(
            fontsize=7, frameon=False, loc="upper right", ncols=2, labelcolor=INK, handlelength=1.4, borderaxespad=0.1
        )

    def place(self, frame: int) -> None:
        """Draw the curves up to a frame."""
        for (line, dot), values in zip(self._lines, self._curves, strict=True):
            line.set_data(self._time[: frame + 1], values[: frame + 1])
            dot.set_data([self._time[frame]], [values[frame]])
