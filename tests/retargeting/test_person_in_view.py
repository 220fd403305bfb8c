"""The person of a retargeted motion beside the robot, as ``osik view`` plays them."""

from pathlib import Path

import numpy as np
import pytest
from motion_files import dancer, write_bvh

import osik_jax as osik
from osik_jax.cli._retarget import Retarget
from osik_jax.viewer.live._playback import read_motion

FRAMES = 20


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    clip = write_bvh(folder / "dance <1>.bvh", dancer(FRAMES), 0.01)
    assert Retarget(clip=str(clip), robot="nao", out=folder / "out").run() == 0
    return folder / "out"


def test_view_plays_the_person_beside_the_robot(written: Path) -> None:
    motion = read_motion(written / "motion.npz", osik.load_robot("nao"))
    person = motion.person
    assert person is not None and len(motion.runs["motion"]) == len(person.points) == FRAMES
    lengths = np.stack([np.linalg.norm(person.points[:, a] - person.points[:, b], axis=-1) for a, b in person.bones])
    assert len(lengths) >= 14 and np.ptp(lengths[:8], axis=1).max() < 1e-6  # limbs are bones of one length
    sized = person.sized(np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.5]]), motion.runs["motion"][:, :3], 0.2)
    assert np.linalg.norm(np.ptp(sized.points[0], axis=0)) == pytest.approx(np.hypot(0.3, 0.5))
    assert sized.points[0, :, 2].min() == pytest.approx(0.2)
