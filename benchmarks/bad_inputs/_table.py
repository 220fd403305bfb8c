"""The cases, their outcomes, and the table of both."""

from __future__ import annotations

import dataclasses
import functools
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

import osik_jax as osik
from benchmarks.data_file import DOCS

from ._accepted import accepted
from ._files import files
from ._models import folder
from ._motions import motions
from ._places import calibrations, placements
from ._problems import in_programs, limits, problems
from ._tasks import configurations, targets, tasks

TABLE = DOCS / "dev" / "bad_inputs.csv"
HEAD = ["group", "given", "gets"]
PACKAGE = str(Path(osik.__file__).parent)
_SHOWN = 80
"""Most characters of a message in the table."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One input and its expected outcome.

    Attributes:
        group: group of the table.
        given: description of the input.
        run: function that passes the input to the library.
        error: expected exception or warning; None: no exception.
        words: text that the message contains; the reason if the input is accepted.
        status: expected status of the answer; None: an exception, or an answer without a status.
        foreign: whether the rest of the message is another library's or varies; the table cuts it.
    """

    group: str
    given: str
    run: Callable[[], Any]
    error: type[Exception] | None
    words: str = ""
    status: osik.Status | None = None
    foreign: bool = False

    def message(self) -> str:
        """Run the case; return the exception's message in one line, empty without an exception.

        Raises:
            AssertionError: the outcome is not the expected one.
        """
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", osik.OsikWarning)
                answer = self.run()
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1].filename
            own = type(error).__bases__ if isinstance(error, osik.OsikError) else (type(error),)
            assert self.error in own, f"{self.given}: {type(error)}: {error}"
            assert last.startswith(PACKAGE), f"{self.given}: raised in {last}"
            text = str(error.args[0] if isinstance(error, KeyError) else error)
            assert self.words in text, f"{self.given}: {self.words!r} is not in {text!r}"
            return " ".join(text.split())
        assert self.error is None, f"{self.given}: nothing was raised"
        if self.status is not None:
            found = answer if isinstance(answer, jax.Array) else answer.status
            assert int(found) == self.status, f"{self.given}: {osik.Status(int(found)).name}"
        return ""


_GROUPS = {
    "Robots and configurations": configurations,
    "Targets": targets,
    "Tasks": tasks,
    "Problems": problems,
    "Limits": limits,
    "Motions": motions,
    "Files": files,
    "Placement": placements,
    "Calibration": calibrations,
    "Inside a program": in_programs,
    "Accepted": accepted,
}


@functools.cache
def cases() -> tuple[Case, ...]:
    """Return all cases, group by group."""
    found: list[Case] = []

    def adder(group: str) -> Callable[..., None]:
        return lambda *given, **more: found.append(Case(group, *given, **more))

    for group, collect in _GROUPS.items():
        collect(adder(group))
    return tuple(found)


def outcome(case: Case) -> str:
    """Run a case and return its outcome as the table shows it."""
    message = case.message().replace(str(folder()), "FOLDER")
    if case.error is None:
        return f"{case.status.name + ': ' if case.status is not None else ''}{case.words}".removesuffix(": ")
    if case.foreign:
        cut = message.find(case.words) + len(case.words)
        message = message[:cut] + " ..."
    shown = message if len(message) <= _SHOWN else message[:_SHOWN].rsplit(" ", 1)[0] + " ..."
    return f"{case.error.__name__}: {shown}"


def table(outcomes: dict[str, str]) -> list[list[str]]:
    """Return the rows of the table, from the outcome of each input."""
    return [[case.group, case.given, outcomes[case.given]] for case in cases()]
