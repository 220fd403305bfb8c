"""MuJoCo's OpenGL renderer, and the choice between it and ray casting."""

from __future__ import annotations

import warnings
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float

from ._raycast import Image, RayCaster
from ._stage import Camera, Stage

RendererName = Literal["auto", "mujoco", "raycast"]
_GL_ERRORS = (mujoco.FatalError, ImportError, AttributeError, OSError, RuntimeError)
"""Exceptions of MuJoCo's renderer without a GL library, without a screen, or with a broken driver."""


_failures: list[str] = []
"""Reason why OpenGL does not work here, kept because MuJoCo 4.0 aborts the process at a second failure."""


class GlRenderer:
    """MuJoCo's renderer with the camera and picture size of the ray caster."""

    def __init__(self, stage: Stage, camera: Camera, size: tuple[int, int]) -> None:
        """Open a GL context; raise RuntimeError where OpenGL does not work."""
        if _failures:
            raise RuntimeError(_failures[0])
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._renderer = mujoco.Renderer(stage.model, height=size[1], width=size[0])
        except _GL_ERRORS as error:
            _failures.append(f"MuJoCo's renderer does not work here: {error}")
            raise RuntimeError(_failures[0]) from error
        self._camera = camera.for_mujoco()
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 1

    def image(self, data: mujoco.MjData, under: Float[np.ndarray, "height width 4"] | None = None) -> Image:
        """Return a picture of the stage; ``under`` is painted over floor and sky, behind the robots."""
        picture = self._render(data) / 255.0
        if under is not None:
            self._renderer.enable_segmentation_rendering()
            ids = self._render(data)[..., 0]
            self._renderer.disable_segmentation_rendering()
            alpha = under[..., 3:] * (ids <= 0)[..., None]  # the floor is geom 0, the sky is -1
            picture += alpha * (under[..., :3] - picture)
        return picture

    def _render(self, data: mujoco.MjData) -> np.ndarray:
        self._renderer.update_scene(data, camera=self._camera, scene_option=self._options)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = True
        return self._renderer.render()


def make_renderer(
    name: RendererName, stage: Stage, camera: Camera, size: tuple[int, int], *, floor: float
) -> GlRenderer | RayCaster:
    """Return MuJoCo's renderer (``"mujoco"``), a CPU renderer (``"raycast"``), or the first that works (``"auto"``).

    Raises:
        RuntimeError: ``"mujoco"`` where OpenGL does not work.
    """
    if name != "raycast":
        try:
            return GlRenderer(stage, camera, size)
        except RuntimeError:
            if name == "mujoco":
                raise
    return RayCaster(stage, camera, size, floor=floor)


def check_opengl() -> None:
    """Raise RuntimeError unless MuJoCo's renderer can draw an empty scene."""
    camera = Camera((0.0, 0.0, 0.0), 1.0, 0.0, 0.0, 1.0)
    GlRenderer(Stage((), camera, floor=0.0), camera, (16, 16))
