"""Files with a right checksum and wrong numbers: the C library refuses them, or its answers are finite."""

import copy
import json
import os
import shutil
import subprocess
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import osik_jax as osik
from osik_jax.core import _build

SOURCES = _build.FOLDER / "c"
COMPILER = shutil.which(os.environ.get("CXX") or "c++")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="THE C LIBRARY IS NOT TESTED: no C++ compiler")
SCHEMES = [osik.WeightedQP(), osik.HierarchicalQP(), osik.NullSpace(), osik.NullSpace(method="saturated")]
EVERY_JOINT = Path(__file__).parents[1] / "data" / "mjcf" / "every_joint.xml"
PROGRAM = """
#include <cmath>
#include <cstdio>
#include <fstream>
#include <string>
#include <vector>
#include "osik.h"
int main(int, char** words) {  // a file with the paths of files, one a line
  std::ifstream list(words[1]);
  int refused = 0, taken = 0;
  for (std::string path; std::getline(list, path);) {
    std::fprintf(stderr, "%s\\n", path.c_str());
    osik_controller* c = osik_load(path.c_str(), nullptr, 0);
    if (!c && ++refused) continue;
    std::vector<double> q(osik_size(c, OSIK_Q)), v(osik_size(c, OSIK_VELOCITY)), targets(osik_size(c, OSIK_TARGETS));
    osik_initial(c, OSIK_Q, q.data()), osik_initial(c, OSIK_TARGETS, targets.data());
    for (int k = 0; k < 3; ++k) {
      const int status = osik_step(c, q.data(), k ? targets.data() : nullptr, v.data());
      if (status < OSIK_SOLVED || status > OSIK_NUMERICAL_ERROR) return std::fputs("no status", stderr), 1;
      for (double a : v)
        if (!std::isfinite(a)) return std::fputs("not finite", stderr), 1;
      osik_integrate(c, q.data(), v.data(), q.data());
    }
    osik_free(c), ++taken;
  }
  std::printf("%d %d", refused, taken);
}
"""


def program(folder: Path, *flags: str) -> Path:
    """Compile the library into the program above."""
    (folder / "program.cpp").write_text(PROGRAM)
    files = (SOURCES / "controller.cpp", folder / "program.cpp")
    subprocess.run(
        [COMPILER or "c++", *_build._FLAGS, "-O0", *flags, f"-I{SOURCES}", *files, "-o", folder / "program"], check=True
    )
    return folder / "program"


def run(program: Path, files: list[Path]) -> tuple[int, int]:
    """Return how many files are refused, and how many give finite answers."""
    program.with_name("list").write_text("".join(f"{path}\n" for path in files))
    done = subprocess.run([program, program.with_name("list")], capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr[-4000:]
    refused, taken = map(int, done.stdout.split())
    return refused, taken


def controllers() -> list[tuple[osik.Robot, dict[str, osik.Task], dict[str, Any]]]:
    """Return robots, tasks and limits that together have every part of a layout."""
    arm = osik.load_robot("arm7", locked_joints=("joint3",))
    half = np.full(3, 0.1)
    of_arm = {
        "hand": osik.FrameTask(arm, "hand", axes="frame"),
        "near": osik.FrameTask(arm, "hand", rows="position", lower=-half, upper=half, priority=2),
        "relative": osik.RelativeFrameTask(arm, "hand", root=arm.tree.frame_names[3], priority=3),
        "eye": osik.LookAtTask(arm, "hand", target_frame=arm.tree.frame_names[3], half_angle=0.3, priority=2),
        "level": osik.AxisAlignTask(arm, "hand", target=(0.0, 0.0, 1.0), priority=3),
        "bent": osik.PostureTask(arm, joints=("joint6", "joint7"), lower=[-0.2, -0.2], upper=[0.2, 0.2], priority=3),
        "rest": osik.PostureTask(arm, weight=np.linspace(0.1, 1.0, arm.nv), priority=4),
    }
    rail = osik.Robot.from_mjcf(EVERY_JOINT)
    of_rail = {
        "frame": osik.FrameTask(rail, rail.tree.frame_names[-1]),
        "com": osik.ComTask(rail, axes="xz", target_velocity=[0.1, 0.0]),
    }
    walker = osik.load_robot("nao")
    polygon = osik.support_polygon(walker, walker.q0, ["l_sole", "r_sole"])
    of_walker = {"com": osik.ComTask(walker, polygon=polygon), "rest": osik.PostureTask(walker, priority=2)}
    speeds = osik.VelocityLimit(arm, velocity={"*": 1.0})
    return [
        (arm, of_arm, dict(limits=[speeds], source="arm7")),
        (rail, of_rail, dict(limits=osik.no_limits, source=EVERY_JOINT)),
        (walker, of_walker, dict(source="nao")),
    ]


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> list[Path]:
    """The files of these controllers, with each scheme."""
    folder, found = tmp_path_factory.mktemp("saved"), []
    for robot, tasks, options in controllers():
        for scheme in SCHEMES:
            found.append(folder / f"{len(found)}.json")
            osik.save_controller(found[-1], robot, tasks, scheme=scheme, dt=0.01, **options)
    return found


def changed(section: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Return the section with a few wrong numbers, numbers too many or too few: mostly in the layout."""
    section = copy.deepcopy(section)
    for _ in range(rng.integers(1, 4)):
        part = rng.choice(
            ["layout"] * 12 + ["constants", "numbers", "numbers", "inputs", "manifold", "q", "velocity", "dt"]
        )
        if part == "dt":
            section["dt"] = wrong(section["dt"], rng)
            continue
        numbers = section[part]
        if part in ("inputs", "manifold"):
            numbers = numbers[rng.integers(len(numbers))]
        place = int(rng.integers(len(numbers) + 1))
        kind = rng.random()
        if kind < 0.1 or place == len(numbers):
            numbers.insert(place, 0)
        elif kind < 0.2:
            del numbers[place]
        else:
            numbers[place] = wrong(numbers[place], rng)
    return section


def wrong(number: Any, rng: np.random.Generator) -> Any:
    near = [number + 1, number - 1, 2 * number, -number] if isinstance(number, int | float) else []
    far = [-1, 0, 1, 2, 3, 6, 17, 400, 10**6, 2**31 - 1, -(2**31), 1e300, 0.5, float("inf"), "a"]
    some = near if near and rng.random() < 0.5 else far
    return some[rng.integers(len(some))]


def fuzzed(saved: list[Path], folder: Path, count: int) -> list[Path]:
    """Write files with wrong numbers and a right checksum."""
    rng, files = np.random.default_rng(7), []
    texts = [path.read_text() for path in saved]
    starts = [text.rindex(',\n "core": ') for text in texts]
    sections = [json.loads(text)["core"] for text in texts]
    for k in range(count):
        of = k % len(saved)
        text = f'{texts[of][: starts[of]]},\n "core": {json.dumps(changed(sections[of], rng))}'
        files.append(folder / f"{k}.json")
        files[-1].write_text(f'{text},\n "checksum": {zlib.crc32(text.encode())}\n}}\n')
    return files


def test_right_files_are_taken_and_wrong_ones_are_refused_or_finite(saved, tmp_path):
    own = program(tmp_path)
    assert run(own, saved) == (0, len(saved))
    refused, taken = run(own, fuzzed(saved, tmp_path, 400))
    assert refused > 200 and taken > 20


@pytest.mark.release
def test_sanitizers_find_nothing_in_wrong_files(saved, tmp_path):
    own = program(tmp_path, "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
    assert run(own, saved) == (0, len(saved))
    count = int(os.environ.get("OSIK_FUZZED_FILES", "800"))
    refused, taken = run(own, fuzzed(saved, tmp_path, count))
    assert refused > count / 2 and taken > count / 20
