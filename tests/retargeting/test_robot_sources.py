"""A robot as the source of a motion: another robot follows it, and it comes back."""

import dataclasses

import numpy as np
import pytest
from motion_files import dancer, write_bvh
from small_robots import quietly, robot_of

import osik_jax as osik
from osik_jax.retargeting import Retargeter, RobotMotion, SourceMotion, load_motion, report, retarget
from osik_jax.retargeting._roles import LIMBS


@pytest.fixture(scope="module")
def danced(nao, tmp_path_factory):
    """A NAO that dances, its file, and what retargets to it."""
    retargeter = Retargeter(nao)
    folder = tmp_path_factory.mktemp("danced")
    result = retargeter.retarget(load_motion(write_bvh(folder / "dance.bvh", dancer(32), 0.01)))
    result.save(folder / "motion.npz")
    return result, folder / "motion.npz", retargeter


def angle(a, b):
    across, along = np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, -1)
    return np.degrees(np.arctan2(across, along))


@pytest.mark.release
def test_a_robot_that_follows_itself_does_the_same(nao, danced):
    first, file, retargeter = danced
    source = SourceMotion.load(file, nao)
    np.testing.assert_array_equal(source.person().contact, first.contact)
    again = retargeter.retarget(source)
    names = [nao.joint_qpos_index(name) for name in nao.joint_names]
    assert np.degrees(np.abs(again.q - first.q)[:, names]).mean() < 0.5
    assert np.abs(again.q - first.q)[:, :3].max() < 2e-3
    figures = report(again)
    assert figures["tracking"]["segment_angle_deg_mean"] < 0.2
    assert figures["feet"]["slip_mm_max"] < 0.1 and figures["feet"]["float_mm_max"] < 0.1


@pytest.mark.release
def test_a_motion_goes_to_another_robot_and_comes_back(nao, danced):
    g1 = osik.load_robot("g1")
    first, file, retargeter = danced
    there = Retargeter(g1).retarget(SourceMotion.load(file, nao))
    back = retargeter.retarget(SourceMotion(g1, dataclasses.replace(there.motion, contact=there.contact)))
    for result in (there, back):
        figures = report(result)
        np.testing.assert_array_equal(result.contact, first.contact)
        assert figures["feet"]["slip_mm_max"] < 0.1 and figures["feet"]["float_mm_max"] < 0.1
        assert figures["joints"]["beyond_range_max"] == 0.0 and figures["joints"]["jump_frames"] == 0
    own, returned = (SourceMotion(nao, result.motion).person().points for result in (first, back))
    assert np.mean([angle(own[b] - own[a], returned[b] - returned[a]) for a, b in LIMBS]) < 1.0


@pytest.mark.slow
def test_robots_of_other_builds_lead_a_g1(tmp_path):
    """A Talos, and a robot whose forearms end without a wrist joint as an H1's: segments, contacts and limits."""
    dance = load_motion(write_bvh(tmp_path / "dance.bvh", dancer(32), 0.01))
    g1 = Retargeter(osik.load_robot("g1"))
    for robot in (osik.load_robot("talos"), robot_of("legs", "arms")):
        first = quietly(Retargeter, robot)
        danced = first.retarget(dance)
        source = SourceMotion(robot, dataclasses.replace(danced.motion, contact=danced.contact), first.profile)
        led = g1.retarget(source)
        figures, joints = report(led), report(led)["joints"]
        np.testing.assert_array_equal(led.contact, danced.contact)
        assert joints["beyond_range_max"] == 0.0 and joints["speed_over_limit_max"] <= 1.0 + 1e-6
        assert figures["feet"]["slip_mm_max"] < 0.1 and figures["feet"]["float_mm_max"] < 0.1
        own, seen = (SourceMotion(r, m, p).person().points for r, m, p in (
            (robot, danced.motion, first.profile), (g1.robot, led.motion, g1.profile)))  # fmt: skip
        off = {(a, b): angle(own[b] - own[a], seen[b] - seen[a]).mean() for a, b in LIMBS}
        assert max(off.values()) < 3.0 and np.mean(list(off.values())) < 1.5, off


def test_feet_of_a_source_without_labels_are_found(nao, danced):
    first, _, _ = danced
    assert first.motion.contact is None
    raised = dataclasses.replace(first.motion, qpos=first.motion.qpos + np.eye(first.motion.qpos.shape[1])[2] * 0.3)
    person = SourceMotion(nao, raised).person()
    assert person.contact.all() and person.points["left_heel"][:, 2] == pytest.approx(0.0, abs=2e-3)


def test_other_rates_and_tables(nao, danced, tmp_path):
    first, file, _ = danced
    fast = SourceMotion.load(file, nao).resampled(60.0)
    assert fast.frames == 2 * len(first.q) - 1
    np.testing.assert_allclose(fast.motion.qpos[::2], first.motion.qpos, atol=1e-12)
    table = file.with_name("motion.csv")
    first.motion.save_csv(table)
    np.testing.assert_allclose(SourceMotion.load(table, nao, fps=30.0).motion.qpos, first.motion.qpos, atol=1e-8)
    with pytest.raises(ValueError, match="a CSV holds numbers alone; say joint_names and fps"):
        SourceMotion.load(table, nao)
    with pytest.raises(ValueError, match="joint_names and fps go with a CSV"):
        SourceMotion.load(file, nao, fps=60.0)
    with pytest.raises(ValueError, match="mapping names joints of a person's clip"):
        retarget(nao, fast, mapping={"left_hip": "hip"})


def test_wrong_sources_are_told(nao, danced):
    motion = RobotMotion(30.0, ("elbow",), np.tile([0.0, 0, 0, 1, 0, 0, 0, 0], (4, 1)))
    with pytest.raises(KeyError, match="no joint 'elbow'"):
        SourceMotion(nao, motion)
    with pytest.raises(ValueError, match="load the robot with floating_base=True"):
        SourceMotion(osik.load_robot("arm7"), motion)
    with pytest.raises(ValueError, match=r"contact has shape \(3, 4\), expected \(4, 4\)"):
        dataclasses.replace(motion, contact=np.ones((3, 4), bool))
