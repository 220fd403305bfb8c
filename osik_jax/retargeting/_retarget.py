"""Retargeting of recorded clips, one or many, to one robot."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import starmap
from typing import Any, NamedTuple, NoReturn

import jax
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikValueError
from .._progress import reported
from ..execution._platform import cpu_is_default
from ..execution._workers import cores
from ..limits import Limit
from ..numerics._arguments import check_count
from ..robot import Robot
from ._body import TouchGoal
from ._finish import follow
from ._goals import Goals, Weights
from ._motion import HumanMotion
from ._on_robot import ACCELERATION, OnRobot
from ._person import Person, read_person, with_path
from ._plan import make_plan
from ._profile import Limb, Profile
from ._retargeted import Retargeted
from ._source_motion import SourceMotion
from ._terms import Body, Bounds

Source = HumanMotion | SourceMotion
LENGTHS = 16
"""Programs are compiled for multiples of this number of frames."""


class Solved(NamedTuple):
    """Results of both passes; for several clips every leaf has a leading axis."""

    q: Array
    off_plan: Array
    iterations: Array
    cost: Array


class Clip(NamedTuple):
    """One clip as arrays for planning."""

    person: Person
    frames: int
    goals: Goals
    start: np.ndarray
    bounds: Bounds
    dt: float
    touches: tuple[TouchGoal, ...] = ()

    @property
    def touching(self) -> tuple[Limb, ...]:
        """Return the pairs that are held together."""
        return tuple((touch.first, touch.second) for touch in self.touches)


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
        check_count("max_iterations", max_iterations)
        self.smoothness = smoothness
        self.max_iterations = max_iterations

    def retarget(
        self, motion: Source, *, mapping: Mapping[str, str] | None = None, fps: float | None = None
    ) -> Retargeted:
        """Retarget one clip; see the function ``retarget``."""
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
        reads, found = [], dict[int, Retargeted]()
        for motion in motions:
            try:
                reads.append(partial(self._read, *self._checked(motion, mapping, fps)))
            except (ValueError, KeyError) as error:
                raise type(error)(f"{motion.name}: {error.args[0]}") from error

        def keep(number: int, make: Callable[[], Retargeted]) -> None:
            found[number] = make()

        with reported(len(reads), 0, progress, "clips") as advance:
            for _ in self._each(reads, keep, chunk):
                advance(1)
        return [found[number] for number in range(len(reads))]

    def _each(
        self, reads: Sequence[Callable[[], Clip]], finish: Callable[[int, Callable[[], Retargeted]], None], chunk: int
    ) -> Generator[None, None, None]:
        """Retarget clips: on CPUs one clip in a thread of each core, on a GPU batches of ``chunk`` clips.

        Compiled code needs no GIL, so threads run side by side. ``finish`` is called with the number of each clip and a
        function that returns its result, or raises the error of its reader. Yields after each clip.
        """
        if cpu_is_default():
            makers = [partial(self._read_and_made, read) for read in reads]
            with ThreadPoolExecutor(cores()) as pool:
                yield from pool.map(finish, range(len(reads)), makers)
            return
        lanes, waiting = min(chunk, len(reads)), dict[tuple[int, tuple[Limb, ...]], list[tuple[int, Clip]]]()
        for number, read in enumerate(reads):
            try:
                clip = read()
            except Exception as error:  # a broken file may raise anything in a reader
                yield finish(number, partial(_raise, error))
                continue
            alike = shared_length(clip), clip.touching
            waiting.setdefault(alike, []).append((number, clip))
            if len(waiting[alike]) == lanes:
                yield from starmap(finish, self._solved(waiting.pop(alike), alike[0], lanes))
        for (length, _), clips in waiting.items():
            yield from starmap(finish, self._solved(clips, length, lanes))

    def _prepared(self, motion: Source, mapping: Mapping[str, str] | None, fps: float | None) -> Clip:
        """Return a clip as arrays for planning, after checking it."""
        return self._read(*self._checked(motion, mapping, fps))

    def _checked(
        self, motion: Source, mapping: Mapping[str, str] | None, fps: float | None
    ) -> tuple[Source, Mapping[str, str]]:
        """Return a clip at the requested rate and its joints by role; raise ValueError if it cannot be retargeted."""
        motion = motion if fps is None else motion.resampled(fps)
        if motion.frames < 3:
            raise OsikValueError(f"the clip has {motion.frames} frames; it takes three to have an acceleration")
        return motion, self._roles(motion, mapping)

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
        bounds = self._build.bounds(self._acceleration, dt)
        return Clip(person, motion.frames, goals, start, bounds, dt, self._build.touches(person))

    def _solved(
        self, clips: Sequence[tuple[int, Clip]], length: int, lanes: int
    ) -> Iterator[tuple[int, Callable[[], Retargeted]]]:
        """Retarget clips of at most ``length`` frames (``shared_length``) that hold the same, in one program.

        ``lanes``: the batch size of the program, at least the number of clips. Each function makes a clip's record; it
        raises ValueError where the motion is not finite.
        """
        batch = [as_lane(clip, length) for _, clip in clips]
        batch += batch[-1:] * (lanes - len(batch))
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *batch)
        results = jax.tree.map(np.asarray, solve_lanes(stacked, *self._shared(clips[0][1].touching)))
        for lane, (number, clip) in enumerate(clips):
            own = jax.tree.map(lambda leaf, lane=lane: leaf[lane], results)
            yield number, partial(self._finished, clip, own)

    def _shared(self, touching: tuple[Limb, ...]) -> tuple[Any, ...]:
        """Return the arguments of ``solve_lane`` that all lanes share."""
        smoothness = np.asarray(self.smoothness, self._build.start.dtype)
        return self._body_that(touching), self.profile.weights, self.limits, np.asarray(self.max_iterations), smoothness

    def _made(self, clip: Clip, length: int) -> Retargeted:
        """Retarget one clip by a program for ``length`` frames."""
        solved = solve_lane(as_lane(clip, length), *self._shared(clip.touching))
        return self._finished(clip, jax.tree.map(np.asarray, solved))

    def _read_and_made(self, read: Callable[[], Clip]) -> Retargeted:
        """Retarget one clip by a program for clips of similar length."""
        clip = read()
        return self._made(clip, shared_length(clip))

    def _finished(self, clip: Clip, solved: Solved) -> Retargeted:
        q, off = (np.asarray(part)[: clip.frames] for part in (solved.q, solved.off_plan))
        return Retargeted.of(
            self.robot, self.profile, clip.person, q, off,
            iterations=int(solved.iterations), cost=(float(solved.cost[0]), float(solved.cost[1])),
            objects=self._build.objects(clip.person), touches=clip.touches,
        )  # fmt: skip


def as_lane(clip: Clip, length: int) -> _Lane:
    """Return a clip as one lane of a batch, padded to ``length`` frames."""
    goals, start = padded(clip.goals, clip.start, length - len(clip.start))
    return jax.tree.map(np.asarray, (goals, start, clip.bounds, np.asarray(clip.dt)))


def shared_length(clip: Clip) -> int:
    """Return a padded length shared by clips of similar length: at most a quarter more, and few distinct values."""
    # steps of an eighth of the next power of two: at most a quarter is padding, with four lengths per doubling
    step = max(LENGTHS, (1 << (clip.frames - 1).bit_length()) // 8)
    return -(-clip.frames // step) * step


_Lane = tuple[Goals, Array, Bounds, Array]


@jax.jit
def solve_lane(
    lane: _Lane,
    body: Body,
    weights: Weights,
    limits: Sequence[Limit],
    max_iterations: Array,
    smoothness: Array | float = 0.0,
) -> Solved:
    goals, start, bounds, dt = lane
    plan = make_plan(body, goals, weights.smoother(smoothness, dt), bounds, start, max_iterations)
    q, off = follow(body.robot, plan.q, limits, dt)
    return Solved(q, off, plan.iterations, plan.cost)


@jax.jit
def solve_lanes(lanes: _Lane, *shared: Any) -> Solved:
    """Solve all lanes in one program; ``shared`` are the arguments of ``solve_lane`` after the lane."""
    return jax.vmap(lambda lane: solve_lane(lane, *shared))(lanes)


def padded(goals: Goals, start: Float[np.ndarray, "F nq"], more: int) -> tuple[Goals, Float[np.ndarray, "T nq"]]:
    """Return goals and first guess with ``more`` frames appended that do not count (``present`` is 0)."""
    frames = len(start)

    def longer(leaf: np.ndarray) -> np.ndarray:
        return np.concatenate([leaf, np.repeat(leaf[-1:], more, 0)])

    goals, start = jax.tree.map(longer, (goals, start))
    present = np.where(np.arange(frames + more) < frames, goals.present, 0.0).astype(start.dtype)
    return dataclasses.replace(goals, present=present, contact=goals.contact * present[:, None]), start


def _raise(error: Exception) -> NoReturn:
    raise error


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
