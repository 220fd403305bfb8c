"""The benchmark of hard work: what is asked is out of reach, judged numbers are right, the page has its tables."""

import dataclasses
import re

import numpy as np
import pinocchio as pin
import pytest

from benchmarks import curvature
from benchmarks.data_file import read_csv
from benchmarks.hard import _motion, _page, _results
from benchmarks.hard._balance import balance
from benchmarks.hard._cases import BEYOND, Case, cases, directions, without_turning
from benchmarks.hard._judge import Numbers, judged, worst
from benchmarks.hard._motion import Motion
from benchmarks.hard._reach import Search, farthest
from benchmarks.robots import pinocchio_model, workload
from benchmarks.workload import DT


@pytest.fixture(scope="module")
def work():
    return workload("arm7")


@pytest.fixture(scope="module")
def humanoid():
    return workload("nao")


def motion_of(path, case, solved=1.0):
    return Motion(case, 10.0, path, solved, 1e-4)


def held(work, place, steps, judged=0):
    return Case("beyond", np.tile(place, (steps, 1)), np.tile(work.com_start, (steps, 1)), judged)


class TestReach:
    def test_no_configuration_of_an_arm_is_farther(self, work, rng):
        model = pinocchio_model(work.urdf, False)
        data, hand = model.createData(), model.getFrameId(work.hand)
        places = []
        for _ in range(3000):
            pin.framesForwardKinematics(model, data, rng.uniform(work.position_lower, work.position_upper))
            places.append(data.oMf[hand].translation.copy())
        for u in directions(work):
            reach, random = u @ farthest(work, u), (np.array(places) @ u).max()
            assert random < reach + 1e-9 and reach < random + 0.25

    def test_a_humanoid_stands_where_it_reaches(self, humanoid):
        """The derivatives of the search are central differences, and the far place is farther than the start."""
        search = Search(humanoid, directions(humanoid)[0])
        x, h = np.random.default_rng(0).uniform(-0.2, 0.2, search.model.nv), 1e-6
        eye = h * np.eye(len(x))
        slopes = [(search.slips(x + e) - search.slips(x - e)) / (2.0 * h) for e in eye]
        np.testing.assert_allclose(search.slip_slopes(x).T, slopes, rtol=0, atol=1e-7)
        slopes = [(search.height(x + e) - search.height(x - e)) / (2.0 * h) for e in eye]
        np.testing.assert_allclose(search.slope(x), slopes, rtol=0, atol=1e-7)
        u = directions(humanoid)[2]
        assert u @ (farthest(humanoid, u) - humanoid.hand_position) > 0.1

    def test_targets_beyond_it_are_out_of_reach(self, work):
        found = [case for case in cases(work) if case.name == "beyond"]
        assert len(found) == 3
        for case, u in zip(found, directions(work), strict=True):
            assert u @ (case.hand[0] - farthest(work, u)) == pytest.approx(BEYOND)
            assert (case.hand == case.hand[0]).all()


class TestBalance:
    def test_nothing_gives_way_to_what_is_in_reach(self, humanoid):
        assert balance(without_turning(humanoid, posture=False), humanoid.hand_position) == pytest.approx((0, 0, 0))

    def test_heavier_feet_give_way_by_less(self, humanoid):
        """Once the feet's weight is 16 times as large, they give way to the same pull by about a sixteenth."""
        work = without_turning(humanoid, posture=True)
        heavy = dataclasses.replace(work, costs=dataclasses.replace(work.costs, foot=4.0 * work.costs.foot))
        target = farthest(work, directions(work)[0]) + BEYOND * directions(work)[0]
        (foot, _, hand), (less, _, _) = balance(work, target), balance(heavy, target)
        assert hand > 0.2 and 1e-3 < foot < 1e-2
        assert foot / 20.0 < less < foot / 12.0


class TestNumbers:
    """Motions that are made up, whose numbers are known."""

    def path(self, work, steps):
        return np.tile(work.start, (steps + 1, 1))

    def test_of_a_joint_that_turns_round_at_each_step(self, work):
        steps, top = 40, work.velocity[1]
        path = self.path(work, steps)
        path[1::2, 1] += DT * top
        found = judged(work, motion_of(path, held(work, work.hand_position, steps)))
        assert found.turns == pytest.approx((steps - 1) / (steps * DT))
        assert found.fastest == pytest.approx(1.0) and found.at_top == 1.0
        assert found.rms == pytest.approx(top / np.sqrt(7.0))
        assert found.at_range == found.feet == found.base == 0.0 and found.hand_at_end == pytest.approx(0.0, abs=1e-12)

    def test_only_of_the_steps_that_are_judged(self, work):
        path = self.path(work, 20)
        path[5:10, 3] += 0.01
        assert judged(work, motion_of(path, held(work, work.hand_position, 20))).rms > 0.0
        assert judged(work, motion_of(path, held(work, work.hand_position, 20, judged=10))).rms == 0.0

    def test_of_a_joint_at_the_end_of_its_range(self, work):
        path = self.path(work, 20)
        path[11:, 2] = work.position_upper[2]
        found = judged(work, motion_of(path, held(work, work.hand_position, 20)))
        assert found.at_range == pytest.approx(0.5)
        assert found.hand > 0.1 and found.hand == found.hand_at_end

    def test_of_feet_and_base(self, humanoid):
        path = self.path(humanoid, 4)
        path[3:, 0] += 0.01
        found = judged(humanoid, motion_of(path, held(humanoid, humanoid.hand_position, 4), solved=0.5))
        assert found.feet == pytest.approx(0.01) and found.base == pytest.approx(0.01 / DT)
        assert found.hand == pytest.approx(0.01) and found.solved == 0.5

    def test_of_what_is_no_number(self, work):
        path = self.path(work, 4)
        path[2, 0] = np.nan
        assert judged(work, motion_of(path, held(work, work.hand_position, 4))).rms == np.inf

    def test_the_worst_of_some(self):
        fine = Numbers(**dict.fromkeys(Numbers._fields, 0.0) | dict(solved=1.0))
        bad = fine._replace(rms=2.0, solved=0.5)
        assert worst([fine, bad, fine._replace(feet=1.0)]) == bad._replace(feet=1.0)


def test_the_page_and_the_file_have_the_tables_of_the_command():
    """All robots in each case, every solver in the table of the page, and nothing that is not finite."""
    head, rows = read_csv(_page.FILE)
    assert tuple(head) == _page.HEAD
    for case in _page.TABLES:
        robots = {robot for name, robot, *_ in rows if name == case}
        assert robots == set(_results.ROBOTS) - ({"arm7"} if case == "squat" else set())
    text = _page.PAGE.read_text(encoding="utf-8")
    table = text[text.index("<!-- table: summary -->") : text.index("<!-- end: summary -->")]
    cells = [line.split("|")[1].strip() for line in table.splitlines() if line.startswith("|")][2:]
    assert {*_motion.OURS, *_motion.PEERS} <= set(cells)
    assert not re.search(r"\bnan\b|\binf\b", text + _page.FILE.read_text(encoding="utf-8"))


def test_the_bound_on_the_curvature_is_near_it():
    found = curvature.ratios("arm7", 40)
    assert len(found) == 40 and found.min() > 0.6 and found.max() < 4.0
