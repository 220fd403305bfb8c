"""Calibrations and placements."""

# pyright: reportArgumentType=false
from __future__ import annotations

from typing import Any

import numpy as np

import osik_jax as osik
from osik_jax import calibration as cal
from osik_jax.placement import place_base, place_robots

from ._given import Add, F, K, T, V, arm
from ._models import folder

_POSES = {"hand": np.array([[0.3, 0.0, 0.4], [0.3, 0.1, 0.4]])}


def _place(poses: Any = None, **more: Any) -> Any:
    return place_base(arm(), _POSES if poses is None else poses, **(dict(x=0.0, y=0.0, yaw=1, refine=0) | more))


def _calibrate(unknowns: Any = None, measured: Any = None, **more: Any) -> Any:
    unknowns = [cal.Unknown("joint_offset", "joint2")] if unknowns is None else unknowns
    return cal.calibrate(arm(), _points() if measured is None else measured, unknowns, **more)


def _points(frame: str = "hand", **more: Any) -> cal.Points:
    given = dict(q=np.zeros((4, 7)), position=np.zeros((4, 3))) | more
    return cal.Points(frame, given.pop("q"), given.pop("position"), **given)


def _poses(rotation: np.ndarray) -> cal.Poses:
    return cal.Poses("hand", np.zeros((4, 7)), np.zeros((4, 3)), np.tile(rotation, (4, 1, 1)))


def _contacts(height: Any) -> cal.PlaneContacts:
    return cal.PlaneContacts("hand", "table", np.zeros((4, 7)), height=height)


def _pixels(point: Any) -> cal.Pixels:
    return cal.Pixels("hand", "camera", np.zeros((4, 7)), np.zeros((4, 2)), (600, 600, 320, 240), point=point)


def _candidates(candidates: Any) -> Any:
    return cal.next_poses(arm(), _points(), [cal.Unknown("joint_offset", "joint2")], 1, candidates=candidates)


def _file(text: str) -> Any:
    path = folder() / "measured.csv"
    path.write_text(text)
    return cal.read_measurements(path, arm(), "hand")


def placements(add: Add) -> None:
    add("bases: coordinates that fall", lambda: _place(x=[1.0, 0.0]), V, "numbers that increase")
    add("bases: a text for y", lambda: _place(y="wide"), T, "np.linspace")
    add("bases: a NaN in height", lambda: _place(height=np.nan), V, "finite")
    add("bases: no yaw", lambda: _place(yaw=0), V, "yaw")
    add("bases: poses as a list", lambda: _place([np.zeros(3)]), V, "name of a frame")
    add("bases: a misspelt frame", lambda: _place({"hnd": np.zeros(3)}), K, "did you mean 'hand'")
    add("bases: positions of two numbers", lambda: _place({"hand": np.zeros((4, 2))}), V, "a position is (3,)")
    add("bases: a frame that stands still", lambda: _place({"world": np.zeros(3)}), V, "no joint")
    add("bases: a scene as a dictionary", lambda: _place(scene={}), T, "osik_jax.Scene")
    add("bases: a stack of scenes", lambda: _place(scene=osik.Scene.stack([osik.Scene()])), V, "give one scene")
    add("bases: a negative clearance", lambda: _place(clearance=-0.01), V, "0 or more, in metres")
    add("bases: a tolerance of 0", lambda: _place(position_tolerance=0.0), V, "one positive number")
    add("bases: q0 of another length", lambda: _place(q0=np.zeros(3)), V, "q has shape (3,)")
    add("bases: a number for the footprint", lambda: _place(scene=osik.Scene(), footprint=0.3), T, "CollisionShapes")
    add("bases: a negative number of refinements", lambda: _place(refine=-1), V, "refine")
    add("robots: one placement", lambda: place_robots({"left": _place()}), V, "two placements or more")
    add("robots: a list of numbers", lambda: place_robots([1, 2]), T, "its Placement")
    add("robots: placements without a scene", lambda: place_robots(dict.fromkeys("ab", _place())), V, "no scene")


def calibrations(add: Add) -> None:
    add("calibration: a misspelt quantity", lambda: cal.Unknown("joint_ofset"), K, "did you mean 'joint_offset'")
    add("calibration: no such joint", lambda: _calibrate([cal.Unknown("joint_offset", "jnt2")]), K, "joint2")
    add("calibration: axes that are none", lambda: cal.Unknown("body_position", "link3", axes="w"), V, "xyz")
    add("calibration: a negative prior", lambda: cal.Unknown("joint_offset", prior=-1.0), V, "prior")
    add("calibration: nothing unknown", lambda: _calibrate([]), V, "unknown")
    add("calibration: no measurements", lambda: _calibrate(measured=[]), V, "measurement")
    add("calibration: a number for the unknowns", lambda: _calibrate(3), T, "unknowns is a sequence")
    add("calibration: a number for the measurements", lambda: _calibrate(measured=3), T, "a measurement is a int")
    add("calibration: a rank tolerance of NaN", lambda: _calibrate(rank_tolerance=np.nan), V, "rank_tolerance")
    add("calibration: no readings", lambda: _points(q=np.zeros((0, 7)), position=np.zeros((0, 3))), V, "readings is 0")
    add("calibration: rotations of length 2", lambda: _poses(2.0 * np.eye(3)), V, "rotations that are none")
    add("calibration: seven heights for 4 readings", lambda: _contacts([0.0] * 7), V, "(4,)")
    add("calibration: an infinite height", lambda: _contacts(np.inf), V, "finite")
    add("calibration: three points for 4 readings", lambda: _pixels(np.zeros((3, 3))), V, "(4, 3)")
    add("calibration: candidates of 6 joints", lambda: _candidates(np.zeros((9, 6))), V, "(n, 7)")
    add("calibration: a misspelt frame", lambda: _calibrate(measured=_points("hnd")), K, "did you mean 'hand'")
    add("calibration: other numbers of readings", lambda: _points(position=np.zeros((3, 3))), V, "4")
    add("calibration: a NaN in a reading", lambda: _points(position=np.full((4, 3), np.nan)), V, "finite")
    add("calibration: a sigma of 0", lambda: _points(sigma=0.0), V, "sigma")
    add("calibration: joints of another robot", lambda: _calibrate(measured=_points(q=np.zeros((4, 6)))), V, "7")
    add("calibration: a loss that is none", lambda: _calibrate(loss="tukey"), V, "geman_mcclure")
    add("calibration: a file without a joint", lambda: _file("x,y,z\n0,0,0\n"), V, "no column is a joint")
    add("calibration: a file with a text", lambda: _file("joint1,x,y,z\n0,0,0,a\n"), V, "4 numbers")
    add("calibration: a column that is no joint", lambda: _file("jnt1,x,y,z\n0,0,0,0\n"), K, "jnt1")
    add("calibration: no such file", lambda: cal.read_measurements("gone.csv", arm(), "hand"), F, "gone.csv")
