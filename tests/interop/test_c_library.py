"""The C library, built by CMake: steps without Python are those of ``solve``, and what it says of other files."""

import ctypes
import os
import shutil
import subprocess
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from made_up_arm import SIX_JOINTS
from refusals import refuses

import osik_jax as osik
from osik_jax.core import _build
from osik_jax.core._library import core

SOURCES = _build.FOLDER / "c"
STORED = Path(__file__).parents[1] / "data" / "controller_3.json"
COMPILER = shutil.which(os.environ.get("CXX") or "c++")
COUNT = 10_000
pytestmark = [
    pytest.mark.slow,  # half a minute of compiling
    pytest.mark.skipif(COMPILER is None, reason="THE C LIBRARY IS NOT TESTED: no C++ compiler"),
]
SCHEMES = {
    "weighted": osik.WeightedQP,
    "hierarchy": osik.HierarchicalQP,
    "null-space": osik.NullSpace,
    "saturated": partial(osik.NullSpace, method="saturated"),
}


def run(*command: Any, **options: Any) -> str:
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, **options)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the library, its header and the example are installed; without CMake they are compiled directly.

    It has the instruction set of the core that Python has loaded: rounding is another one's by up to 1e-12.
    """
    folder, prefix = tmp_path_factory.mktemp("build"), tmp_path_factory.mktemp("osik")
    own = core().path
    flags = _build.levels().get(own.stem.removeprefix("_core_"), []) if own else []
    if shutil.which("cmake"):
        options = dict(CMAKE_INSTALL_PREFIX=prefix, CMAKE_INSTALL_LIBDIR="lib", CMAKE_CXX_FLAGS=" ".join(flags))
        run("cmake", "-S", SOURCES, "-B", folder, *(f"-D{name}={value}" for name, value in options.items()))
        run("cmake", "--build", folder)
        run("cmake", "--install", folder)
        shutil.copy(folder / "follow", prefix)
        return prefix
    library = prefix / "lib" / "libosik.so"
    library.parent.mkdir()
    run(COMPILER, *_build._FLAGS, *flags, "-shared", "-fPIC", SOURCES / "controller.cpp", "-o", library)
    shutil.copytree(SOURCES, prefix / "include")
    run(
        COMPILER, "-std=c++17", SOURCES / "follow.cpp", library, f"-Wl,-rpath,{library.parent}", "-o", prefix / "follow"
    )
    return prefix


Q, VELOCITY, TARGETS = range(3)


class Controller:
    """A controller of the library, by ctypes."""

    def __init__(self, built: Path, path: Path) -> None:
        found = next((built / "lib").glob("libosik.*"))
        self.library = library = ctypes.CDLL(str(found))
        library.osik_load.restype = ctypes.c_void_p
        library.osik_name.restype, library.osik_period.restype = ctypes.c_char_p, ctypes.c_double
        message = ctypes.create_string_buffer(300)
        self.handle = ctypes.c_void_p(library.osik_load(str(path).encode(), message, len(message)))
        if not self.handle:
            raise ValueError(message.value.decode())
        self.sizes = [library.osik_size(self.handle, vector) for vector in range(3)]

    def __del__(self) -> None:
        self.library.osik_free(self.handle)

    def names(self, vector: int) -> list[str]:
        return [self.library.osik_name(self.handle, vector, i).decode() for i in range(self.sizes[vector])]

    def initial(self, vector: int) -> np.ndarray:
        values = np.zeros(self.sizes[vector])
        self.library.osik_initial(self.handle, vector, at(values))
        return values

    def step(self, q: np.ndarray, targets: np.ndarray | None) -> tuple[int, np.ndarray]:
        velocity = np.full(self.sizes[VELOCITY], np.nan)
        return self.library.osik_step(
            self.handle, at(q), None if targets is None else at(targets), at(velocity)
        ), velocity

    def integrate(self, q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        self.library.osik_integrate(self.handle, at(q), at(velocity), at(end := np.zeros_like(q)))
        return end


def at(array: np.ndarray) -> ctypes.c_void_p:
    assert array.dtype == np.float64 and array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


def arm() -> tuple[osik.Robot, dict[str, osik.Task]]:
    robot = osik.Robot.from_mjcf(SIX_JOINTS).with_home(
        np.array([0.3, -0.8, 1.2, -0.4, 1.2, 0.2])
    )  # away from singularities
    hand = osik.FrameTask(robot, "tool", orientation_weight=0.3)
    return robot, {"hand": hand, "rest": osik.PostureTask(robot, priority=2)}


def nao() -> tuple[osik.Robot, dict[str, osik.Task]]:
    robot = osik.load_robot("nao")
    feet = {foot: osik.FrameTask(robot, foot) for foot in ("l_ankle", "r_ankle")}
    hand = osik.FrameTask(robot, "r_wrist", priority=2, orientation_weight=0.1)
    com = osik.ComTask(robot, axes="xy", lower=-0.03, upper=0.03)
    eyes = osik.LookAtTask(robot, "Head", axis=(1.0, 0.0, 0.0), target_frame="r_wrist", priority=3, weight=0.1)
    level = osik.AxisAlignTask(robot, "r_wrist", target=(0.0, 0.0, 1.0), half_angle=1.0, priority=2, weight=0.1)
    return robot, {
        **feet,
        "com": com,
        "hand": hand,
        "eyes": eyes,
        "level": level,
        "rest": osik.PostureTask(robot, priority=3),
    }


@pytest.mark.variants(
    release=["arm-hierarchy", "arm-null-space", "arm-saturated", "nao-weighted", "nao-null-space", "nao-saturated"]
)
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("make", [arm, nao], ids=["arm", "nao"])
def test_ten_thousand_steps_are_those_of_python(built, tmp_path, make: Callable[[], Any], scheme):
    robot, tasks = make()
    path = tmp_path / "controller.json"
    osik.save_controller(path, robot, tasks, scheme=SCHEMES[scheme](), dt=0.001)
    for wide in (0.02, 0.2):
        wanted, *near, batch, library = steps_of_both(Controller(built, path), osik.load_controller(path), wide)
        largest = np.abs(wanted).max()
        *roundings, of_batch, of_library = (
            np.abs(velocities - wanted).max(1) / largest for velocities in (*near, batch, library)
        )
        rounding = np.max(roundings, 0)  # large where a target out of reach brings the arm near a singularity
        print(f"{make.__name__}, {scheme}, {wide} m:", *(f"{d.max():.1e}" for d in (of_library, of_batch, rounding)))
        assert wide > 0.02 or of_library.max() <= 1e-12
        for differences in (of_library, of_batch):
            assert (differences <= 1e-12 + 10.0 * rounding).all() and largest > 0.5


def steps_of_both(c: Controller, loaded: Any, wide: float) -> list[np.ndarray]:
    """Velocities of ``solve``, four with q rounded otherwise, those of a batch, and of the library in its closed loop.

    ``wide`` [m]: of the target's motion.
    """
    robot, tasks, scheme, limits, dt = loaded
    at = {name: c.names(TARGETS).index(f"hand.target[{name}]") for name in (0, 1)}
    rng, q, targets = np.random.default_rng(1), c.initial(Q), c.initial(TARGETS)
    np.testing.assert_array_equal(q, robot.q0)
    middle = targets[at[0] : at[0] + 3].copy()
    log: list[list[np.ndarray]] = [[], [], [], []]
    for k in range(COUNT):
        if k % 1000 == 0:  # from elsewhere, perhaps outside of its ranges
            q = np.asarray(osik.integrate(robot, robot.q0, rng.normal(size=robot.nv), wide + 0.05))
        point, turn = (
            middle + wide * np.sin(0.003 * k * np.arange(1.0, 4.0)),
            rotation(0.3 * np.sin(0.002 * k + np.arange(3.0))),
        )
        targets[at[0] : at[0] + 3], targets[at[1] : at[1] + 9] = point, turn.ravel()
        status, velocity = c.step(q, targets)
        assert status == 0, k
        for all_of, one in zip(log, (q, point, turn, velocity), strict=True):
            all_of.append(one)
        q = c.integrate(q, velocity)

    def step(state: Any) -> Any:
        q, point, turn = state
        found = osik.solve(robot, q, tasks, targets={"hand": (point, turn)}, scheme=scheme, limits=limits, dt=dt)
        return found.velocity, osik.integrate(robot, q, found.velocity, dt)

    qs, points, turns, found = map(np.stack, log)
    one_by_one, in_a_batch = jax.jit(partial(jax.lax.map, step)), jax.jit(jax.vmap(step))
    wanted, moved = one_by_one((qs, points, turns))
    ulps = np.finfo(float).eps * rng.choice([-1.0, 1.0], (4, *qs.shape))
    near = [one_by_one((qs * (1.0 + ulp), points, turns))[0] for ulp in ulps]
    batch, _ = in_a_batch((qs, points, turns))
    goes_on = np.arange(1, COUNT) % 1000 != 0
    np.testing.assert_allclose(qs[1:][goes_on], moved[:-1][goes_on], rtol=0.0, atol=1e-11)
    return [np.asarray(velocities) for velocities in (wanted, *near, batch, found)]


def rotation(turn: np.ndarray) -> np.ndarray:
    """The rotation matrix of a rotation vector (Rodrigues)."""
    angle = np.linalg.norm(turn)
    x, y, z = turn / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def test_numbers_that_are_none_are_an_error(built, tmp_path):
    robot, tasks = nao()
    osik.save_controller(path := tmp_path / "c.json", robot, tasks, dt=0.001)
    c = Controller(built, path)
    q, targets = c.initial(Q), c.initial(TARGETS)
    turned = c.names(TARGETS).index("hand.target[1]")
    assert [name.rpartition(".")[2] for name in c.names(Q)[:7]] == ["x", "y", "z", "qw", "qx", "qy", "qz"]
    assert [c.library.osik_find(c.handle, Q, name.encode()) for name in (c.names(Q)[9], "none")] == [9, -1]
    wrong = {"nan": (8, None, np.nan), "quaternion": (slice(3, 7), None, 0.0), "infinite": (None, 0, np.inf)}
    wrong |= {"no rotation": (None, turned, 1.5), "mirrored": (None, slice(turned, turned + 3), -1.0)}
    before = c.step(q, targets)
    for kind, (of_q, of_targets, value) in wrong.items():
        bad_q, bad_targets = q.copy(), targets.copy()
        if of_q is not None:
            bad_q[of_q] = value
        if of_targets is not None:
            bad_targets[of_targets] = value if kind != "mirrored" else -targets[of_targets]
        status, velocity = c.step(bad_q, bad_targets)
        assert status == osik.solvers.Status.NUMERICAL_ERROR and not velocity.any(), kind
    for again in (c.step(q, targets), c.step(q, None)):
        assert before[0] == again[0] == 0
        np.testing.assert_array_equal(again[1], before[1])


def test_rotations_that_are_rounded_become_those_of_python(built, tmp_path):
    robot, tasks = arm()
    osik.save_controller(path := tmp_path / "c.json", robot, tasks)
    c = Controller(built, path)
    targets, at = c.initial(TARGETS), c.names(TARGETS).index("hand.target[1]")
    targets[at : at + 9] = np.round(rotation(np.array([0.3, 0.4, -0.2])), 2).ravel()
    aimed = {"hand": (targets[at - 3 : at], targets[at : at + 9].reshape(3, 3))}
    loaded = osik.load_controller(path)
    wanted = osik.solve(loaded.robot, robot.q0, loaded.tasks, scheme=loaded.scheme, targets=aimed).velocity
    status, velocity = c.step(c.initial(Q), targets)
    assert status == 0
    np.testing.assert_allclose(velocity, wanted, atol=1e-12)


def signed(text: str) -> str:
    """The text with a checksum of its own."""
    text = text[: text.rindex(',\n "checksum"')]
    return f'{text},\n "checksum": {zlib.crc32(text.encode())}\n}}\n'


def test_other_files_are_refused_with_the_reason(built, tmp_path):
    text = STORED.read_text()
    section = text.index(',\n "core"')
    weight = text.index('"weight"')
    wrong = {
        "no controller": ('{"a": 1}', "no controller that osik_jax.save_controller wrote"),
        "empty": ("", "no controller"),
        "cut off": (text[: len(text) // 2], "its end is missing"),
        "cut off at its end": (text[:-2], "not as osik_jax.save_controller wrote it"),
        "older": (text[:section] + "\n}\n", "an older osik_jax wrote it: save it again"),
        "edited": (text[:weight] + text[weight:].replace("1.0", "2.0", 1), "in place of editing it"),
        "newer": (signed(text.replace('"core": {"version": 2', '"core": {"version": 3')), "another release"),
        "a part less": (signed(text.replace('"numbers"', '"number"')), 'no "numbers"'),
        "no JSON": (signed(text.replace('"numbers": [', '"numbers": [x')), "cannot be read"),
    }
    for name, (content, message) in wrong.items():
        (path := tmp_path / "wrong.json").write_text(content)
        with pytest.raises(ValueError) as refused:
            Controller(built, path)
        assert message in str(refused.value) and str(refused.value).startswith(str(path)), name
    refuses(ValueError, "none.json: it cannot be read", Controller, built, tmp_path / "none.json")
    robot, tasks = arm()
    hand, frame = tasks["hand"], osik.FrameTask
    lacking: dict[str, dict[str, Any]] = {}
    lacking["a WeightedQP with max_iterations"] = dict(scheme=osik.WeightedQP(max_iterations=3))
    lacking["the limit AccelerationLimit"] = dict(limits=[osik.AccelerationLimit(robot, {"*": 5.0})])
    fields: list[dict[str, Any]] = [dict(hard=True), dict(gain=osik.AdaptiveGain(2.0, 1.0, 3.0)), dict(error="se3")]
    for field in fields:
        lacking[f"the task 'hand', which .*{next(iter(field))}"] = dict(hand=frame(robot, "tool", **field))
    lacking["the task 'hand', which .*KineticEnergyTask"] = dict(hand=osik.KineticEnergyTask(robot))
    for part, options in lacking.items():
        osik.save_controller(path, robot, {"hand": options.pop("hand", hand)}, **options)
        refuses(ValueError, f"(?i)the compiled core does not have {part}", Controller, built, path)


def test_a_stored_file_is_still_read(built):
    """A layout that changes has to have another version."""
    loaded = osik.load_controller(STORED)
    c = Controller(built, STORED)
    q = np.asarray(loaded.robot.q0) + 0.1
    wanted = osik.solve(loaded.robot, q, loaded.tasks, scheme=loaded.scheme, limits=loaded.limits, dt=loaded.dt)
    status, velocity = c.step(q, None)
    assert status == 0 and np.abs(velocity).max() > 1e-2
    np.testing.assert_allclose(velocity, wanted.velocity, atol=1e-12)
    assert c.library.osik_period(c.handle) == loaded.dt


COUNTED = """
#include <cstdio>
#include <cstdlib>
#include <new>
#include <vector>
#include "osik.h"
static long made = 0;
void* operator new(std::size_t size) { return ++made, std::malloc(size); }
void operator delete(void* at) noexcept { std::free(at); }
void operator delete(void* at, std::size_t) noexcept { std::free(at); }
int main(int, char** words) {
  osik_controller* c = osik_load(words[1], nullptr, 0);
  std::vector<double> q(osik_size(c, OSIK_Q)), v(osik_size(c, OSIK_VELOCITY));
  osik_initial(c, OSIK_Q, q.data());
  const long loaded = made;
  for (int k = 0; k < 1000; ++k) {
    if (k % 100 == 0) q.back() += 0.3;
    if (osik_step(c, q.data(), nullptr, v.data())) return 1;
    osik_integrate(c, q.data(), v.data(), q.data());
  }
  std::printf("%d %ld", loaded > 10, made - loaded);
}
"""


def test_a_step_allocates_nothing_and_the_header_is_c99(built, tmp_path):
    (tmp_path / "counted.cpp").write_text(COUNTED)
    include, lib = built / "include", built / "lib"
    program = tmp_path / "counted"
    run(COMPILER, "-std=c++17", f"-I{include}", tmp_path / "counted.cpp", f"-L{lib}", "-losik", f"-Wl,-rpath,{lib}",
        "-o", program)  # fmt: skip
    for scheme in SCHEMES.values():
        robot, tasks = nao()
        osik.save_controller(path := tmp_path / "c.json", robot, tasks, scheme=scheme())
        assert run(program, path) == "1 0"
    flags = ("-x", "c", "-std=c99", "-pedantic", "-Wall", "-Werror", "-fsyntax-only")
    run(shutil.which("cc") or COMPILER, *flags, include / "osik.h")


def test_the_example_follows_a_target(built, tmp_path):
    robot, tasks = nao()
    osik.save_controller(path := tmp_path / "nao.json", robot, tasks, dt=0.001)
    said = run(built / "follow", path, "hand.target[0]", 1)
    assert said.startswith("1000 steps of 1 ms: median ") and "0 not solved" in said


@pytest.mark.release
def test_sanitizers_find_nothing(tmp_path):
    program = tmp_path / "follow"
    flags = ("-std=c++20", "-O1", "-g", "-Wno-psabi", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
    run(COMPILER, *flags, SOURCES / "controller.cpp", SOURCES / "follow.cpp", "-o", program)
    for make in (arm, nao):
        for scheme in SCHEMES.values():
            osik.save_controller(path := tmp_path / "c.json", *make(), scheme=scheme(), dt=0.001)
            assert "0 not solved" in run(program, path, "hand.target[0]", 2)
    lines = path.read_text()
    for cut in range(0, len(lines), 997):
        (tmp_path / "cut.json").write_text(signed(lines[:cut] + lines[lines.rindex(',\n "checksum"') :]))
        said = subprocess.run([program, tmp_path / "cut.json", "hand.target[0]"], capture_output=True, text=True)
        assert said.returncode == 1 and said.stderr.startswith(str(tmp_path / "cut.json")), said.stderr
