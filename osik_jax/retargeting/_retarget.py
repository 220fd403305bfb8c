"""Retargeting of recorded clips, one or many, to one robot."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import numpy as np

from .._errors import OsikValueError, warn
from .._progress import reported
from ..execution._platform import cpu_is_default
from ..execution._workers import cores
from ..numerics._arguments import check_count
from ..robot import Robot
from ._body import measured
from ._guess import describe_profile
from ._lanes import (
    LENGTHS,
    Clip,
    Solved,
    as_lane,
    even,
    padded,
    shared_length,
    solve_lane,
    solve_side_by_side,
)
from ._motion import HumanMotion
from ._on_robot import ACCELERATION, OnRobot
from ._person import read_person, with_path
from ._profile import Limb, Profile
from ._retargeted import Retargeted, as_retargeted
from ._source_motion import SourceMotion

Source = HumanMotion | SourceMotion
_Checked = tuple[Source, Mapping[str, str]]


class Retargeter(OnRobot):
    """Retargeter for any number of clips to one robot; data that does not depend on the clip is computed once.

    Args:
        robot: robot with limbs of a person (``guess_profile``), z up at home.
        profile: the robot's profile. None: a bundled one (NAO, G1, Talos) or a guess.
        acceleration: acceleration limit of all joints, or by joint name or glob [rad/s^2 or m/s^2].
        smoothness: time below which motion is smoothed out [s]: its fourth power is added to the weight of
            accelerations, relative to 1 for limb directions. 0: the profile's weights only. Changes do not recompile.
        balance: margin of the centre of mass inside the support polygon in double support [m], at most a third of the
            polygon's width; a bound of the optimisation. None: not bounded.
        max_iterations: most iterations of the optimisation over the whole clip.

    Raises:
        ValueError: no limbs are found, nothing holds a free base, or a number is out of range.
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
        max_iterations: int = 300,
    ):
        super().__init__(robot, profile, acceleration, balance)
        if not (np.isfinite(smoothness) and smoothness >= 0.0):
            raise OsikValueError(f"smoothness is {smoothness}; it is a time in seconds, 0 or more")
        self.smoothness = smoothness
        self.max_iterations = max_iterations
        self._less: dict[tuple[str, ...], Retargeter] = {}

    def _led_by(self, source: Profile) -> Retargeter:
        """Return the retargeter without the limbs that a source robot lacks; this one if none or all are lacking.

        An ``OsikWarning`` says which limbs are left out.
        """
        lacks = self._lacks(source)
        limbs = [limb for limb in self.profile.followed if set(lacks).isdisjoint(limb)]
        whole = len(limbs) == len(self.profile.followed)
        if whole or not limbs or (self.profile.walks and not set(measured(self.profile)) <= set(limbs)):
            return self
        if lacks not in self._less:
            own = self._less[lacks] = copy.copy(self)
            own._set_profile(self.profile.without(lacks))
            warn(
                f"the source robot has no {', '.join(lacks)}; this is followed: "
                f"{describe_profile(self.robot, own.profile)}"
            )
        return self._less[lacks]

    def _for(self, motion: Source) -> Retargeter:
        return self if isinstance(motion, HumanMotion) else self._led_by(motion.seen)

    def retarget(
        self, motion: Source, *, mapping: Mapping[str, str] | None = None, fps: float | None = None
    ) -> Retargeted:
        """Retarget one clip; see the function ``retarget``."""
        if (other := self._for(motion)) is not self:
            return other.retarget(motion, mapping=mapping, fps=fps)
        clip = self._prepared(motion, mapping, fps)
        return self._made(clip, len(clip.start))

    def retarget_all(
        self,
        motions: Sequence[Source],
        *,
        mapping: Mapping[str, str] | None = None,
        fps: float | None = None,
        chunk: int = 32,
        progress: bool = True,
    ) -> list[Retargeted]:
        """Retarget clips of any lengths in batches; clips of similar length share one compiled program.

        ``osik retarget FOLDER`` keeps each finished clip, so that an interrupted job resumes.

        Args:
            motions: the clips.
            mapping: as of ``retarget``, the same for all clips.
            fps: as of ``retarget``.
            chunk: clips per batch; takes about 100 kB of memory per frame of each clip. On a CPU, one clip per core.
            progress: whether to show a bar.

        Returns:
            the results, in the order of the clips.

        Raises:
            ValueError, KeyError: as of ``retarget``; the message starts with the clip's name.
        """
        check_count("chunk", chunk)
        if any(self._for(motion) is not self for motion in motions):
            return self._from_sources(motions, mapping=mapping, fps=fps, chunk=chunk, progress=progress)
        checked = [self._checked_by_name(motion, mapping, fps) for motion in motions]
        if cpu_is_default():
            with ThreadPoolExecutor(cores()) as pool, reported(len(checked), 0, progress, "clips") as advance:
                made = []
                for one in pool.map(self._made_by_a_core, checked):
                    made.append(one)
                    advance(1)
            return made
        clips = [self._read(*motion) for motion in checked]
        groups: dict[tuple[int, tuple[Limb, ...]], list[int]] = {}
        for i, clip in enumerate(clips):
            groups.setdefault((shared_length(clip), clip.touching), []).append(i)
        found: dict[int, Retargeted] = {}
        with reported(len(clips), 0, progress, "clips") as advance:
            for (length, _), members in sorted(groups.items()):
                size = even(len(members), chunk)
                for first in range(0, len(members), size):
                    some = members[first : first + size]
                    made = self._solved([clips[i] for i in some], length, size)
                    found |= {i: record() for i, record in zip(some, made, strict=True)}
                    advance(len(some))
        return [found[i] for i in range(len(clips))]

    def _from_sources(self, motions: Sequence[Source], **options: Any) -> list[Retargeted]:
        """Retarget clips of which some lack limbs, each by the retargeter of its limbs."""
        makers, found = [self._for(motion) for motion in motions], {}
        for own in dict.fromkeys(makers):
            members = [i for i, maker in enumerate(makers) if maker is own]
            found |= dict(zip(members, own.retarget_all([motions[i] for i in members], **options), strict=True))
        return [found[i] for i in range(len(motions))]

    def _prepared(self, motion: Source, mapping: Mapping[str, str] | None, fps: float | None) -> Clip:
        """Return a clip as arrays for planning, after checking it."""
        return self._read(*self._checked(motion, mapping, fps))

    def _checked(self, motion: Source, mapping: Mapping[str, str] | None, fps: float | None) -> _Checked:
        """Return a clip at the requested rate and its joints by role; raise ValueError if it cannot be retargeted."""
        motion = motion if fps is None else motion.resampled(fps)
        if motion.frames < 3:
            raise OsikValueError(f"the clip has {motion.frames} frames; it takes three to have an acceleration")
        return motion, self._roles(motion, mapping)

    def _checked_by_name(self, motion: Source, mapping: Mapping[str, str] | None, fps: float | None) -> _Checked:
        try:
            return self._checked(motion, mapping, fps)
        except (ValueError, KeyError) as error:
            raise type(error)(f"{motion.name}: {error.args[0]}") from error

    def _read(self, motion: Source, roles: Mapping[str, str]) -> Clip:
        """Return a checked clip as arrays for planning; ``roles`` maps roles to the clip's joint names."""
        if isinstance(motion, SourceMotion):
            own = motion.person()
        else:
            own = read_person(with_path(motion, roles), roles, standing=self.profile.standing)
        person = self._build.seen(own)
        goals = self._build.goals(person)
        goals, start = padded(goals, self._build.first_guess(goals), -motion.frames % LENGTHS)
        dt = 1.0 / motion.fps
        return Clip(person, motion.frames, goals, start, self._bounds(dt), dt, self._build.touches(person))

    def _solved(self, clips: Sequence[Clip], length: int, lanes: int) -> list[Callable[[], Retargeted]]:
        """Retarget clips of at most ``length`` frames (``shared_length`` or more) that hold the same.

        ``lanes``: the batch size of the compiled program, at least the number of clips. Each returned function makes a
        clip's record; it raises ValueError where the motion is not finite.
        """
        batch = [as_lane(clip, length) for clip in clips]
        if not cpu_is_default():
            batch += batch[-1:] * (lanes - len(batch))
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *batch)
        results = jax.tree.map(np.asarray, solve_side_by_side(stacked, *self._shared(clips[0].touching)))
        return [
            partial(self._finished, clip, jax.tree.map(lambda leaf, lane=lane: leaf[lane], results))
            for lane, clip in enumerate(clips)
        ]

    def _shared(self, touching: tuple[Limb, ...]) -> tuple[Any, ...]:
        """Return the arguments of ``solve_lane`` that all lanes share."""
        smoothness = np.asarray(self.smoothness, self._build.start.dtype)
        return self._body_that(touching), self.profile.weights, self.limits, np.asarray(self.max_iterations), smoothness

    def _made_by_a_core(self, checked: _Checked) -> Retargeted:
        """Retarget one checked clip in one thread; compiled code needs no GIL, so threads take clips side by side."""
        clip = self._read(*checked)
        return self._made(clip, shared_length(clip))

    def _made(self, clip: Clip, length: int) -> Retargeted:
        """Retarget one clip by a program for ``length`` frames."""
        solved = solve_lane(as_lane(clip, length), *self._shared(clip.touching))
        return self._finished(clip, jax.tree.map(np.asarray, solved))

    def _finished(self, clip: Clip, solved: Solved) -> Retargeted:
        q, off = (np.asarray(part)[: clip.frames] for part in (solved.q, solved.off_plan))
        cost = float(solved.cost[0]), float(solved.cost[1])
        made = as_retargeted(self.robot, self.profile, clip.person, q, off)
        objects = self._build.objects(clip.person) if clip.person.objects else {}
        return dataclasses.replace(
            made, iterations=int(solved.iterations), cost=cost, objects=objects, touches=clip.touches
        )


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
    max_iterations: int = 300,
) -> Retargeted:
    """Retarget a person's motion to a robot: limbs keep their directions, standing feet keep their place.

    The plan optimises all frames at once. Weighted goals are limb directions, orientations of pelvis, chest and feet,
    and the hip path scaled by leg length. Contacts at height 0 that do not move, clearance above the floor and between
    shapes, and limits of position, speed and acceleration weigh at least a thousand times more. The last pass follows
    the plan inside limits of position, speed and acceleration that hold exactly; ``Retargeted.off_plan`` is the
    remaining distance.

    Args:
        robot: robot with limbs of a person (``guess_profile``), z up at home.
        motion: clip of a person, or of another robot (``SourceMotion``).
        mapping: role to joint name of a person's clip. None: by common names.
        fps: frame rate of the result [1/s]; None: that of the clip.
        profile: as in ``Retargeter``.
        acceleration: as in ``Retargeter``.
        smoothness: as in ``Retargeter``.
        balance: as in ``Retargeter``.
        max_iterations: as in ``Retargeter``.

    Raises:
        ValueError: the clip has fewer than three frames or lacks a needed joint, the robot has no limbs of a person,
            or ``mapping`` comes with a robot's motion.
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
