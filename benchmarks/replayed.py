"""Clips through a live retargeter, frame by frame."""

import dataclasses
from collections.abc import Callable

import numpy as np

from osik_jax.retargeting import HumanMotion, LiveRetargeter, Retargeted
from osik_jax.retargeting._live import LiveFrame
from osik_jax.retargeting._person import read_person


def replay(make: Callable[[HumanMotion], LiveRetargeter], motion: HumanMotion) -> tuple[Retargeted, list[LiveFrame]]:
    """Retarget a clip frame by frame, as fast as frames are computed; ``make`` is given the clip to measure."""
    live = make(motion)
    for _ in range(live.frames_ahead + 2):  # so that all is compiled when the first frame comes
        live.step(motion.positions[0])
    live.reset()
    contacts = [None] * motion.frames if motion.contact is None else motion.contact
    found = [live.step(positions, contact) for positions, contact in zip(motion.positions, contacts, strict=True)]
    frames = [frame for frame in found if frame is not None] + live.finish()
    q, contact, off = (np.array([getattr(frame, name) for frame in frames]) for name in ("q", "contact", "off_plan"))
    person = dataclasses.replace(read_person(motion, live.roles), contact=contact)
    return Retargeted.of(live.robot, live.profile, person, q, off), frames
