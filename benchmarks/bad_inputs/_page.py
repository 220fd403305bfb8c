"""The cases, what comes back, and the page of it."""

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

from ._accepted import accepted
from ._files import files
from ._models import folder
from ._problems import in_programs, limits, problems
from ._tasks import configurations, targets, tasks

PAGE = Path(__file__).parents[2] / "docs" / "dev" / "bad_inputs.md"
PACKAGE = str(Path(osik.__file__).parent)
_SHOWN = 80
"""Characters of a message that the page shows."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One input.

    Attributes:
        group: heading that it stands under.
        given: what is given, for people.
        run: gives it.
        error: exception or warning that comes back; None: none does.
        words: what the message says among other things; of an input that is accepted, why.
        status: that the answer has, of an input that raises nothing; None: it is no solution.
        foreign: whether the message goes on in words that are not ours or may change, which the page leaves out.
    """

    group: str
    given: str
    run: Callable[[], Any]
    error: type[Exception] | None
    words: str = ""
    status: osik.Status | None = None
    foreign: bool = False

    def message(self) -> str:
        """Of the exception, in one line; empty where there is none.

        Raises:
            AssertionError: anything else than what the case says happens.
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
    "Files": files,
    "Inside a program": in_programs,
    "Accepted": accepted,
}


@functools.cache
def cases() -> tuple[Case, ...]:
    """All of them, group by group."""
    found: list[Case] = []

    def adder(group: str) -> Callable[..., None]:
        return lambda *given, **more: found.append(Case(group, *given, **more))

    for group, collect in _GROUPS.items():
        collect(adder(group))
    return tuple(found)


def outcome(case: Case) -> str:
    """What the page says of it."""
    message = case.message().replace(str(folder()), "FOLDER")
    if case.error is None:
        return f"{case.status.name + ': ' if case.status is not None else ''}{case.words}".removesuffix(": ")
    if case.foreign:
        cut = message.find(case.words) + len(case.words)
        message = message[:cut] + " ..."
    shown = message if len(message) <= _SHOWN else message[:_SHOWN].rsplit(" ", 1)[0] + " ..."
    return f"{case.error.__name__}: {shown}"


def page(outcomes: dict[str, str]) -> str:
    """The page, of outcomes by what is given."""
    out = [_HEAD.format(count=len(outcomes))]
    for group in _GROUPS:
        rows = [case for case in cases() if case.group == group]
        column = "why" if group == "Accepted" else "gets"
        out.append(f"\n## {group}\n\n{_BEFORE.get(group, '')}| given | {column} |\n|---|---|\n")
        out += [f"| {_cell(case.given)} | {_cell(outcomes[case.given])} |\n" for case in rows]
    return "".join(out)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*").replace("[", "\\[")


_HEAD = """# Wrong inputs

{count} wrong inputs, and the exception or status of each. `python -m benchmarks.bad_inputs --write` writes this page.
`pytest tests/cli/test_bad_inputs.py` compares it with what happens. Long messages are cut.

An input that can be checked before a program runs raises an exception. Its message names what is wrong and what is
allowed. An input that is known only inside a program gives a status, and all numbers of the answer are finite.
"""
_BEFORE = {"Accepted": "Inputs that look wrong, and are valid or cannot be distinguished from valid ones.\n\n"}
