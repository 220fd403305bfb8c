"""Report of the elements of a file that a robot does not keep."""

from __future__ import annotations

from typing import NamedTuple


class LoadNote(NamedTuple):
    """One element of a file that a robot does not keep as the file has it.

    Attributes:
        element: its kind, in the words of the format: ``"tendon equality"``, ``"safety_controller"``.
        name: the element's name, or that of the joint, link or geom that it belongs to.
        done: what the robot does instead.
    """

    element: str
    name: str
    done: str

    def __str__(self) -> str:
        return f"{self.element} {self.name!r}: {self.done}"


class LoadReport(tuple[LoadNote, ...]):
    """Elements of a file that constrain motion, or give masses, and that the robot does not keep.

    A tuple of ``LoadNote``; ``print(robot.load_report)`` shows it as a table.
    """

    def __str__(self) -> str:
        if not self:
            return "everything in the file that constrains motion is kept"
        head = LoadNote("element", "name", "what was done instead")
        first, second = (max(len(note[k]) for note in (head, *self)) for k in range(2))
        return "\n".join(f"{note.element:<{first}}  {note.name:<{second}}  {note.done}" for note in (head, *self))
