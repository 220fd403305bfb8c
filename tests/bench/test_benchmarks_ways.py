"""The judge of ways: Pinocchio's and coal's verdict on states whose contacts are known."""

import json

import numpy as np
import pinocchio as pin

from benchmarks.ways_judge import Judge, judge_ways, scenes

JOINTS = [f"panda_joint{k}" for k in range(1, 8)]
HOME = np.array([0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8])
HEAD = {
    "joints": JOINTS, "held": {"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04}, "sets": ["one"],
    "allowed": [["panda_link5", "panda_link7"], ["panda_link5", "panda_hand"]],
}  # fmt: skip


def test_states_that_touch_are_counted(tmp_path, capsys) -> None:
    """A cylinder of 5 cm stands where the hand is at home, and not where it is a quarter of a turn further."""
    judge = Judge("panda", HEAD)
    pin.framesForwardKinematics(judge.model, judge.data, HOME)
    hand = judge.data.oMf[judge.model.getFrameId("panda_hand")].translation
    pose = np.append(hand, [1.0, 0.0, 0.0, 0.0])[:, None]
    turned = HOME + np.pi / 2.0 * np.eye(7)[0]
    one = {"set": [0], "index": [4], "objects": [1], "start": [turned], "goal": [HOME]}
    objects = {"kind": [1], "size": [0], "sizes": [[0.05, 0.05, 0.0]], "pose": pose}
    np.savez(tmp_path / "p.npz", head=json.dumps(HEAD), **one, **objects)
    head, problems = scenes(tmp_path / "p.npz")
    assert head == HEAD and list(problems) == [("one", 4)]
    states = np.linspace(turned, HOME, 50)
    judge.place(problems["one", 4]["obstacles"])
    assert judge.is_free(states[0]) and not judge.is_free(states[-1])
    judge_ways(judge, problems, {k: np.array(v) for k, v in dict(
        set=["one", "one"], index=[4, 4], found=[True, True], states=[10, 50], q=[*states[:10], *states]
    ).items()})  # fmt: skip
    assert "2 ways, 60 states; 1 ways touch something" in capsys.readouterr().out
