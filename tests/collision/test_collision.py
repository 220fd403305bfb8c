"""Collision avoidance: distances against MuJoCo C and coal, rows against differences, filters, closed loops."""

import functools
import os

import coal
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from collision_pairs import coal_hull, named, pair_set
from model_files import mjcf
from refusals import no_warnings, refuses
from task_checks import kinematics_at

import osik_jax as osik
from osik_jax.collision import CollisionShape

KINDS = ("sphere", "capsule", "box", "mesh", "cylinder", "ellipsoid")
SIZES = {
    "sphere": ("0.08", "0.11"),
    "capsule": ("0.05 0.12", "0.07 0.09"),
    "box": ("0.1 0.06 0.14", "0.08 0.12 0.05"),
    "cylinder": ("0.08 0.1", "0.06 0.13"),
    "ellipsoid": ("0.1 0.06 0.08", "0.07 0.12 0.05"),
}
POINTS = np.random.default_rng(5).normal(size=(14, 3)) * [0.05, 0.07, 0.06]
"""Of the mesh: a hull of triangles."""


def _zoo():
    """Two free bodies with a geom of each kind, and a floor."""

    def body(name, which):
        geoms = "".join(f'<geom name="{name}_{kind}" type="{kind}" {size(kind, which)} mass="1"/>' for kind in KINDS)
        return f'<body name="{name}"><freejoint/>{geoms}</body>'

    def size(kind, which):
        return 'mesh="rock"' if kind == "mesh" else f'size="{SIZES[kind][which]}"'

    vertices = " ".join(f"{x:.6f}" for x in POINTS.ravel())
    return f"""<mujoco><option ccd_tolerance="1e-10" ccd_iterations="200"/>
      <asset><mesh name="rock" vertex="{vertices}"/></asset>
      <worldbody><geom name="floor" type="plane" size="1 1 0.1" zaxis="0.3 0 1"/>
      {body("a", 0)}{body("b", 1)}</worldbody></mujoco>"""


ARM = mjcf("arm_with_shapes")


@pytest.fixture(scope="module")
def zoo():
    """All distances of two bodies of all kinds in random poses, with MuJoCo's and coal's answers."""
    robot = osik.Robot.from_mjcf(_zoo())
    limit = osik.CollisionAvoidanceLimit(robot, q0_distance=-np.inf)
    rng = np.random.default_rng(0)
    q = rng.normal(size=(150, 14))
    q[:, :3] *= 0.03
    q[:, 7:10] *= rng.uniform(0.02, 0.3, (150, 1))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    q[:, 10:] /= np.linalg.norm(q[:, 10:], axis=1, keepdims=True)
    ours = _jit(jax.vmap(lambda q: limit._nearest(robot, osik.forward_kinematics(robot, q))))(q)
    return robot, limit, q, jax.tree.map(np.asarray, ours)


@pytest.fixture(scope="module")
def arm():
    return osik.Robot.from_mjcf(ARM, velocity_limits={"*": 3.0})


@pytest.fixture(scope="module")
def avoidance(arm):
    """Obstacles of each kind; six rows."""
    shapes = {
        "ball": CollisionShape.sphere(0.1, (0.3, 0.6, 0.4)),
        "shelf": CollisionShape.box((0.15, 0.15, 0.02), (0.4, -0.5, 0.3)),
        "post": CollisionShape.capsule(0.05, (-0.5, 0.3, 0.0), (-0.5, 0.3, 0.8)),
    }
    return osik.CollisionAvoidanceLimit(arm, shapes=shapes, minimum_distance=0.02, max_pairs=6)


@pytest.fixture(scope="module")
def among(arm):
    """A ball and a post in the arm's way, the floor and the arm itself, without boxes: quick to compile."""
    shapes = {
        "ball": CollisionShape.sphere(0.1, (0.3, 0.4, 0.4)),
        "post": CollisionShape.capsule(0.05, (0.45, -0.25, 0.0), (0.45, -0.25, 0.8)),
    }
    return osik.CollisionAvoidanceLimit(arm, shapes=shapes, exclude=["bump"], minimum_distance=0.02, max_pairs=6)


# Without XLA's newer fusions, as conftest.py has it, batches of loops in loops have been seen to go on for ever.
_EMITTERS = "xla_cpu_use_fusion_emitters"  # on again where conftest.py has switched them off
_jit = functools.partial(jax.jit, compiler_options={_EMITTERS: True} if _EMITTERS in os.environ["XLA_FLAGS"] else {})


@_jit
def _distances(limit, robot, q):
    return limit.distances(robot, osik.forward_kinematics(robot, q))


@_jit
def _rows(limit, robot, q, dt):
    return limit.rows(robot, osik.forward_kinematics(robot, q), q, dt)


def _mujoco_distances(robot, limit, q):
    model = robot.mj_model
    data = mujoco.MjData(model)
    ids = [[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in pair] for pair in limit.pairs]
    out = np.zeros((len(q), len(ids)))
    for k, qpos in enumerate(q):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        out[k] = [mujoco.mj_geomDistance(model, data, i, j, 10.0, np.zeros(6)) for i, j in ids]
    return out


def _coal_distance(robot, q, pair):
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    given = []
    for name in pair:
        geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
        pose = coal.Transform3s(data.geom_xmat[geom].reshape(3, 3).copy(), data.geom_xpos[geom].copy())
        given += [_coal_shape(model, geom), pose]
    request, result = coal.DistanceRequest(True, True), coal.DistanceResult()
    request.gjk_tolerance = request.epa_tolerance = 1e-9
    return coal.distance(given[0], given[1], given[2], given[3], request, result)


def _coal_shape(model, geom):
    size = model.geom_size[geom]
    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return coal.Capsule(size[0], 2.0 * size[1])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return coal.Box(2.0 * size)
    return coal_hull(model.mesh_vert)


def _columns(limit, first, second):
    """Pairs of geoms of these kinds."""
    found = [
        k
        for k, pair in enumerate(limit.pairs)
        if sorted(name.split("_")[-1] for name in pair) == sorted((first, second))
    ]
    assert found
    return found


@pytest.fixture(scope="module")
def mujoco_distances(zoo):
    robot, limit, q, _ = zoo
    return _mujoco_distances(robot, limit, q)


EXACT = [("sphere", "sphere"), ("sphere", "capsule"), ("capsule", "capsule"), ("sphere", "box"), ("box", "box")]
EXACT += [("floor", kind) for kind in ("sphere", "capsule", "box", "mesh")]
APART = [("capsule", "box"), ("sphere", "mesh"), ("capsule", "mesh"), ("box", "mesh"), ("mesh", "mesh")]


@pytest.mark.variants(release=["sphere-sphere"])
@pytest.mark.parametrize("kinds", EXACT, ids="-".join)
def test_distance_is_that_of_mujoco(zoo, mujoco_distances, kinds):
    """Apart and overlapping."""
    columns = _columns(zoo[1], *kinds)
    expected = mujoco_distances[:, columns]
    assert (expected > 0.02).any() and (expected < -0.02).any()
    np.testing.assert_allclose(zoo[3].distance[:, columns], expected, atol=1e-8)


@pytest.mark.parametrize("kinds", APART, ids="-".join)
def test_distance_of_shapes_apart_is_that_of_mujoco(zoo, mujoco_distances, kinds):
    """MuJoCo's depths of these kinds are not exact."""
    columns = _columns(zoo[1], *kinds)
    expected = mujoco_distances[:, columns]
    apart = expected > 1e-6
    assert apart.sum() > 20
    np.testing.assert_allclose(zoo[3].distance[:, columns][apart], expected[apart], atol=1e-8)


@pytest.mark.parametrize("round_kind", ["cylinder", "ellipsoid"])
@pytest.mark.parametrize("other", ["sphere", "capsule", "box", "mesh", "floor"])
def test_polyhedra_around_round_shapes_come_nearer_by_little(zoo, mujoco_distances, round_kind, other):
    """Never too far, and too near by no more than the corners stand out: 2 % of 0.08 m, 7.1 % of 0.12 m."""
    columns = _columns(zoo[1], round_kind, other)
    expected = mujoco_distances[:, columns]
    apart = expected > 1e-6
    short = (expected - zoo[3].distance[:, columns])[apart]
    assert short.min() > -1e-7
    assert short.max() < {"cylinder": 0.0016, "ellipsoid": 0.0086}[round_kind]
    assert short.max() > 1e-5


def test_depth_is_that_of_coal_or_more(zoo):
    """Exact where edges are known; of a mesh across whose edges another lies, deeper by a share."""
    robot, limit, q, ours = zoo
    off = {}
    for kinds in (("capsule", "box"), ("box", "box"), ("capsule", "mesh"), ("box", "mesh"), ("mesh", "mesh")):
        for column in _columns(limit, *kinds):
            deep = np.flatnonzero(ours.distance[:, column] < -1e-3)[:40]
            assert len(deep) > 10
            theirs = [_coal_distance(robot, q[k], limit.pairs[column]) for k in deep]
            off.setdefault(kinds, []).extend(np.array(theirs) - ours.distance[deep, column])
    for kinds in (("capsule", "box"), ("box", "box")):
        assert np.abs(off[kinds]).max() < 1e-6, kinds
    for kinds in (("capsule", "mesh"), ("box", "mesh"), ("mesh", "mesh")):
        assert np.min(off[kinds]) > -1e-6 and np.max(off[kinds]) < 0.02 and np.mean(off[kinds]) < 1e-3, kinds


def test_points_are_as_far_apart_as_the_distance(zoo):
    ours = zoo[3]
    np.testing.assert_allclose(np.linalg.norm(ours.normal, axis=-1), 1.0, atol=1e-12)
    expected = ours.distance[..., None] * ours.normal
    exact = [k for kinds in EXACT + APART[:1] for k in _columns(zoo[1], *kinds)]
    np.testing.assert_allclose((ours.point_b - ours.point_a)[:, exact], expected[:, exact], atol=1e-8)


@pytest.mark.release
def test_distances_in_single_precision(zoo):
    """To 1e-6 m where shapes are apart, to 1e-5 m where they overlap, half a metre from the origin."""
    _, limit, q, ours = zoo
    with jax.enable_x64(False):
        robot = osik.Robot.from_mjcf(_zoo())
        single = osik.CollisionAvoidanceLimit(robot, q0_distance=-np.inf)
        got = jax.vmap(_distances, in_axes=(None, None, 0))(single, robot, jnp.asarray(q))
    assert got.dtype == jnp.float32 and single.pairs == limit.pairs
    for kinds in EXACT + APART:
        columns = _columns(limit, *kinds)
        expected = ours.distance[:, columns]
        off = np.abs(got[:, columns] - expected)
        assert off[expected > 1e-3].max() < 1e-6, kinds
        if kinds in EXACT + APART[:1]:
            assert off.max() < 1e-5, kinds


def _soonest(distances, slopes):
    """Pairs in the order in which they could come within 2 cm, all joints being equally fast."""
    return np.argsort((distances - 0.02) / (np.abs(slopes).sum(-1) + 1e-3), axis=1)


@pytest.mark.slow
def test_rows_are_those_of_the_pairs_that_could_meet_soonest(arm, avoidance):
    """Jacobians against central differences of the distances; bounds against the formula."""
    q = np.random.default_rng(2).uniform(-2.0, 2.0, (40, 3))
    dt, h = 0.01, 1e-6

    @_jit
    @jax.vmap
    def both(q):
        kinematics = osik.forward_kinematics(arm, q)
        return avoidance.distances(arm, kinematics), avoidance.rows(arm, kinematics, q, dt)

    steps = np.concatenate([np.zeros((1, 3)), h * np.eye(3), -h * np.eye(3)])
    found, rows = both(np.concatenate(q + steps[:, None]))  # one program: rows of the neighbours are not looked at
    distances, *moved = np.asarray(found).reshape(7, 40, -1)
    slopes = np.stack([moved[k] - moved[k + 3] for k in range(3)], -1) / (2.0 * h)
    rows = jax.tree.map(lambda a: np.asarray(a)[:40], rows)
    closest = _soonest(distances, slopes)[:, :6]
    near = np.take_along_axis(distances, closest, 1)
    np.testing.assert_allclose(rows.jacobian, np.take_along_axis(slopes, closest[..., None], 1), atol=1e-7)
    wanted = np.where(near < 0.25, np.minimum(-20.0 * (near - 0.02), 0.5), -np.inf)
    np.testing.assert_allclose(rows.lower, wanted, atol=1e-12)
    assert (rows.upper == np.inf).all()
    assert (near < 0.0).any() and ((near > 0.02) & (near < 0.25)).any() and (near > 0.25).any()


def test_gain_counts_up_to_one_over_the_step(arm, among):
    q = np.array([0.1, 0.9, -0.4])
    limits = [among.replace(gain=gain, recovery_speed=9.0) for gain in (50.0, 1e3, 10.0)]
    rows = [np.asarray(_rows(limit, arm, q, 0.02).lower) for limit in limits]
    np.testing.assert_allclose(rows[0], rows[1], rtol=1e-12)
    finite = np.isfinite(rows[0])
    assert finite.any()
    np.testing.assert_allclose(rows[2][finite] * 5.0, rows[0][finite], rtol=1e-12)


def _slopes(robot, limit):
    """Derivatives of all that rows are made of, both modes."""

    def numbers(q):
        rows = limit.rows(robot, osik.forward_kinematics(robot, q), q, 0.01)
        return jnp.concatenate([jnp.ravel(rows.jacobian), limit.distances(robot, osik.forward_kinematics(robot, q))])

    return _jit(jax.vmap(lambda q: (jax.jacfwd(numbers)(q), jax.jacrev(numbers)(q))))


@pytest.mark.release
def test_derivatives_of_rows(arm, avoidance):
    """Second derivatives too: against differences of the rows' Jacobians, where nothing jumps."""
    q = np.random.default_rng(3).uniform(-1.5, 1.5, (30, 3))
    forward, backward = _slopes(arm, avoidance)(q)
    np.testing.assert_allclose(forward, backward, atol=1e-9)

    rows, h, checked = jax.vmap(_rows, in_axes=(None, None, 0, None)), 1e-6, 0
    apart = np.repeat(np.asarray(rows(avoidance, arm, q, 0.01).lower) < 0.3, 3, axis=1)
    for dof, step in enumerate(np.eye(3) * h):
        after, before = (rows(avoidance, arm, q + sign * step, 0.01).jacobian.reshape(30, 18) for sign in (1, -1))
        slope = np.asarray(after - before) / (2.0 * h)
        smooth = apart & (np.abs(slope) < 1e3)  # else nearest points jump, or pairs change places
        np.testing.assert_allclose(np.where(smooth, forward[:, :18, dof] - slope, 0.0), 0.0, atol=2e-5)
        checked += smooth.sum()
    assert checked > 1000


def _coincident():
    """Two bodies of the same geoms, each on a slide and a hinge."""

    def body(name, slide, hinge):
        sizes = dict(ball="0.1", rod="0.1 0.2", block="0.1 0.1 0.1", can="0.1 0.1", egg="0.1 0.1 0.1")
        types = dict(ball="sphere", rod="capsule", block="box", can="cylinder", egg="ellipsoid")
        geoms = "".join(f'<geom name="{name}_{k}" type="{types[k]}" size="{sizes[k]}"/>' for k in sizes)
        joints = f'<joint type="slide" axis="{slide}"/><joint type="hinge" axis="{hinge}"/>'
        return f'<body name="{name}">{joints}{geoms}</body>'

    bodies = body("a", "1 0 0", "0 0 1") + body("b", "0 1 0", "1 0 0")
    return osik.Robot.from_mjcf(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")


@pytest.mark.release
def test_everything_is_finite_where_centres_coincide():
    """And where boxes touch face to face, edge to edge, and capsules lie side by side."""
    robot = _coincident()
    limit = osik.CollisionAvoidanceLimit(robot, q0_distance=-np.inf, max_pairs=25)
    q = np.array([[0, 0, 0, 0], [0.2, 0, 0, 0], [0.2, 0, 0.2, 0], [0.0, np.pi / 4, 0.1, 0.0], [0.5, 0, 0, 0]])
    slopes = _slopes(robot, limit)(q)
    assert all(np.isfinite(a).all() for a in slopes)
    distances = dict(zip(limit.pairs, _distances(limit, robot, q[0]), strict=True))
    for pair in (("a_ball", "b_ball"), ("a_rod", "b_rod"), ("a_block", "b_block"), ("a_ball", "b_block")):
        assert distances[pair] == pytest.approx(-0.2)


def test_default_pairs_are_those_that_mujoco_lets_collide(arm):
    """Neighbours, fused links and geoms without masks are left out; the arm's base meets the floor."""
    limit = osik.CollisionAvoidanceLimit(arm, q0_distance=-np.inf)
    assert named(limit) == pair_set("upper hand", "floor upper", "floor middle", "floor bump", "floor hand")
    model = osik.Robot.from_mjcf(ARM.replace("0 0 0.4", "0 0 0.11")).mj_model  # low enough to hit the floor
    data = mujoco.MjData(model)
    rng, seen = np.random.default_rng(4), set()
    for _ in range(2000):
        data.qpos[:] = rng.uniform(-3.0, 3.0, 3)
        mujoco.mj_forward(model, data)
        seen |= {frozenset(model.geom(int(g)).name for g in contact.geom) for contact in data.contact}
    assert seen == named(limit) - pair_set("floor upper")  # which never reaches it


@pytest.mark.parametrize(
    ("given", "pair"),
    [
        (dict(pairs=[("hand", "upper")]), "upper hand"),
        (dict(pairs=[("seen", "u*r")]), "upper seen"),
        (dict(pairs=[("world", "fixed")]), "floor bump"),
        (dict(exclude=["floor"]), "upper hand"),
        (dict(exclude=[("world", "m*"), "upper"]), "floor hand"),
    ],
    ids=["bodies", "unseen", "fused", "one", "globs"],
)
def test_pairs_by_name(arm, given, pair):
    assert named(osik.CollisionAvoidanceLimit(arm, q0_distance=-np.inf, **given)) == pair_set(pair)


def test_locked_joints_and_excludes_of_the_model_make_no_pairs():
    excludes = '<exclude body1="world" body2="hand"/><exclude body1="upper" body2="hand"/>'
    text = ARM.replace("</mujoco>", f"<contact>{excludes}</contact></mujoco>")
    limit = osik.CollisionAvoidanceLimit(osik.Robot.from_mjcf(text), q0_distance=-np.inf)
    assert named(limit) == pair_set("floor upper", "floor middle", "floor bump")
    locked = osik.Robot.from_mjcf(ARM, locked_joints=("elbow",))
    with_lock = osik.CollisionAvoidanceLimit(locked, q0_distance=-np.inf)
    assert named(with_lock) & pair_set("upper hand", "floor middle") == pair_set("floor middle")


def test_mistakes_are_named(arm, avoidance):
    refuses(ValueError, "all 5 pairs are nearer than 9", osik.CollisionAvoidanceLimit, arm, q0_distance=9.0)
    refuses(ValueError, "detection_distance", osik.CollisionAvoidanceLimit, arm, detection_distance=0.0)
    refuses(ValueError, "max_pairs", osik.CollisionAvoidanceLimit, arm, max_pairs=0)
    refuses(ValueError, "so is a geom", osik.CollisionAvoidanceLimit, arm, shapes={"hand": CollisionShape.sphere(0.1)})
    with pytest.raises(KeyError, match="no frame 'hant'"):
        osik.CollisionAvoidanceLimit(arm, shapes={"x": CollisionShape.sphere(0.1, frame="hant")})
    refuses(KeyError, "ball", avoidance.moved, "bal", position=np.zeros(3))
    refuses(ValueError, "position has shape", avoidance.moved, "ball", position=np.zeros(2))
    refuses(TypeError, "it has: minimum_distance", avoidance.replace, max_pairs=3)
    refuses(ValueError, "positive", CollisionShape.sphere, 0.0)
    refuses(ValueError, "no convex hull", CollisionShape.convex, np.eye(3))


def test_shapes_on_links_are_geoms(arm):
    """The same arm, with the hand's sphere added instead of loaded."""
    bare = ARM.replace('name="hand" type="sphere"', 'name="hand" contype="0" conaffinity="0" type="sphere"')
    added = {"palm": CollisionShape.sphere(0.06, (0.1, 0.0, 0.0), frame="hand")}
    robot = osik.Robot.from_mjcf(bare)
    limit = osik.CollisionAvoidanceLimit(robot, shapes=added, q0_distance=-np.inf)
    original = osik.CollisionAvoidanceLimit(arm, q0_distance=-np.inf)
    q = np.array([0.3, 1.2, 1.1])
    got = dict(zip(limit.pairs, _distances(limit, robot, q), strict=True))
    want = dict(zip(original.pairs, _distances(original, arm, q), strict=True))
    assert got["floor", "palm"] == pytest.approx(float(want["floor", "hand"]), abs=1e-14)
    assert got["upper", "palm"] == pytest.approx(float(want["upper", "hand"]), abs=1e-14)


def test_longer_links_have_larger_geoms(arm):
    """Twice the hand: its ball is twice as large and twice as far out."""
    limit = osik.CollisionAvoidanceLimit(arm, pairs=[("hand", "floor")])
    longer = arm.scaled(length={"hand": 2.0})
    q = np.array([0.0, 0.0, np.pi / 2])
    got = [_distances(limit, r, q)[0] for r in (arm, longer)]
    np.testing.assert_allclose(got, [0.4 - 0.16, 0.4 - 0.32], atol=1e-12)


@jax.jit
def _reaches(arm, limit, starts, targets):
    """Closed loops that send the tip from each start to each target: all distances in each step, and the status."""
    limits = osik.ConfigurationLimit(arm), osik.VelocityLimit(arm), limit

    def one(start, target):
        tasks = {
            "tip": osik.FrameTask(arm, "tip", target=(target, jnp.eye(3)), rows="position", gain=8.0),
            "posture": osik.PostureTask(arm, weight=1e-3),
        }
        run = osik.rollout(arm, start, tasks, scheme=osik.WeightedQP(), limits=limits, dt=0.01, steps=150)
        distances = jax.vmap(lambda q: limit.distances(arm, osik.forward_kinematics(arm, q)))(run.q)
        return distances, run.solution.status

    return jax.vmap(one)(starts, targets)


@jax.jit
def _tips(arm, q):
    return jax.vmap(lambda q: osik.forward_kinematics(arm, q).frame_pose(arm, "tip")[0])(q)


@pytest.mark.release
def test_no_step_of_a_closed_loop_penetrates(arm, among):
    """Forty targets that the arm can reach: with the limit 15 mm are kept, without it more than half hit something."""
    reachable = np.random.default_rng(6).uniform(-2.0, 2.0, (40, 3))
    starts, targets = jnp.tile(arm.q0, (40, 1)), _tips(arm, reachable)
    kept, status = _reaches(arm, among, starts, targets)
    free, _ = _reaches(arm, among.replace(minimum_distance=-9.0, detection_distance=-8.0), starts, targets)
    assert (np.asarray(free).min((1, 2)) < 0.0).sum() > 20
    assert np.asarray(kept).min() > 0.015
    assert (np.asarray(status) == osik.Status.SOLVED).all()


@pytest.mark.slow
def test_pairs_that_start_too_near_come_apart(arm, among):
    """From inside the ball at the speed of recovery, until the distance is kept."""
    around = among.moved("ball", position=np.array([0.55, 0.02, 0.4]), size=np.array([0.05, 0.0, 0.0]))
    starts = jnp.tile(arm.q0, (40, 1))
    distances, _ = _reaches(arm, around.replace(recovery_speed=0.2), starts, _tips(arm, starts))
    nearest = np.asarray(distances)[0].min(1)
    assert nearest[0] < -0.05
    speed = np.diff(nearest) / 0.01
    assert speed.max() < 0.22 and (speed[:20] > 0.18).all()
    assert nearest[-1] == pytest.approx(0.02, abs=2e-3)


def test_moving_obstacles_and_numbers_compile_nothing(arm, among):
    tasks = {"posture": osik.PostureTask(arm, weight=1.0)}
    programs = []

    @jax.jit
    def solved(limit, q):
        programs.append(1)
        return osik.solve(arm, q, tasks, scheme=osik.WeightedQP(), limits=(limit,), dt=0.01).velocity

    q = jnp.array([0.3, 0.9, 0.4])
    first = solved(among, q)
    assert np.isfinite(first).all()
    changed = among.moved("post", position=np.array([0.49, 0.2, 0.21]), rotation=np.eye(3)[[1, 2, 0]])
    assert not np.allclose(solved(changed, q), first, atol=1e-3)
    solved(changed.replace(minimum_distance=0.05, gain=3.0, recovery_speed=0.0, detection_distance=0.5), q)
    assert len(programs) == 1


def test_a_batch_of_obstacles_equals_a_loop(arm, among):
    places = np.random.default_rng(7).uniform(-0.5, 0.5, (5, 3))
    q = jnp.array([0.2, 0.8, -0.4])

    moved = jax.vmap(lambda place: among.moved("ball", position=place))(places)
    together = jax.vmap(_rows, in_axes=(0, None, None, None))(moved, arm, q, 0.01)
    for k, place in enumerate(places):
        alone = _rows(among.moved("ball", position=place), arm, q, 0.01)
        np.testing.assert_allclose(together.jacobian[k], alone.jacobian, atol=1e-12)
        np.testing.assert_allclose(together.lower[k], alone.lower, atol=1e-12)


@pytest.mark.parametrize("floor", [(1, 0), (0, 1), (2, 1), (2, 4)])
@pytest.mark.parametrize("ball", [(1, 0), (0, 1), (1, 2), (4, 4)])
def test_masks_are_those_of_mujoco(floor, ball):
    """Ball and floor overlap: they are a pair if MuJoCo finds a contact."""
    masks = [f'contype="{own}" conaffinity="{others}"' for own, others in (floor, ball)]
    robot = osik.Robot.from_mjcf(f"""<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" {masks[0]}/>
      <body><joint type="slide"/><geom name="ball" size="0.1" {masks[1]}/></body></worldbody></mujoco>""")
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_forward(robot.mj_model, data)
    if data.ncon:
        assert osik.CollisionAvoidanceLimit(robot, q0_distance=-np.inf).pairs == (("floor", "ball"),)
    else:
        refuses(ValueError, "no pair of shapes is left", osik.CollisionAvoidanceLimit, robot, q0_distance=-np.inf)


def test_added_shapes_are_filtered_like_geoms(arm):
    """A shape on a link keeps away from neither of its neighbours, above or below, and a half-space from no plane."""
    shapes = {
        "guard": CollisionShape.sphere(0.05, frame="upper"),
        "glove": CollisionShape.sphere(0.05, frame="hand"),
        "lid": CollisionShape.half_space((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), frame="hand"),
    }
    limit = osik.CollisionAvoidanceLimit(
        arm, shapes=shapes, pairs=[(name, "*") for name in shapes], q0_distance=-np.inf
    )
    on_the_arm = pair_set("guard hand", "guard glove", "guard lid", "guard floor", "guard seen")
    assert named(limit) == on_the_arm | pair_set("glove upper", "glove floor", "lid upper")


def test_a_name_with_the_signs_of_a_glob_is_a_name_first(arm):
    shapes = {name: CollisionShape.sphere(0.1, (0.0, 0.0, 2.0)) for name in ("ball[1]", "ball1")}
    limit = osik.CollisionAvoidanceLimit(arm, shapes=shapes, pairs=[("ball[1]", "hand")])
    assert limit.pairs == (("hand", "ball[1]"),)


class TestTooNearAtHome:
    """A ball 5 mm from the hand at q0, where 2 cm are asked for."""

    MINIMUM = 0.02

    @pytest.fixture
    def shapes(self, arm):
        hand, _ = kinematics_at(arm, arm.q0).frame_pose(arm, "geom:hand")
        return {"ball": CollisionShape.sphere(0.05, hand + jnp.array([0.0, 0.06 + 0.05 + 0.005, 0.0]))}

    @pytest.mark.slow
    def test_pairs_asked_for_by_name_are_kept_and_part(self, arm, shapes):
        with no_warnings():
            limit = osik.CollisionAvoidanceLimit(
                arm, shapes=shapes, pairs=[("hand", "ball"), ("floor", "hand")], minimum_distance=self.MINIMUM
            )
        assert named(limit) == pair_set("hand ball", "floor hand")
        assert limit.left_out == ()
        tasks = {"posture": osik.PostureTask(arm, weight=1.0)}
        path = osik.rollout(arm, arm.q0, tasks, limits=(limit,), dt=0.01, steps=60)
        place = limit.pairs.index(("hand", "ball"))
        gaps = np.asarray(jax.vmap(_distances, in_axes=(None, None, 0))(limit, arm, path.q))[:, place]
        assert abs(gaps[0] - 0.005) < 1e-9 and gaps[-1] > self.MINIMUM - 1e-4 and (path.solution.status == 0).all()
        assert (np.diff(gaps) < 0.5 * 0.01 + 1e-4).all()  # at recovery_speed, and no faster

    def test_what_a_glob_loses_is_told_with_its_distance(self, arm, shapes):
        with pytest.warns(osik.OsikWarning, match=r"hand-ball \(0.005 m\)"):
            limit = osik.CollisionAvoidanceLimit(
                arm, shapes=shapes, pairs=[("ball", "*"), ("floor", "hand")], minimum_distance=self.MINIMUM
            )
        assert limit.left_out == (("hand", "ball"),) and ("hand", "ball") not in limit.pairs

    def test_what_is_chosen_here_is_left_out_and_can_be_seen(self, arm, shapes):
        with pytest.warns(osik.OsikWarning, match=r"not kept apart.*hand-ball \(0.005 m\)"):
            limit = osik.CollisionAvoidanceLimit(arm, shapes=shapes, minimum_distance=self.MINIMUM)
        with no_warnings():
            asked = osik.CollisionAvoidanceLimit(
                arm, shapes=shapes, pairs=[("hand", "ball"), ("floor", "hand")], q0_distance=self.MINIMUM
            )
        assert ("hand", "ball") in limit.left_out and ("hand", "ball") not in limit.pairs
        assert asked.left_out == (("hand", "ball"),)

    def test_a_pair_that_cannot_be_kept_apart_isnamed(self, arm):
        with pytest.raises(ValueError, match=r"\('middle', 'fixed'\).*on one body"):
            osik.CollisionAvoidanceLimit(arm, pairs=[("middle", "fixed"), ("floor", "hand")])
        with pytest.raises(ValueError, match=r"\('upp\*', 'middle'\).*neighbouring"):
            osik.CollisionAvoidanceLimit(arm, pairs=[("upp*", "middle"), ("floor", "hand")])


def test_pairs_nearer_than_the_minimum_at_q0_are_left_out_unless_said_otherwise(arm):
    """The hand is stretched out 0.34 m above the floor and 0.3 m from the upper arm, all else is 0.36 m up."""
    with pytest.warns(osik.OsikWarning, match="nearer than 0.35 m"):
        limit = osik.CollisionAvoidanceLimit(arm, minimum_distance=0.35, detection_distance=0.5)
    assert named(limit) == pair_set("floor upper", "floor middle", "floor bump")
    assert limit.pairs == osik.CollisionAvoidanceLimit(arm, q0_distance=0.35).pairs
    refuses(ValueError, "more than minimum_distance", limit.replace, minimum_distance=0.6)


PALM = """
<body name="palm" pos="0.1 0.03 -0.02" euler="20 -30 50">
  <geom name="g_capsule" type="capsule" size="0.03" fromto="0.1 0 0.02 0 0.15 0.1" mass="0.1"/>
  <geom name="g_cylinder" type="cylinder" size="0.03" fromto="0.1 0 0.02 0 0.15 0.1" mass="0.1"/>
  <geom name="g_box" type="box" size="0.03 0.05 0.02" pos="0.02 0.06 0.1" quat="0.5 0.5 0.5 0.5" mass="0.1"/>
  <geom name="g_rock" type="mesh" mesh="rock" pos="0.02 0.06 0.1" quat="0.5 0.5 0.5 0.5" mass="0.1"/>
  <geom name="g_stone" type="mesh" mesh="stone" pos="-0.02 0.01 0.1" mass="0.1"/>
</body>"""


@pytest.mark.release
def test_added_shapes_are_the_geoms_that_they_describe():
    """On a turned frame of the hand, and a slope in the world; distances of both from the upper arm are MuJoCo's."""
    stones = {"rock": POINTS, "stone": POINTS * [0.5, 1.5, 1.0]}
    vertices = {name: " ".join(f"{x:.9f}" for x in points.ravel()) for name, points in stones.items()}
    meshes = "".join(f'<mesh name="{name}" vertex="{text}"/>' for name, text in vertices.items())
    text = ARM.replace("<worldbody>", f"<asset>{meshes}</asset><worldbody>", 1)
    text = text.replace(
        "<geom ", '<geom name="g_slope" type="plane" size="1 1 1" pos="0 0 0.1" zaxis="0.2 -0.3 1"/><geom ', 1
    )
    robot = osik.Robot.from_mjcf(text.replace('<site name="tip"', f'{PALM}<site name="tip"'))
    ends, cyclic = ((0.1, 0.0, 0.02), (0.0, 0.15, 0.1)), np.eye(3)[[2, 0, 1]]
    on = dict(frame="palm")
    shapes = {
        "s_capsule": CollisionShape.capsule(0.03, *ends, **on),
        "s_cylinder": CollisionShape.cylinder(0.03, *ends, **on),
        "s_box": CollisionShape.box((0.03, 0.05, 0.02), (0.02, 0.06, 0.1), cyclic, **on),
        "s_rock": CollisionShape.convex(POINTS, (0.02, 0.06, 0.1), cyclic, **on),
        "s_stone": CollisionShape.convex(POINTS, (-0.02, 0.01, 0.1), **on),
        "s_slope": CollisionShape.half_space((0.0, 0.0, 0.1), (0.4, -0.6, 2.0)),
    }
    limit = osik.CollisionAvoidanceLimit(robot, shapes=shapes, pairs=[("upper", "[gs]_*")], q0_distance=-np.inf)
    limit = limit.moved("s_stone", size=np.array([0.5, 1.5, 1.0]))
    q = np.random.default_rng(8).uniform(-2.5, 2.5, (40, 3))
    ours = np.asarray(jax.vmap(_distances, in_axes=(None, None, 0))(limit, robot, q))
    column = {(set(pair) - {"upper"}).pop(): k for k, pair in enumerate(limit.pairs)}
    given = osik.CollisionAvoidanceLimit(robot, pairs=[("upper", "g_*")], q0_distance=-np.inf)
    theirs = dict(zip(given.pairs, _mujoco_distances(robot, given, q).T, strict=True))
    for pair, expected in theirs.items():
        name = (set(pair) - {"upper"}).pop()
        atol = 7e-4 if name == "g_cylinder" else 1e-7  # a prism's corners stand out by 2 % of 0.03 m
        apart = expected > 1e-3
        assert apart.sum() > 10, name
        for one in (name, name.replace("g_", "s_")):
            np.testing.assert_allclose(ours[apart, column[one]], expected[apart], atol=atol, err_msg=one)
        np.testing.assert_allclose(ours[:, column[name]], ours[:, column[name.replace("g_", "s_")]], atol=atol)


def test_followers_move_pairs_with_their_leaders_and_locked_joints_do_not(arm):
    """Yaw locked, the wrist at 0.3 rad less half of the elbow, whose column is its own less half of the wrist's."""
    text = ARM.replace(
        "</mujoco>",
        """<equality>
      <joint joint1="wrist" joint2="elbow" polycoef="0.3 -0.5 0 0 0"/></equality></mujoco>""",
    )
    tied = osik.Robot.from_mjcf(text, locked_joints=("yaw",))
    q = np.array([0.0, 0.7, 0.3 - 0.35])
    shapes = {"ball": CollisionShape.sphere(0.1, (0.3, 0.4, 0.4))}
    limits = [
        osik.CollisionAvoidanceLimit(robot, shapes=shapes, pairs=[("ball", "hand"), ("floor", "hand")], max_pairs=2)
        for robot in (arm, tied)
    ]
    free, less = _rows(limits[0], arm, q, 0.01), _rows(limits[1], tied, q[1:2], 0.01)
    np.testing.assert_allclose(less.lower, free.lower, atol=1e-12)
    np.testing.assert_allclose(less.jacobian, free.jacobian[:, 1:2] - 0.5 * free.jacobian[:, 2:], atol=1e-12)


def test_capsules_side_by_side_are_nearest_in_the_middle():
    """Of what they have side by side: from x = 0.1 to 0.3."""
    robot = osik.Robot.from_mjcf("""<mujoco><worldbody>
      <geom name="a" type="capsule" size="0.05" fromto="-0.3 0 0 0.3 0 0"/>
      <body><joint type="slide"/><geom name="b" type="capsule" size="0.04" fromto="0.1 0 0.2 0.9 0 0.2"/></body>
      </worldbody></mujoco>""")
    limit = osik.CollisionAvoidanceLimit(robot, q0_distance=-np.inf)
    near = jax.jit(lambda q: limit._nearest(robot, osik.forward_kinematics(robot, q)))(robot.q0)
    np.testing.assert_allclose(near.distance, [0.11], atol=1e-15)
    np.testing.assert_allclose(near.point_a, [[0.2, 0.0, 0.05]], atol=1e-15)
    np.testing.assert_allclose(near.point_b, [[0.2, 0.0, 0.16]], atol=1e-15)
