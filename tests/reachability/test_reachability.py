"""Maps of what a frame gets to: an arm whose reach is a closed form, MuJoCo's kinematics, jobs that go on."""

import mujoco
import numpy as np
import pytest
from core_checks import needs_core
from mujoco_states import mujoco_at
from refusals import refuses
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import cli, reachability
from osik_jax.reachability import _reachability_map
from osik_jax.reachability._frame import read_frame
from osik_jax.reachability._grid import around, spread_rotations

UPPER, FORE, HAND = 0.5, 0.4, 0.2
PLANAR = f"""<mujoco><worldbody><body name="a"><joint name="j1" axis="0 0 1" range="-100 120"/>
<geom type="capsule" fromto="0 0 0 {UPPER} 0 0" size=".02"/>
<body name="b" pos="{UPPER} 0 0"><joint name="j2" axis="0 0 1" range="-30 150"/>
<geom type="capsule" fromto="0 0 0 {FORE} 0 0" size=".02"/>
<body name="c" pos="{FORE} 0 0"><joint name="j3" axis="0 0 1" range="-90 90"/>
<geom type="capsule" fromto="0 0 0 {HAND} 0 0" size=".02"/>
<site name="tip" pos="{HAND} 0 0"/></body></body></body>
<body name="free" pos="0 0 1"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
AXIS = np.array([-0.9, -0.61, -0.33, 0.02, 0.26, 0.43, 0.71, 1.07, 1.4])
GRID = (AXIS, AXIS, np.array([0.0]))
TURNS = np.radians([-100.0, -30.0, 20.0, 75.0, 130.0])
SLACK = 0.02
"""Joints that are nearer to a limit than this [rad] may go either way: a target within the tolerance is reached."""


@pytest.fixture(scope="module")
def planar():
    return osik.Robot.from_mjcf(PLANAR)


def about_z(angles):
    c, s, zero, one = np.cos(angles), np.sin(angles), np.zeros_like(angles), np.ones_like(angles)
    return np.moveaxis(np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]), -1, 0)


def mapped(robot, **changes):
    return reachability.reachability_map(
        robot, "tip", **{"grid": GRID, "orientations": about_z(TURNS), "seeds": 32, "progress": False, **changes}
    )


@pytest.fixture(scope="module")
def planar_map(planar):
    return mapped(planar)


def solutions(x, y, turn):
    """Both configurations of the planar arm, in closed form; NaN where there is none."""
    wrist_x, wrist_y = x - HAND * np.cos(turn), y - HAND * np.sin(turn)
    cosine = (wrist_x**2 + wrist_y**2 - UPPER**2 - FORE**2) / (2.0 * UPPER * FORE)
    bend = np.arccos(np.where(np.abs(cosine) <= 1.0, cosine, np.nan))
    both = []
    for second in (bend, -bend):
        first = np.arctan2(wrist_y, wrist_x) - np.arctan2(FORE * np.sin(second), UPPER + FORE * np.cos(second))
        first = np.arctan2(np.sin(first), np.cos(first))
        third = turn - first - second
        both.append(np.stack([first, second, np.arctan2(np.sin(third), np.cos(third))], -1))
    return np.stack(both)


def within(robot, q, slack):
    """Whether one of the configurations keeps the limits, widened by so much."""
    low, high = np.asarray(robot.position_lower)[:3] - slack, np.asarray(robot.position_upper)[:3] + slack
    return ((q >= low) & (q <= high)).all(-1).any(0)


def test_what_is_reached_is_what_the_closed_form_reaches(planar, planar_map):
    x, y, turn = np.meshgrid(AXIS, AXIS, TURNS, indexing="ij")
    exact = solutions(x, y, turn)
    surely, perhaps = within(planar, exact, -SLACK), within(planar, exact, SLACK)
    reached = planar_map.reached[:, :, 0]
    assert reached[surely].all() and not reached[~perhaps].any()
    assert surely.sum() > 20 and perhaps.sum() - surely.sum() < 8 and (~perhaps).sum() > 20
    np.testing.assert_array_equal(planar_map.share[:, :, 0], reached.mean(-1))
    too_far = np.hypot(*np.meshgrid(AXIS, AXIS, indexing="ij")) - (UPPER + FORE + HAND)
    np.testing.assert_allclose(planar_map.beyond_reach[:, :, 0], np.maximum(too_far, 0.0), atol=1e-9)


def test_manipulability_is_that_of_the_closed_form(planar_map):
    """Of the planar arm, sqrt(det(J' J)) = |det J| of x, y and turn: UPPER FORE |sin j2|."""
    some = planar_map.reached.any(-1)
    np.testing.assert_allclose(
        planar_map.manipulability[some], UPPER * FORE * np.abs(np.sin(planar_map.q[some][:, 1])), atol=1e-9
    )
    assert np.isnan(planar_map.manipulability[~some]).all() and np.isnan(planar_map.q[~some]).all()


def test_what_is_elsewhere_in_the_model_stays(planar, planar_map):
    """The arm's three joints move; the free body, which carries no frame asked for, is where it was."""
    some = planar_map.reached.any(-1)
    np.testing.assert_array_equal(planar_map.q[some][:, 3:], np.broadcast_to(planar.q0[3:], (some.sum(), 7)))


@pytest.mark.slow
def test_configurations_are_where_the_map_says():
    """An arm's map on a grid of its own: by MuJoCo each configuration is at its position, in an orientation asked for,
    and as manipulable as it says."""
    arm = osik.load_robot("arm7")
    found = reachability.reachability_map(arm, "hand", grid=60, orientations=4, seeds=4, progress=False)
    some = found.reached.any(-1)
    assert some.sum() > 8 and found.share[some].mean() > 0.3 and 40 <= some.size <= 60
    jacobian = np.zeros((6, arm.nv))
    for place in np.argwhere(some):
        at = tuple(place)
        q = found.q[at]
        data = mujoco_at(arm, q)
        site = data.site("hand")
        mujoco.mj_jacSite(arm.mj_model, data, jacobian[:3], jacobian[3:], site.id)
        np.testing.assert_allclose(found.manipulability[at], np.sqrt(np.linalg.det(jacobian @ jacobian.T)), atol=1e-9)
        assert np.linalg.norm(site.xpos - found.positions[at]) <= 1e-3
        turned = np.einsum("ij,mij->m", site.xmat.reshape(3, 3), found.rotations[found.reached[at]])
        assert np.arccos(np.clip((turned.max() - 1.0) / 2.0, -1.0, 1.0)) <= 1e-2
        assert ((q >= arm.position_lower) & (q <= arm.position_upper)).all()


@needs_core
def test_an_obstacle_keeps_poses_from_being_reached(planar, planar_map):
    """A ball at the tip keeps clear of another, in the plane: what is nearer to that is not reached, what is far is."""
    ball, apart = np.array([0.43, 0.6, 0.0]), 0.2 + 0.05
    shapes = {"ball": osik.CollisionShape.sphere(0.2, ball), "tip": osik.CollisionShape.sphere(0.05)}
    scene = osik.Scene(shapes).attach("tip", planar, "tip")
    found = mapped(planar, scene=scene, clearance=0.01, seeds=64)
    away = np.linalg.norm(found.positions - ball, axis=-1) - apart
    near = (away < 0.01 - 2e-3) & planar_map.reached.any(-1)
    assert near.sum() >= 2 and not found.reached[near].any()
    assert not (found.reached & ~planar_map.reached).any()
    far = away > 0.1
    assert found.reached[far].sum() > 0.9 * planar_map.reached[far].sum() > 20


@pytest.mark.parametrize("count", [64, 512])
def test_orientations_are_well_spread(rng, count):
    """No two are nearer than 0.4 times what balls of one size in SO(3) allow; holes are smaller than random ones'."""
    spread = spread_rotations(count)
    np.testing.assert_allclose(spread @ spread.mT, np.broadcast_to(np.eye(3), (count, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(spread), 1.0)
    np.testing.assert_array_equal(spread, spread_rotations(count))
    radius = np.linspace(0.0, np.pi, 10_000)
    share = (radius - np.sin(radius)) / np.pi  # of all rotations, those within an angle of one
    assert nearest_pair(spread) > 0.4 * 2.0 * np.degrees(radius[np.searchsorted(share, 1.0 / count)])
    probes = Rotation.random(4000, rng=rng).as_matrix()
    assert widest_hole(spread, probes) < 0.9 * widest_hole(Rotation.random(count, rng=rng).as_matrix(), probes)


def angles_between(a, b):
    return np.degrees(np.arccos(np.clip((np.einsum("aij,bij->ab", a, b) - 1.0) / 2.0, -1.0, 1.0)))


def widest_hole(rotations, probes):
    return angles_between(probes, rotations).min(1).max()


def nearest_pair(rotations):
    between = angles_between(rotations, rotations)
    return between[~np.eye(len(rotations), dtype=bool)].min()


def test_a_map_that_was_stopped_goes_on_and_is_the_same(planar, planar_map, tmp_path, monkeypatch):
    """Stopped after two of its chunks: those are not made again, and the result is that of one go."""
    monkeypatch.setattr(_reachability_map, "_POSES", 16 * len(TURNS))
    whole = mapped(planar)
    done = []

    def stop(now, total):
        done.append((now, total))
        if len(done) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mapped(planar, out=tmp_path, progress=stop)
    finished = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    assert len(finished) == 2
    again = []
    resumed = mapped(planar, out=tmp_path, progress=lambda now, total: again.append((now, total)))
    assert again[0][0] == 48 and again[-1][0] == again[-1][1] == (planar_map.beyond_reach == 0.0).sum()
    assert finished.items() <= {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}.items()
    for name in ("reached", "manipulability", "q", "beyond_reach"):
        np.testing.assert_array_equal(getattr(resumed, name), getattr(whole, name))
    np.testing.assert_array_equal(whole.reached, planar_map.reached)
    refuses(ValueError, r"another job in it.*\[1\]", mapped, planar, out=tmp_path, orientations=about_z(TURNS + 0.1))


def test_a_file_keeps_it(planar_map, tmp_path):
    planar_map.save(tmp_path / "map.npz")
    loaded = reachability.load_map(tmp_path / "map.npz")
    assert loaded.frame == "tip"
    for name in ("x", "y", "z", "rotations", "reached", "beyond_reach", "manipulability", "q", "links"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(planar_map, name))
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(ValueError, match=r"other\.npz is no reachability map: it has no format"):
        reachability.load_map(tmp_path / "other.npz")
    with open(tmp_path / "single.npz", "wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(ValueError, match=r"single\.npz holds one array and not several by name"):
        reachability.load_map(tmp_path / "single.npz")


def test_a_file_that_was_cut_off_is_told(planar_map, tmp_path):
    planar_map.save(tmp_path / "map.npz")
    content = (tmp_path / "map.npz").read_bytes()
    for kept in (0, 3, len(content) // 2, len(content) - 5):
        (tmp_path / "map.npz").write_bytes(content[:kept])
        with pytest.raises(ValueError, match=r"map\.npz cannot be read as an \.npz of plain arrays"):
            reachability.load_map(tmp_path / "map.npz")


def test_the_picture_shows_the_slice(planar_map, tmp_path):
    """A flat map is one slice, coloured where something is reached, over the arm at home."""
    figure = planar_map.figure()
    (place,) = [axes for axes in figure.axes if axes.get_xlabel()]
    assert (place.get_xlabel(), place.get_ylabel(), place.get_title()) == ("x [m]", "y [m]", "z = 0 m")
    share = planar_map.share[:, :, 0].T
    nothing, shown = (mesh.get_array() for mesh in place.collections)
    np.testing.assert_array_equal(np.ma.getmaskarray(shown), share == 0.0)
    np.testing.assert_array_equal(shown.compressed(), share[share > 0.0])
    beyond = planar_map.beyond_reach[:, :, 0].T > 0.0
    np.testing.assert_array_equal(np.ma.getmaskarray(nothing), beyond | (share > 0.0))
    np.testing.assert_allclose(place.lines[0].get_xdata()[[0, -1]], [0.0, UPPER + FORE + HAND], atol=1e-12)
    figure.savefig(tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 10_000
    refuses(ValueError, "at is 'here'; it is a point", planar_map.figure, at="here")


def test_grids_go_around_what_is_reached(planar):
    x, y, z = around(read_frame(planar, "tip", None, 0), 500)
    assert 400 <= len(x) * len(y) <= 500 and z.tolist() == [0.0]
    np.testing.assert_allclose(np.concatenate([np.diff(x), np.diff(y)]), x[1] - x[0])
    assert x[-1] == pytest.approx(UPPER + FORE + HAND, abs=0.15)


def test_mistakes(planar, tmp_path):
    refuses(KeyError, "no frame 'tp'; did you mean 'tip'", reachability.reachability_map, planar, "tp")
    with pytest.raises(ValueError, match="'free' is not carried by hinges and slides alone"):
        reachability.reachability_map(planar, "free")
    refuses(TypeError, r"grid is \[1\.0\]; it is \(x, y, z\)", mapped, planar, grid=[1.0])
    refuses(ValueError, "y of the grid is .* increasing", mapped, planar, grid=(AXIS, AXIS[::-1], [0.0]))
    refuses(ValueError, "positions is 0; it is an integer, at least 1", mapped, planar, grid=0)
    refuses(ValueError, "orientations is 0", mapped, planar, orientations=0)
    refuses(ValueError, r"orientations have shape \(5,\)", mapped, planar, orientations=TURNS)
    refuses(ValueError, "rotations that are none", mapped, planar, orientations=2.0 * about_z(TURNS))
    stack = osik.Scene.stack([osik.Scene()])
    refuses(ValueError, "scene is a stack of scenes; give one scene", mapped, planar, scene=stack)
    refuses(ValueError, "seeds is 0", mapped, planar, seeds=0)
    refuses(ValueError, "a tolerance is 0", mapped, planar, position_tolerance=0, out=tmp_path / "none")
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_the_command_writes_a_map_and_a_picture_and_goes_on(planar, tmp_path, capsys, monkeypatch):
    model, out = tmp_path / "planar.xml", tmp_path / "map.npz"
    model.write_text(PLANAR)
    words = ["reach", "--robot", str(model), "--frame", "tip", "--out", str(out)]
    words += ["--positions", "60", "--orientations", "8", "--seeds", "8"]
    assert cli.main([*words[:4], "tp", *words[5:]]) == 2
    assert "no frame 'tp'; did you mean 'tip'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [model]

    def stopped(*args, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(_reachability_map, "inverse_kinematics", stopped)
        assert cli.main(words) == 130
    assert f"the same command goes on where it was ({out}.chunks)" in " ".join(capsys.readouterr().err.split())
    assert cli.main([*words, "--key", "1"]) == 2
    assert "map.npz.chunks has another job in it" in "".join(capsys.readouterr().err.split("\n")) and not out.exists()
    assert cli.main(words) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.npz", "map.png", "planar.xml"]
    found = reachability.load_map(out)
    assert found.reached.shape[3] == 8 and 50 <= found.share.size <= 60
    told = capsys.readouterr()
    assert f"{found.share.size} (" in told.out
    tried = int((found.beyond_reach == 0.0).sum())
    assert f"{tried} of {tried} positions" in told.err
