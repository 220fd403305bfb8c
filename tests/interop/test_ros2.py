"""The loop of ``osik ros2`` without its transport: what it makes of messages, and what it refuses."""

from types import SimpleNamespace as Message

import numpy as np
import pytest
from mujoco_states import mujoco_at
from refusals import refuses
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.interop.ros2 import Controller, Settings
from osik_jax.interop.ros2._settings import dds_name, read_settings, topic_of_frame
from osik_jax.interop.ros2._steps import Steps

PERIOD = 5_000_000
START = 1_800_000_000_000_000_000
STILL = 1e-12


def header(time_ns, frame_id="world"):
    return Message(stamp=Message(sec=time_ns // 10**9, nanosec=time_ns % 10**9), frame_id=frame_id)


def state(time_ns, joints, stamp=None):
    message = Message(header=header(stamp or time_ns), name=list(joints), position=list(joints.values()))
    return ("state", "", time_ns, message)


def target(time_ns, frame, position, rotation=None, frame_id="world", stamp=None, quaternion=None):
    x, y, z, w = Rotation.from_matrix(np.eye(3) if rotation is None else rotation).as_quat()
    x, y, z, w = (x, y, z, w) if quaternion is None else quaternion
    point = Message(x=position[0], y=position[1], z=position[2])
    pose = Message(position=point, orientation=Message(x=x, y=y, z=z, w=w))
    head = header(time_ns if stamp is None else stamp, frame_id)
    return ("target", frame, time_ns, Message(header=head, pose=pose))


class Run:
    """A controller with a robot that takes its commands as they are."""

    def __init__(self, controller, joints=None, now=START):
        home = np.asarray(controller.robot.q0)[controller.joints.index]
        self.controller, self.memory, self.now = controller, controller.memory(), now
        self.joints = dict(zip(controller.joints.names, home.tolist(), strict=True)) | (joints or {})
        self.outputs = []

    def tick(self, *others, states=True, moves=True):
        """A period; ``others`` are functions of its time."""
        self.now += PERIOD
        received = [state(self.now, self.joints)] if states else []
        self.memory, output = self.controller.tick(self.memory, self.now, received + [f(self.now) for f in others])
        self.outputs.append(output)
        if moves and output.command is not None:
            self.joints |= dict(zip(output.command.names, output.command.positions.tolist(), strict=True))
        return output

    def ticks(self, count, **options):
        for _ in range(count):
            output = self.tick(**options)
        return output

    def pose(self, frame):
        return tuple(np.asarray(part) for part in self.memory.poses[frame])

    def positions(self):
        return np.array([o.command.positions for o in self.outputs if o.command is not None])


def started(controller, joints=None):
    run = Run(controller, joints)
    run.tick()
    return run


@pytest.fixture(scope="module")
def controller(arm):
    return Controller(arm, Settings())


@pytest.fixture(scope="module")
def nao():
    return Controller(osik.load_robot("nao"), Settings())


def to_hand(run, offset):
    position, rotation = run.pose("hand")
    return lambda now: target(now, "hand", position + offset, rotation)


class TestNames:
    def test_joints_are_found_by_name_whatever_their_order(self, controller):
        run, rng = Run(controller), np.random.default_rng(0)
        run.joints = {name: value + 0.1 * rng.normal() for name, value in run.joints.items()}
        wanted = np.array([run.joints[name] for name in controller.joints.names])
        for order in (list(run.joints), list(run.joints)[::-1], list(rng.permutation(list(run.joints)))):
            shuffled = state(START, {name: run.joints[name] for name in order})
            _, output = controller.tick(controller.memory(), START, [shuffled])
            assert output.command.names == controller.joints.names
            np.testing.assert_allclose(output.command.positions, wanted, atol=1e-9)

    def test_two_publishers_may_have_a_part_each(self, controller):
        run = Run(controller)
        first, second = list(run.joints.items())[:3], list(run.joints.items())[3:]
        memory, output = controller.tick(controller.memory(), START, [state(START, dict(first))])
        assert output.command is None and output.phase == "waiting"
        assert "waiting for states of joint4, joint5, joint6, joint7" in output.message
        memory, output = controller.tick(memory, START + PERIOD, [state(START + PERIOD, dict(second))])
        assert output.phase == "moving"

    def test_unknown_names_are_told_and_used_for_nothing(self, controller):
        run = Run(controller, {"gripper_finger": 0.3})
        output = run.tick()
        assert output.phase == "moving" and output.level == 1 and "unknown joints: gripper_finger" in output.message
        assert "gripper_finger" not in output.command.names
        del run.joints["gripper_finger"]
        assert "gripper_finger" in run.ticks(190).message
        output = run.ticks(15)  # a second after its last message
        assert output.level == 0 and output.message == "moving" and not run.memory.unknown

    @pytest.mark.release
    def test_followers_are_known(self, nao):
        run = Run(nao, {"RHipYawPitch": 0.0})
        assert "RHipYawPitch" not in nao.joints.names
        assert run.tick().level == 0

    def test_names_of_the_robot_that_differ_are_mapped(self, arm):
        controller = Controller(arm, Settings(names={"panda_joint2": "joint2"}))
        assert controller.joints.names[:3] == ("joint1", "panda_joint2", "joint3")
        assert Run(controller).tick().command.names == controller.joints.names
        refuses(KeyError, "no joint 'joint9'", Controller, arm, Settings(names={"a": "joint9"}))

    @pytest.mark.parametrize(
        "change, reason",
        [
            (lambda m: m.position.__setitem__(2, np.nan), "not finite"),
            (lambda m: m.position.__setitem__(2, np.inf), "not finite"),
            (lambda m: m.position.pop(), "7 names and 6 positions"),
            (lambda m: m.name.__setitem__(1, "joint1"), "names a joint twice"),
            (lambda m: setattr(m.header.stamp, "sec", m.header.stamp.sec - 1), "0.1 s old"),
            (lambda m: setattr(m.header.stamp, "sec", m.header.stamp.sec + 1), "ahead of this machine's clock"),
            (lambda m: setattr(m, "header", header(0)), "no stamp"),
        ],
    )
    def test_a_broken_state_is_refused_and_said(self, controller, change, reason):
        run = started(controller)
        before = run.memory
        broken = state(run.now, run.joints)
        change(broken[-1])
        run.memory, output = controller.tick(run.memory, run.now + 1, [broken])
        np.testing.assert_array_equal(run.memory.measured, before.measured)
        assert output.level == 1 and reason in output.message and output.values["refused messages"] == "1"


class TestStart:
    def test_is_at_the_measured_configuration_and_stays_there(self, controller):
        run = Run(controller, {"joint2": 0.3, "joint4": -1.0})
        measured = np.array([run.joints[name] for name in controller.joints.names])
        run.ticks(100)
        np.testing.assert_allclose(run.positions(), np.tile(measured, (100, 1)), atol=1e-12)

    def test_speeds_and_accelerations_are_bounded_from_the_first_command_on(self, arm):
        settings = Settings(speed=0.8, acceleration=6.0)
        run = started(Controller(arm, settings))
        run.tick(to_hand(run, [0.3, 0.4, -0.2]))
        run.ticks(500)
        q = run.positions()
        speed = np.diff(q, axis=0) / settings.dt
        change = np.diff(speed, axis=0) / settings.dt
        assert np.abs(speed).max() <= 0.8 + 1e-9 and np.abs(speed).max() > 0.79
        assert np.abs(change).max() <= 6.0 + 1e-6 and np.abs(change).max() > 5.9
        lower, upper = np.asarray(arm.position_lower), np.asarray(arm.position_upper)
        assert (q >= lower).all() and (q <= upper).all()

    def test_a_target_is_reached(self, controller):
        run = started(controller)
        position, rotation = run.pose("hand")
        wanted = position + np.array([0.05, -0.1, 0.05]), Rotation.from_euler("x", 0.3).as_matrix() @ rotation
        run.tick(lambda now: target(now, "hand", *wanted))
        run.ticks(800)
        hand = mujoco_at(controller.robot, [run.joints[name] for name in controller.joints.names]).site("hand")
        np.testing.assert_allclose(hand.xpos, wanted[0], atol=1e-3)
        np.testing.assert_allclose(hand.xmat.reshape(3, 3), wanted[1], atol=5e-3)

    def test_a_joint_outside_its_range_returns_at_a_bounded_speed(self, controller):
        top = float(controller.robot.position_upper[1])
        run = Run(controller, {"joint2": top + 0.1})
        run.ticks(60)
        joint = run.positions()[:, 1]
        assert joint[0] > top + 0.0995 and joint[-1] <= top
        steps = np.diff(joint, prepend=top + 0.1)
        assert steps.min() >= -1.0 / 200 - 1e-12 and np.diff(steps).min() >= -10.0 / 200**2 - 1e-9

    def test_targets_beyond_reach_keep_every_limit_with_a_scheme_that_has_none(self, arm, tmp_path):
        """The classical null space leaves its box; what is sent does not."""
        tasks = {"tool": osik.FrameTask(arm, "hand", gain=50.0), "rest": osik.PostureTask(arm, priority=2)}
        osik.save_controller(tmp_path / "c.json", arm, tasks, scheme=osik.NullSpace(), dt=0.01, source="arm7")
        controller = Controller(None, Settings(controller=str(tmp_path / "c.json")))
        assert controller.dt == 0.01 and controller.frames == ("hand",)
        for robot, rate in ((arm, None), (None, 200.0)):
            with pytest.raises(ValueError, match="has its own robot and rate"):
                Controller(robot, Settings(controller=str(tmp_path / "c.json"), rate=rate))
        run = started(controller)
        run.tick(to_hand(run, [1.5, 1.0, 0.0]))
        run.ticks(300)
        q = run.positions()
        assert (q >= np.asarray(arm.position_lower)).all() and (q <= np.asarray(arm.position_upper)).all()
        assert np.abs(np.diff(q, axis=0)).max() <= 0.01 + 1e-12
        assert np.abs(q[-1] - q[0]).max() > 0.5

    def test_tasks_remember_the_last_velocity_too(self, arm, tmp_path):
        tasks = {"tool": osik.FrameTask(arm, "hand", weight=1e-3), "calm": osik.LowAccelerationTask(arm, weight=10.0)}
        osik.save_controller(tmp_path / "c.json", arm, tasks, dt=0.01, limits=osik.no_limits)
        steps = Steps(None, Settings(controller=str(tmp_path / "c.json"), acceleration=1e3))
        q, loaded, poses = steps.begin(steps.robot.q0)
        velocity = np.full(arm.nv, 0.1)
        found = steps.advance(q, velocity, steps.no_warm_start, loaded, {"hand": poses["hand"]}).velocity
        own = {**loaded, "calm": loaded["calm"].after(velocity)}
        wanted = osik.solve(arm, q, own, scheme=steps.scheme, limits=osik.no_limits, dt=0.01).velocity
        np.testing.assert_allclose(found, wanted, atol=1e-9)
        assert np.abs(found).max() > 0.05


class TestHold:
    def test_the_command_stands_still_within_100_ms_of_the_last_state(self, controller):
        run = started(controller)
        run.tick(to_hand(run, [0.2, 0.3, 0.0]))
        run.ticks(40)
        last = len(run.outputs)
        run.ticks(40, states=False, moves=False)
        after = [output.command for output in run.outputs[last:]]
        moving = [number for number, command in enumerate(after, 1) if np.abs(command.velocities).max() > 0.0]
        assert moving and moving[-1] * PERIOD <= 100_000_000
        np.testing.assert_array_equal(after[-1].positions, after[moving[-1]].positions)
        assert run.outputs[-1].phase == "holding" and run.outputs[-1].level == 2
        assert "no new state of joint1" in run.outputs[-1].message

    def test_one_joint_that_is_silent_stops_all(self, controller):
        run = Run(controller)
        run.ticks(3)
        run.joints = {name: value for name, value in run.joints.items() if name != "joint5"}
        output = run.ticks(15, moves=False)
        assert output.phase == "holding" and output.message == "holding: no new state of joint5"

    def test_a_driver_that_repeats_its_last_state_stops_it_too(self, controller):
        run = Run(controller)
        run.ticks(3)
        stuck = run.now
        for _ in range(15):
            run.tick(lambda now: state(now, run.joints, stamp=stuck), states=False)
        assert run.outputs[-1].phase == "holding" and "not newer" in run.outputs[-1].message

    def test_it_begins_anew_at_what_is_measured_then_and_forgets_targets(self, controller):
        run = started(controller)
        run.tick(to_hand(run, [0.2, 0.3, 0.0]))
        run.ticks(20)
        run.ticks(20, states=False)
        run.joints = {name: value + 0.15 for name, value in run.joints.items()}  # moved by hand meanwhile
        measured = np.array(list(run.joints.values()))
        run.ticks(50)
        assert run.outputs[-1].phase == "moving"
        np.testing.assert_allclose(run.positions()[-50:], np.tile(measured, (50, 1)), atol=1e-9)

    def test_it_waits_for_a_robot_that_does_not_follow(self, controller):
        run = started(controller)
        start = run.outputs[-1].command.positions
        run.tick(to_hand(run, [0.2, 0.3, 0.0]), moves=False)
        output = run.ticks(400, moves=False)
        assert "does not follow: the command waits" in output.message and output.level == 1
        assert 0.19 < np.abs(output.command.positions - start).max() <= 0.2 + 1.0 / 200
        run.joints |= dict(zip(output.command.names, output.command.positions.tolist(), strict=True))
        assert run.ticks(10).level == 0


class TestTargets:
    @pytest.mark.parametrize(
        "options, reason",
        [
            (dict(position=[np.nan, 0.0, 0.0]), "not finite"),
            (dict(quaternion=(0.0, 0.0, 0.0, 0.0)), "length 0"),
            (dict(quaternion=(0.0, 0.0, np.nan, 1.0)), "not finite"),
            (dict(frame_id="camera"), "'camera'; it is one of world, link0"),
            (dict(frame_id=""), "frame_id is ''"),
            (dict(stamp=START - 10**9), "s old"),
            (dict(stamp=0), "no stamp"),
            (dict(stamp=START + 10**10), "ahead"),
        ],
    )
    def test_that_are_wrong_are_refused_and_move_nothing(self, controller, options, reason):
        run = started(controller)
        options = {"position": run.pose("hand")[0] + 0.1, **options}
        output = run.tick(lambda now: target(now, "hand", **options))
        assert output.level == 1 and reason in output.message
        run.ticks(20)
        assert np.abs(np.ptp(run.positions(), axis=0)).max() < STILL
        assert run.ticks(200).level == 0  # it is told for a second

    def test_a_late_target_does_not_replace_a_newer_one(self, controller):
        run = started(controller)
        goal = run.pose("hand")[0] + 0.05
        run.tick(lambda now: target(now, "hand", goal))
        run.tick(lambda now: target(now, "hand", goal + 1.0, stamp=now - 2 * PERIOD))
        np.testing.assert_array_equal(run.memory.targets["hand"][0], goal)
        assert "not newer" in run.outputs[-1].message

    def test_without_stamps_where_the_settings_say_so(self, arm):
        run = started(Controller(arm, Settings(check_stamps=False)))
        run.tick(lambda now: target(now, "hand", [0.4, 0.0, 0.5], stamp=0))
        assert run.outputs[-1].level == 0
        np.testing.assert_array_equal(run.memory.targets["hand"][0], [0.4, 0.0, 0.5])

    @pytest.mark.slow
    def test_in_the_frame_of_a_base_that_moves_freely(self, nao):
        run = started(nao, {"LKneePitch": 0.6, "LAnklePitch": -0.3, "LHipPitch": -0.3})
        body = mujoco_at(nao.robot, run.memory.q).body("torso")
        local = np.array([0.15, 0.1, 0.1])
        run.tick(lambda now: target(now, "l_gripper", local, frame_id="torso"))
        expected = body.xpos + body.xmat.reshape(3, 3) @ local
        np.testing.assert_allclose(run.memory.targets["l_gripper"][0], expected, atol=1e-9)


def test_a_robot_on_feet_stands_where_it_stood_at_home_and_keeps_its_feet(nao):
    """One knee is bent as measured: the base is put where the left sole stands as at home, and the soles stay."""
    run = started(nao, {"LKneePitch": 0.6, "LAnklePitch": -0.3, "LHipPitch": -0.3})
    robot = nao.robot
    start = mujoco_at(robot, run.memory.q)
    home = osik.forward_kinematics(robot, robot.q0).frame_pose(robot, "l_sole")
    np.testing.assert_allclose(start.site("l_sole").xpos, home[0], atol=1e-9)
    np.testing.assert_allclose(start.site("l_sole").xmat.reshape(3, 3), home[1], atol=1e-9)
    goal = run.pose("l_gripper")[0] + [0.03, 0.03, -0.05]
    run.tick(lambda now: target(now, "l_gripper", goal, run.pose("l_gripper")[1]))
    run.ticks(600)
    end = mujoco_at(robot, run.memory.q)
    for sole in ("l_sole", "r_sole"):
        np.testing.assert_allclose(end.site(sole).xpos, start.site(sole).xpos, atol=1e-3)
    np.testing.assert_allclose(end.body("l_gripper").xpos, goal, atol=5e-3)


class TestSettings:
    def test_positions_need_the_order_of_their_receiver(self, arm):
        refuses(ValueError, "has no names", Settings, commands="positions")
        order = tuple(f"joint{number}" for number in (7, 1, 6, 2, 5, 3, 4))
        run = Run(Controller(arm, Settings(commands="positions", joints=order)), {"joint7": 0.7, "joint1": 0.1})
        command = run.tick().command
        assert command.names == order
        np.testing.assert_allclose(command.positions[:2], [0.7, 0.1], atol=1e-9)
        refuses(KeyError, "no joint 'joint8'", Controller, arm, Settings(joints=("joint8",)))
        refuses(ValueError, "twice", Controller, arm, Settings(joints=("joint1", "joint1")))

    @pytest.mark.parametrize(
        "text, message",
        [
            ("rat = 100", "no setting 'rat'; did you mean 'rate'"),
            ("rate = 0", "rate is 0; it is a positive number"),
            ("rate = 'fast'", "rate is 'fast'"),
            ("frames = 'hand'", "frames is 'hand'; it is a list of names"),
            ("check_stamps = 1", "check_stamps is 1; it is true or false"),
            ("commands = 'torques'", "it is 'trajectory' or 'positions'"),
            ("[topics]\nstates = '/a'", "no topic 'states'"),
            ("[names]\na = 3", "a table of names"),
            ("rate = ", "is no TOML"),
        ],
    )
    def test_what_a_file_gets_wrong_is_named(self, tmp_path, text, message):
        (tmp_path / "s.toml").write_text(text)
        refuses((ValueError, KeyError, TypeError), message.replace("?", r"\?"), read_settings, tmp_path / "s.toml")

    def test_a_file_is_read(self, tmp_path):
        text = (
            "rate = 100\nframes = ['hand']\ncontroller = 'c.json'\n[topics]\ntargets = '/go'\n[names]\na = 'joint1'\n"
        )
        (tmp_path / "s.toml").write_text(text)
        settings = read_settings(tmp_path / "s.toml")
        assert settings.dt == 0.01 and settings.frames == ("hand",) and settings.names == {"a": "joint1"}
        assert settings.topics.targets == "/go" and settings.topics.joint_states == "/joint_states"
        assert settings.controller == str(tmp_path / "c.json")

    def test_frames_that_do_not_exist_or_cannot_be_led_are_named(self, arm):
        refuses(KeyError, "'hnad'", Controller, arm, Settings(frames=("hnad",)))
        refuses(ValueError, "in support or in frames", Controller, osik.load_robot("nao"), Settings(frames=("l_sole",)))

    def test_names_of_topics(self):
        assert dds_name("/osik/targets/hand") == "rt/osik/targets/hand"
        assert (
            topic_of_frame("/t", "panda/hand-tip.1") == "/t/panda_hand_tip_1"
            and topic_of_frame("/t", "2nd") == "/t/_2nd"
        )
        for wrong in ("joint_states", "/a b", "/1a", "/a/", "/"):
            refuses(ValueError, "no absolute name", dds_name, wrong)
