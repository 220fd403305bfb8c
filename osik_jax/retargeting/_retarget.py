"""From a person's motion to a robot's."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._errors import OsikValueError
from ..execution._workers import cores
from ..robot import Robot
from ..scaling import Saved, run_in_chunks
from ..scaling._progress import reported
from ._finish import follow
from ._lanes import (
    LENGTHS,
    Clip,
    Solved,
    as_lane,
    even,
    one_a_core,
    padded,
    shared_length,
    solve_lane,
    solve_side_by_side,
)
from ._motion import HumanMotion
from ._on_robot import ACCELERATION, OnRobot
from ._person import read_person
from ._plan import make_plan
from ._profile import Profile
from ._retargeted import Retargeted, as_retargeted
from ._skeletons import find_roles
from ._source_motion import SourceMotion

Source = HumanMotion | SourceMotion
_Checked = tuple[Source, Mapping[str, str]]


class Retargeter(OnRobot):
    """Retargets any number of clips to one robot; what does not depend on the clip is computed once.

    Args:
        robot: with a free base, two legs and two arms; x forward, y left, z up at home.
        profile: how the robot is seen. None: the package's own for NAO, G1 and Talos, or a guess (``find_profile``).
        acceleration: greatest acceleration of all joints, or by joint name or glob [rad/s^2 or m/s^2].
        smoothness: what is faster than about this time is smoothed out [s]: accelerations weigh, beside directions of
            limbs, with its fourth power. 0: nothing but what the profile's weights say. Changing it compiles nothing.
        balance: how far inside the edge of what stands the centre of mass is kept where both feet stand [m], and at
            most a third of that polygon's width; a bound of the plan. None: it is where it falls.
        max_iterations: of the plan.

    Raises:
        ValueError: no two legs and two arms are found, or a number is out of range.
        KeyError: the profile or ``acceleration`` names something that the robot does not have.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        profile: Profile | None = None,
        acceleration: float | Mapping[str, float] = ACCELERATION,
        smoothness: float = 0.0,
        balance: float | None = None,
        max_iterations: int = 100,
    ):
        super().__init__(robot, profile, acceleration, balance)
        if not (np.isfinite(smoothness) and smoothness >= 0.0):
            raise OsikValueError(f"smoothness is {smoothness}; it is a time in seconds, 0 or more")
        self.smoothness = smoothness
        self.max_iterations = max_iterations

    def retarget(
        self, motion: Source, *, mapping: Mapping[str, str] | None = None, fps: float | None = None
    ) -> Retargeted:
        """The robot does what a person did; see ``retarget``."""
        clip = self._prepared(motion, mapping, fps)
        weights = self.profile.weights.smoother(self.smoothness, clip.dt)
        plan = make_plan(self._body, clip.goals, weights, clip.bounds, clip.start, self.max_iterations)
        q, off = follow(self.robot, plan.q, self.limits, clip.dt)
        return self._finished(clip, Solved(q, off, plan.iterations, plan.cost))

    def retarget_all(
        self,
        motions: Sequence[Source],
        *,
        mapping: Mapping[str, str] | None = None,
        fps: float | None = None,
        chunk: int = 32,
        out: str | os.PathLike[str] | None = None,
        progress: bool = True,
    ) -> list[Retargeted]:
        """Many clips of any lengths, some at a time, in one program for all clips of about one length.

        Args:
            motions: the clips.
            mapping: as of ``retarget``, the same for all.
            fps: as of ``retarget``.
            chunk: how many are worked on at once, and saved in ``out``; about 100 kB of memory a frame of each. On a
                CPU without ``out`` as many are as there are cores.
            out: a folder for what is finished, so that a job that was killed goes on where it was
                (``osik_jax.scaling.run_in_chunks``). None: none.
            progress: whether to show a bar.

        Returns:
            the results, in the order of the clips.

        Raises:
            ValueError, KeyError: as of ``retarget``; the message starts with the clip's name.
        """
        checked = [checked_by_name(motion, mapping, fps) for motion in motions]
        if out is None and one_a_core():
            with ThreadPoolExecutor(cores()) as pool, reported(len(checked), 0, progress, "clips") as advance:
                made = []
                for one in pool.map(self._made_by_a_core, checked):
                    made.append(one)
                    advance(1)
            return made
        clips = [self._read(*motion) for motion in checked]
        groups: dict[int, list[int]] = {}
        for i, clip in enumerate(clips):
            groups.setdefault(shared_length(clip), []).append(i)
        found: dict[int, Retargeted] = {}
        for length, members in sorted(groups.items()):
            lanes = [as_lane(clips[i], length) for i in members]
            solved = run_in_chunks(
                solve_side_by_side,
                jax.tree.map(lambda *leaves: np.stack(leaves), *lanes),
                chunk=even(len(members), chunk),
                shared=self._shared,
                out=None if out is None else Path(out) / f"frames_{length}",
                progress=progress,
                unit="clips",
            )
            results = solved[:] if isinstance(solved, Saved) else solved
            for lane, i in enumerate(members):
                found[i] = self._finished(clips[i], jax.tree.map(lambda leaf, lane=lane: leaf[lane], results))
        return [found[i] for i in range(len(clips))]

    def _prepared(self, motion: Source, mapping: Mapping[str, str] | None, fps: float | None) -> Clip:
        """What a clip asks for, in the form that is computed with."""
        return self._read(*_checked(motion, mapping, fps))

    def _read(self, motion: Source, roles: Mapping[str, str]) -> Clip:
        """The same of a clip that can be read, whose joints have these names."""
        person = motion.person() if isinstance(motion, SourceMotion) else read_person(motion, roles)
        goals = self._build.goals(person)
        goals, start = padded(goals, self._build.first_guess(goals), -motion.frames % LENGTHS)
        dt = 1.0 / motion.fps
        return Clip(person, motion.frames, goals, start, self._bounds(dt), dt)

    def _solved(self, clips: Sequence[Clip], length: int, lanes: int) -> list[Callable[[], Retargeted]]:
        """Clips of at most so many frames (``shared_length`` or more).

        ``lanes`` is of how many clips the program is that works on all at once, where there is one: at least these.

        Returns:
            for each clip a function that makes its record; it raises ValueError where the motion is not finite.
        """
        batch = [as_lane(clip, length) for clip in clips]
        if not one_a_core():
            batch += batch[-1:] * (lanes - len(batch))
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *batch)
        results = jax.tree.map(np.asarray, solve_side_by_side(stacked, *self._shared))
        return [
            partial(self._finished, clip, jax.tree.map(lambda leaf, lane=lane: leaf[lane], results))
            for lane, clip in enumerate(clips)
        ]

    @property
    def _shared(self) -> tuple[Any, ...]:
        """What all lanes have in common, as ``solve_lanes`` takes it."""
        smoothness = np.asarray(self.smoothness, self._build.start.dtype)
        return self._body, self.profile.weights, self.limits, np.asarray(self.max_iterations), smoothness

    def _made_by_a_core(self, checked: _Checked) -> Retargeted:
        """A clip from reading to its record: while one thread holds Python's lock for that, others compute."""
        clip = self._read(*checked)
        solved = solve_lane(as_lane(clip, shared_length(clip)), *self._shared)
        return self._finished(clip, jax.tree.map(np.asarray, solved))

    def _finished(self, clip: Clip, solved: Solved) -> Retargeted:
        q, off = (np.asarray(part)[: clip.frames] for part in (solved.q, solved.off_plan))
        cost = float(solved.cost[0]), float(solved.cost[1])
        made = as_retargeted(self.robot, self.profile, clip.person, q, off)
        return dataclasses.replace(made, iterations=int(solved.iterations), cost=cost)


def _checked(motion: Source, mapping: Mapping[str, str] | None, fps: float | None) -> _Checked:
    """A clip at the rate that is asked for, if it can be retargeted, and its joints by role."""
    motion = motion if fps is None else motion.resampled(fps)
    if motion.frames < 3:
        raise OsikValueError(f"the clip has {motion.frames} frames; it takes three to have an acceleration")
    return motion, {} if isinstance(motion, SourceMotion) else find_roles(motion.joint_names, mapping)


def checked_by_name(motion: Source, mapping: Mapping[str, str] | None, fps: float | None) -> _Checked:
    try:
        return _checked(motion, mapping, fps)
    except (ValueError, KeyError) as error:
        raise type(error)(f"{motion.name}: {error.args[0]}") from error


def retarget(
    robot: Robot,
    motion: Source,
    *,
    profile: Profile | None = None,
    mapping: Mapping[str, str] | None = None,
    fps: float | None = None,
    acceleration: float | Mapping[str, float] = ACCELERATION,
    smoothness: float = 0.0,
    balance: float | None = None,
    max_iterations: int = 100,
) -> Retargeted:
    """The robot does what a person did: limbs in the same directions, feet that stay where they stand.

    Two passes. The plan looks at all frames at once: directions of limbs, turns of pelvis, chest and feet, and the path
    of the hips, scaled by the legs, are wishes with weights. That heels and toes that stand do not move and are at
    height 0, that nothing is below the floor, that shapes are apart and joints inside their ranges, speeds and
    accelerations, weighs a thousand times more and up. The last pass follows the plan inside limits of position, speed
    and acceleration that hold exactly; ``Retargeted.off_plan`` says by how much they held it back.

    Args:
        robot: with a free base, two legs and two arms; x forward, y left, z up at home.
        motion: the clip of a person, or of another robot (``SourceMotion``).
        profile: how the robot is seen. None: the package's own for NAO, G1 and Talos, or a guess (``find_profile``).
        mapping: role to the clip's name of it, see ``find_roles``. None: by the names that files use.
        fps: frames a second of the result; None: the clip's.
        acceleration: greatest acceleration of all joints, or by joint name or glob [rad/s^2 or m/s^2].
        smoothness: what is faster than about this time is smoothed out [s]; 0: nothing (see ``Retargeter``).
        balance: how far inside the edge of what stands the centre of mass is kept where both feet stand [m]; None: it
            is where it falls (see ``Retargeter``).
        max_iterations: of the plan.

    Raises:
        ValueError: the clip has no three frames, joints that are needed are missing from it, or the robot has no two
            legs and two arms.
        KeyError: the profile or ``acceleration`` names something that the robot does not have.
    """
    own = Retargeter(
        robot,
        profile=profile,
        acceleration=acceleration,
        smoothness=smoothness,
        balance=balance,
        max_iterations=max_iterations,
    )
    return own.retarget(motion, mapping=mapping, fps=fps)
