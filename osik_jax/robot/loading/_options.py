"""Options of loading: one record that all readers pass on."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from ..._errors import OsikTypeError

LockedJoints: TypeAlias = Iterable[str] | Mapping[str, float]
PositionLimits: TypeAlias = Mapping[str, tuple[float, float]]


class LoadOptions(NamedTuple):
    """The keywords of ``load_robot`` and of ``Robot``'s constructors, which say what each means.

    A new keyword is a field here, and one in the signature of those who offer it; readers take what they honour and
    hand on the whole. ``home`` is no field, because it is looked at when there is a robot. ``has_home`` says whether
    one is given, so that nothing is said of the keyframe that it replaces.
    """

    floating_base: bool | None = None
    velocity_limits: Mapping[str, float] | None = None
    position_limits: PositionLimits | None = None
    locked_joints: LockedJoints = ()
    package_dirs: Iterable[str | os.PathLike[str]] = ()
    root: str | Sequence[str] | None = None
    has_home: bool = False

    def checked(self) -> LoadOptions:
        """Return these options; raise TypeError unless ``floating_base`` is True, False or None."""
        value = self.floating_base
        if value is not None and not isinstance(value, bool | np.bool_):
            raise OsikTypeError(f"floating_base is {value!r}; it is True, False, or None: what the file says")
        return self._replace(floating_base=None if value is None else bool(value))
