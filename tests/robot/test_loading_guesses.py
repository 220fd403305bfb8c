"""What a file leaves open when it is loaded: the base, ranges of a single value, the home configuration, precision."""

from __future__ import annotations

import itertools
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from example_files import example_file
from model_files import mjcf
from refusals import no_warnings, refuses
from task_checks import kinematics_at
from urdfs import LIMIT, joint, link

import osik_jax as osik
from osik_jax import cli
from osik_jax.robot._guesses import guess_feet


def chain(*links: str, limits: tuple[str, ...] = ()) -> str:
    """Links one after the other; the joint to a link is called like it."""
    inner = dict(zip(links[1:], limits, strict=False))
    joints = [joint(f"to_{b}", a, b, inner.get(b, LIMIT)) for a, b in itertools.pairwise(links)]
    return f'<robot name="r">{"".join(map(link, links))}{"".join(joints)}</robot>'


def biped(left: str, right: str) -> str:
    links = "".join(map(link, ("torso", "left_leg", "right_leg", left, right)))
    joints = [joint("l", "torso", "left_leg"), joint("r", "torso", "right_leg")]
    ends = [joint("lf", "left_leg", left, kind="fixed"), joint("rf", "right_leg", right)]
    return f'<robot name="b">{links}{"".join(joints + ends)}</robot>'


ARM = chain("base", "upper", "lower", "tool")
FREE = ARM.replace("</robot>", link("odom") + joint("free", "odom", "base", kind="floating") + "</robot>")


class TestBase:
    """One rule: as asked, else as the file says, else by feet; what has none is fixed, with a word."""

    @pytest.mark.parametrize(
        ("text", "asked", "floats"),
        [
            (ARM, True, True),
            (ARM, False, False),
            (FREE, None, True),
            (FREE, False, False),
            (ARM.replace('"base"', '"world"'), None, False),
            (biped("l_sole", "r_sole"), None, True),
            (biped("LeftFoot", "RightFoot"), None, True),
            (biped("l_sole", "r_sole"), False, False),
        ],
    )
    def test_what_is_asked_or_said_or_seen_is_done_without_a_word(self, text, asked, floats):
        with no_warnings():
            assert osik.Robot.from_urdf(text, floating_base=asked).floating_base == floats

    @pytest.mark.parametrize("text", [ARM, biped("left_hand", "right_hand"), biped("l_foot", "hand")])
    def test_what_has_no_feet_is_fixed_and_says_so(self, text):
        with pytest.warns(osik.OsikWarning, match="floating_base=False, or floating_base=True") as told:
            assert not osik.Robot.from_urdf(text).floating_base
        assert [warning.filename for warning in told] == [__file__]  # the line to mend

    @pytest.mark.parametrize(
        ("ending", "sole"),
        [
            ("talos_data/robots/talos_full_v2.urdf", "left_sole_link"),
            ("g1_description/urdf/g1_29dof_rev_1_0.urdf", "left_ankle_roll_link"),
            ("anymal_b_simple_description/robots/anymal.urdf", "LF_FOOT"),
        ],
    )
    def test_robots_with_feet_stand_freely(self, ending, sole):
        with no_warnings(osik.OsikWarning):
            robot = osik.Robot.from_urdf(example_file(ending))
        assert robot.floating_base and sole in guess_feet(robot)

    def test_every_command_follows_the_rule(self, tmp_path, capsys):
        for name, text in (("arm", ARM), ("biped", biped("l_sole", "r_sole"))):
            (tmp_path / f"{name}.urdf").write_text(text)
        arm, biped_file = str(tmp_path / "arm.urdf"), str(tmp_path / "biped.urdf")
        assert cli.main(["info", arm]) == 0
        said = capsys.readouterr()
        assert "bolted down" in said.out and "--base fixed, or --base floating" in said.err
        assert cli.main(["info", arm, "--base", "floating"]) == 0
        said = capsys.readouterr()
        assert "floating base" in said.out and not said.err
        assert cli.main(["info", biped_file]) == 0
        assert "floating base" in capsys.readouterr().out


class TestRangesOfOneValue:
    ZERO = '<limit lower="0" upper="0" velocity="1" effort="1"/>'
    TEXT = chain("base", "upper", "lower", limits=(ZERO, '<limit velocity="1" effort="1"/>'))

    def test_frozen_joints_are_named_with_what_to_do(self):
        with pytest.warns(osik.OsikWarning, match=r"to_upper \[0\], to_lower \[0\].*locked_joints=.*position_limits="):
            robot = osik.Robot.from_urdf(self.TEXT, floating_base=False)
        assert np.abs(robot.position_upper - robot.position_lower).max() < 1e-300  # as the file says, for all that

    def test_both_ways_out_are_silent(self):
        with no_warnings():
            locked = osik.Robot.from_urdf(
                self.TEXT, floating_base=False, locked_joints=("to_lower",), position_limits={"to_upper": (-1, 2)}
            )
            free = osik.Robot.from_urdf(self.TEXT, floating_base=False, position_limits={"to_*": (-np.inf, np.inf)})
        assert locked.joint_names == ("to_upper",)
        assert (locked.position_lower.tolist(), locked.position_upper.tolist()) == ([-1.0], [2.0])
        assert np.isinf(free.position_lower).all() and np.isinf(free.position_upper).all()

    def test_pinocchio_reads_it_as_one_value_and_mujoco_as_no_limit(self):
        assert pin.buildModelFromXML(self.TEXT).upperPositionLimit.tolist() == [0.0, 0.0]
        mjcf = '<mujoco><worldbody><body><joint {}/><geom size="1"/></body></worldbody></mujoco>'
        for unlimited in ('range="0 0"', 'range="0.5 0.5"'):
            assert not mujoco.MjModel.from_xml_string(mjcf.format(unlimited)).jnt_limited[0]
            with no_warnings():
                robot = osik.Robot.from_mjcf(mjcf.format(unlimited))
            assert np.isinf(robot.position_lower).all() and np.isinf(robot.position_upper).all()
        with pytest.raises(ValueError, match="smaller"):  # MuJoCo's own
            osik.Robot.from_mjcf(mjcf.format('limited="true" range="0 0"'))

    def test_wrong_position_limits_are_refused(self):
        for limits, error, words in (
            ({"to_upper": 1.0}, TypeError, "pair"),
            ({"to_upper": (np.nan, 1)}, ValueError, "lower"),
            (
                {"floating_base": (0, 1)},
                ValueError,
                "'floating_base' is free; only hinges, slides and balls have a range",
            ),
        ):
            refuses(error, words, osik.Robot.from_urdf, ARM, floating_base=True, position_limits=limits)


BENT = [0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.5, 0.6, 0.8, 0.0, 0.0]


class TestHome:
    def test_keyframes_by_name_and_number(self):
        for home in ("bent", 1, np.int64(1)):
            np.testing.assert_allclose(osik.Robot.from_mjcf(mjcf("keyframes"), home=home).q0, BENT)
        np.testing.assert_allclose(osik.Robot.from_mjcf(mjcf("keyframes")).q0[2], 1.0)
        model = mujoco.MjModel.from_xml_string(mjcf("keyframes"))
        np.testing.assert_allclose(osik.Robot.from_mjmodel(model, home="bent").q0, BENT)
        locked = osik.Robot.from_mjcf(mjcf("keyframes"), floating_base=False, home="bent", locked_joints=("ball",))
        np.testing.assert_allclose(locked.q0, [0.5])

    def test_mappings_set_what_they_name(self):
        robot = osik.Robot.from_urdf(ARM, floating_base=False, home={"to_lower": 0.25})
        np.testing.assert_allclose(robot.q0, [0.0, 0.25, 0.0])
        keyed = osik.Robot.from_mjcf(mjcf("keyframes"), home={"hinge": 0.25, "root": (1, 2, 3, 2, 0, 0, 0)})
        np.testing.assert_allclose(keyed.q0, [1, 2, 3, 1, 0, 0, 0, 0.25, 1, 0, 0, 0])
        nao = osik.load_robot("nao", home={"RHipYawPitch": -0.5})  # a follower: its leader moves
        assert nao.q0[nao.joint_qpos_index("LHipYawPitch")] == -0.5

    def test_quaternions_are_normalised_and_other_leaves_stay(self, nao):
        moved = nao.with_home(nao.q0.at[3:7].multiply(2.0).at[0].set(0.5))
        np.testing.assert_allclose(moved.q0, nao.q0.at[0].set(0.5), atol=1e-15)
        rest = [jax.tree.leaves(robot.with_home(nao.q0)) for robot in (nao, moved)]
        assert all((a == b).all() for a, b in zip(*rest, strict=True))

    def test_default_targets_are_there(self):
        q = osik.load_robot("arm7").q0 + 0.1
        arm = osik.load_robot("arm7").with_home(q)
        expected = kinematics_at(arm, q).frame_pose(arm, "hand")
        np.testing.assert_allclose(osik.FrameTask(arm, "hand").target[0], expected[0], atol=1e-14)
        np.testing.assert_array_equal(np.asarray(osik.PostureTask(arm, weight=1.0).target), q)

    def test_in_a_program(self, arm):
        heights = jax.jit(jax.vmap(lambda q: osik.FrameTask(arm.with_home(q), "hand").target[0][2]))
        q = np.stack([np.full(7, -0.3), np.full(7, -0.6)])
        for k in range(2):
            expected = kinematics_at(arm, jnp.asarray(q[k])).frame_pose(arm, "hand")[0][2]
            np.testing.assert_allclose(heights(q)[k], expected, atol=1e-14)

    @pytest.mark.parametrize(
        ("home", "error", "words"),
        [
            ("bend", KeyError, "did you mean 'bent'.*first, bent, broken"),
            ({"hing": 0.1}, KeyError, "did you mean 'hinge'"),
            ({"root": 1.0}, ValueError, r"\(7,\): x, y, z, then the quaternion"),
            ({"ball": (0, 0, 0, 0)}, ValueError, "'ball', is zero"),
            (np.full(12, np.nan), ValueError, "not finite"),
            (object(), TypeError, "keyframe"),
        ],
    )
    def test_wrong_homes_are_refused(self, home, error, words):
        refuses(error, words, osik.Robot.from_mjcf, mjcf("keyframes"), home=home)

    def test_a_home_outside_is_kept_with_a_warning(self):
        with pytest.warns(osik.OsikWarning, match=r"hinge is 2, its range is \[-1.0"):
            assert osik.Robot.from_mjcf(mjcf("keyframes"), home={"hinge": 2.0}).q0[7] == 2.0

    @pytest.mark.parametrize("home", ["broken", 2])
    def test_a_keyframe_outside_is_brought_inside_at_each_door(self, home):
        words = r"keyframe 'broken': hinge is 2\.5, its range is \[-1\.047"
        with pytest.warns(osik.OsikWarning, match=words):
            robot = osik.Robot.from_mjcf(mjcf("keyframes"), home=home)
        assert robot.q0[7] == robot.position_upper[6] and not robot.load_report
        with pytest.warns(osik.OsikWarning, match=words):
            assert osik.Robot.from_mjcf(mjcf("keyframes")).with_home(home).q0[7] == robot.q0[7]

    @pytest.mark.parametrize("home", [None, "first", {"hinge": 0.5}])
    def test_a_note_on_a_keyframe_is_on_that_of_q0(self, home):
        text = mjcf("keyframes").replace('"0 0 1  1 0 0 0  0  1', '"0 0 1  1 0 0 0  -1.3  1')
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always")
            robot = osik.Robot.from_mjcf(text, home=home)
        said = "hinge is -1.3, its range is [-1.0472, 1.0472]: in q0 it is at the end of that"
        assert sum(said in str(one.message) for one in given) == (home in (None, "first"))
        assert [note.done for note in robot.load_report] == ([said] if home is None else [])

    def test_no_keyframes_at_all(self):
        refuses(KeyError, r"keyframes: \(none\)", osik.Robot.from_urdf, ARM, floating_base=False, home="stand")


class TestPrecision:
    def test_cast_and_back(self, nao):
        single = nao.astype("float32")
        assert {leaf.dtype for leaf in jax.tree.leaves(single)} == {jnp.dtype("float32")}
        assert single.tree == nao.tree and single.mj_model is nao.mj_model
        for wide, narrow in zip(jax.tree.leaves(nao), jax.tree.leaves(single.astype(float)), strict=True):
            np.testing.assert_array_equal(np.asarray(wide, np.float32), narrow)
            assert narrow.dtype == jnp.dtype("float64")

    def test_refused(self, nao):
        with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
            nao.astype("float64")

    def test_double_precision_switched_off(self):
        """A robot is used in its own precision first, so that JAX has met its arrays in it."""
        robot = osik.load_robot("arm7")
        osik.FrameTask(robot, "hand")
        with jax.enable_x64(False):
            cast = robot.astype(float)
            tasks = {"hand": osik.FrameTask(cast, "hand", rows="position")}
            self.assert_at_rest(cast, tasks, jnp.float32)

    @pytest.mark.slow
    def test_double_precision_switched_on(self):
        with jax.enable_x64(False):
            robot = osik.load_robot("arm7")
            old = {"hand": osik.FrameTask(robot, "hand", rows="position")}
        cast = robot.astype(float)
        self.assert_at_rest(cast, {"hand": osik.FrameTask(cast, "hand", rows="position")}, jnp.float64)
        with pytest.warns(osik.OsikWarning, match="jax_enable_x64.*robot.astype"):
            self.assert_at_rest(robot, old, jnp.float32)

    @staticmethod
    def assert_at_rest(robot, tasks, dtype):
        solution = osik.solve(robot, robot.q0, tasks)
        path = osik.rollout(robot, robot.q0, tasks, scheme=osik.NullSpace(), steps=2)  # quicker to compile
        assert solution.status == 0 and (path.solution.status == 0).all()
        assert path.q.dtype == dtype and np.isfinite(solution.velocity).all()
        np.testing.assert_allclose(path.q[-1], robot.q0, atol=1e-5)
