"""``CollisionAvoidanceLimit`` with a scene: rows beside differences, the step beside plain JAX, loops beside MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from core_checks import needs_core
from refusals import refuses

import osik_jax as osik
from osik_jax.collision import CollisionShape

pytestmark = needs_core

TABLE = dict(half_sizes=np.array([0.2, 0.3, 0.02]), position=np.array([0.45, 0.0, 0.3]))
ARM = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="base"><geom name="foot" type="cylinder" size="0.1 0.05"/>
  <body name="upper" pos="0 0 0.1"><joint name="turn" axis="0 0 1" range="-3 3"/>
    <joint name="lift" axis="0 1 0" range="-2 2"/>
    <geom name="upper" type="capsule" fromto="0 0 0.1 0 0 0.35" size="0.05"/>
  <body name="fore" pos="0 0 0.4"><joint name="elbow" axis="0 1 0" range="-2.5 2.5"/>
    <geom name="fore" type="box" pos="0 0 0.15" size="0.04 0.03 0.12"/>
  <body name="wrist" pos="0 0 0.3"><joint name="bend" axis="1 0 0" range="-2 2"/>
    <geom name="wrist" type="cylinder" pos="0 0 0.05" size="0.03 0.04"/>
  <body name="hand" pos="0 0 0.1"><joint name="roll" axis="0 1 0" range="-2 2"/>
    <geom name="hand" type="mesh" mesh="palm" pos="0 0 0.05"/>
  </body></body></body></body></body></worldbody>
  <asset><mesh name="palm" vertex="{}"/></asset></mujoco>"""


def _palm():
    """A hull that is large enough for the core to use its edges."""
    points = np.random.default_rng(2).normal(size=(200, 3))
    points *= np.array([0.05, 0.03, 0.06]) / np.linalg.norm(points, axis=1, keepdims=True)
    return " ".join(f"{x:.6f}" for x in points.ravel())


@pytest.fixture(scope="module")
def arm():
    return osik.Robot.from_mjcf(ARM.format(_palm()), velocity_limits={"*": 3.0})


@pytest.fixture(scope="module")
def scene():
    shapes = {
        "table": CollisionShape.box(TABLE["half_sizes"], TABLE["position"]),
        "post": CollisionShape.cylinder(0.05, [0.1, 0.45, 0.0], [0.1, 0.45, 0.6]),
        "floor": CollisionShape.half_space([0.0, 0.0, -0.1], [0.0, 0.0, 1.0]),
    }
    return osik.Scene(shapes)


@pytest.fixture(scope="module")
def limit(arm, scene):
    return osik.CollisionAvoidanceLimit(arm, scene=scene, minimum_distance=0.02, detection_distance=0.3, max_pairs=6)


@pytest.fixture(scope="module")
def tasks(arm):
    return {"hand": osik.FrameTask(arm, "hand", rows="position"), "posture": osik.PostureTask(arm, weight=1e-3)}


def _configurations(arm, count, seed=0):
    most = np.array([1.8, 1.2, 1.5, 1.2, 1.2])
    return np.random.default_rng(seed).uniform(-most, most, (count, arm.nq))


def _rows(limit, arm, q, dt=0.01):
    return limit.rows(arm, osik.forward_kinematics(arm, q), q, dt)


def test_rows_are_those_of_the_nearest_pairs(arm, scene, limit):
    """Distances are those of ``clearance``, Jacobians their central differences, bounds those of the formula."""
    q, h = _configurations(arm, 30), 1e-6
    every = jax.jit(jax.vmap(lambda q: limit.distances(arm, osik.forward_kinematics(arm, q))))
    rows = jax.jit(jax.vmap(lambda q: _rows(limit, arm, q)))(q)
    steps = np.concatenate([np.zeros((1, 5)), h * np.eye(5), -h * np.eye(5)])
    found = np.asarray(every(np.concatenate(q + steps[:, None]))).reshape(11, 30, -1)
    np.testing.assert_allclose(found[0].min(1), osik.clearance(arm, q, scene).distance, atol=1e-12)
    slopes = np.stack([found[1 + k] - found[6 + k] for k in range(5)], -1) / (2.0 * h)
    nearest = np.argsort(found[0], 1)[:, :6]
    near = np.take_along_axis(found[0], nearest, 1)
    wanted = np.where(near < 0.3, np.minimum(-20.0 * (near - 0.02), 0.5), -np.inf)
    np.testing.assert_allclose(rows.lower, wanted, atol=1e-9)
    apart = (near > 1e-3) & (near < 0.3)  # in an overlap of curved shapes the depth is not the shortest one
    expected = np.take_along_axis(slopes, nearest[..., None], 1)
    # nearest points of round shapes are known to the root of the 1e-11 m of their distance
    np.testing.assert_allclose(np.asarray(rows.jacobian)[apart], expected[apart], atol=1e-5)
    assert apart.sum() > 80 and (near < 0.0).any() and (near > 0.3).any()


@pytest.mark.release
@pytest.mark.parametrize(
    ("post", "h", "atol"), [("capsule", 1e-6, 2e-4), ("cylinder", 1e-4, 0.05)], ids=["exact", "side"]
)
def test_derivatives_of_rows_are_differences(post, h, atol):
    """With respect to the configuration, and to the place of an obstacle: of flat and of round shapes, but for rims.

    Nearest points on a cylinder are known to 3e-6 m, so that differences of theirs are rough.
    """
    text = ARM.replace('"cylinder" size="0.1 0.05"', '"sphere" size="0.1"').replace('"cylinder" pos', '"capsule" pos')
    arm = osik.Robot.from_mjcf(text.format(_palm()))
    tall = getattr(CollisionShape, post)(0.05, [0.1, 0.45, -2.0], [0.1, 0.45, 3.0])
    shapes = {"table": CollisionShape.box(TABLE["half_sizes"], TABLE["position"]), "post": tall}
    scene = osik.Scene(shapes)
    limit = osik.CollisionAvoidanceLimit(arm, scene=scene, detection_distance=0.5, max_pairs=6)

    def numbers(of):
        moved = limit.replace(scene=scene.moved("table", (TABLE["position"] + of[5:], np.eye(3))))
        rows = _rows(moved, arm, of[:5])
        return jnp.concatenate([rows.jacobian, jnp.maximum(rows.lower, -99.0)[:, None]], 1)

    given = np.concatenate([_configurations(arm, 12, seed=3), np.zeros((12, 3))], 1)
    value, forward, backward = jax.jit(
        jax.vmap(lambda of: (numbers(of), jax.jacfwd(numbers)(of), jax.jacrev(numbers)(of)))
    )(given)
    np.testing.assert_allclose(forward, backward, atol=1e-9)
    steps = h * np.eye(8)
    around = np.concatenate([given[:, None] + steps, given[:, None] - steps], 1).reshape(-1, 8)
    after, before = np.moveaxis(np.asarray(jax.jit(jax.vmap(numbers))(around)).reshape(12, 2, 8, 6, 6), 1, 0)
    slope = np.moveaxis((after - before) / (2.0 * h), 1, -1)
    # no jumps of nearest points, no pairs that change places, and no overlap
    still = np.abs(after + before - 2.0 * np.asarray(value)[:, None]).max((1, -1)) < 0.1 * atol
    smooth = still & (np.asarray(value)[..., -1] < 0.19)
    assert smooth.sum() > 30 and (np.abs(slope[smooth]) > 0.1).any((0, 1)).all()
    np.testing.assert_allclose(np.asarray(forward)[smooth], slope[smooth], atol=atol, rtol=0.0)


def _steps_of(arm, limit, tasks, scheme):
    @jax.jit
    @jax.vmap
    def steps(q, target):
        aim = {"hand": (target, jnp.eye(3))}
        return osik.solve(arm, q, tasks, scheme=scheme, limits=(limit,), targets=aim, dt=0.01)

    return steps


@pytest.mark.slow
def test_the_step_in_one_call_is_that_of_plain_jax(arm, limit, tasks):
    """Velocities and statuses, also where rows contradict each other or the box: as little violation as possible."""
    rng = np.random.default_rng(5)
    q, targets = _configurations(arm, 150, seed=5), rng.uniform([-0.6, -0.6, -0.2], [0.6, 0.6, 1.0], (150, 3))
    tight = limit.replace(recovery_speed=9.0)
    core, plain = (
        _steps_of(arm, tight, tasks, osik.WeightedQP(damping=1e-4, backend=backend))(q, targets)
        for backend in ("core", "jax")
    )
    status = np.asarray(plain.status)
    np.testing.assert_array_equal(core.status, status)
    assert (status == osik.Status.SOLVED).sum() > 30 and (status == osik.Status.INFEASIBLE).sum() >= 5
    solved = status == osik.Status.SOLVED
    # 1e-5: kinematics differ by roundoff, and by that nearest points on round shapes move by 3e-6 m
    np.testing.assert_allclose(core.velocity[solved], plain.velocity[solved], atol=1e-5)
    np.testing.assert_allclose(core.box_violation, plain.box_violation, atol=1e-7)
    rows = jax.jit(jax.vmap(lambda q: _rows(tight, arm, q)))(q[~solved])
    missed = [
        np.linalg.norm(
            np.maximum(rows.lower - jnp.einsum("lkv,lv->lk", rows.jacobian, of.velocity[~solved]), 0.0), axis=1
        )
        for of in (core, plain)
    ]
    np.testing.assert_allclose(*missed, rtol=1e-6)  # the least one; several velocities may have it
    assert missed[0].min() > 1e-3


def test_a_controller_takes_the_same_steps(arm, limit, tasks):
    """Without XLA, also after the scene and a number of the limit are replaced; nothing is laid out anew."""
    controller = osik.Controller(arm, tasks, scheme=osik.WeightedQP(damping=1e-4), limits=(limit,), dt=0.01)
    plain = controller._plain
    assert plain is not None
    moved = limit.replace(scene=limit.scene.moved("table", ([0.5, 0.2, 0.5], np.eye(3))), gain=5.0)
    for one in (limit, moved):
        controller.limits = (one,)
        solved = _steps_of(arm, one, tasks, osik.WeightedQP(damping=1e-4))
        for q in _configurations(arm, 4, seed=7):
            found = controller.step(q, {"hand": (np.array([0.4, 0.0, 0.3]), np.eye(3))})
            expected = jax.tree.map(lambda a: a[0], solved(q[None], jnp.array([[0.4, 0.0, 0.3]])))
            np.testing.assert_allclose(found.velocity, expected.velocity, atol=1e-9)
            assert found.status == expected.status
    assert controller._plain is plain


def _judge():
    """The arm's model with the table and the floor as MuJoCo's own geoms."""
    spec = mujoco.MjSpec.from_string(ARM.format(_palm()))
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=TABLE["half_sizes"], pos=TABLE["position"]
    )
    model = spec.compile()
    return model, mujoco.MjData(model)


def _distance_to_table(judge, q):
    model, data = judge
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    names = ("upper", "fore", "wrist", "hand")
    return min(mujoco.mj_geomDistance(model, data, model.geom(n).id, model.geom("table").id, 2.0, None) for n in names)


def test_a_loop_presses_on_a_table_and_keeps_its_distance(arm, limit, tasks):
    """The target is inside the table: the hand comes as near as it may and no nearer, by MuJoCo's distance."""
    judge, target = _judge(), {"hand": (TABLE["position"], np.eye(3))}
    start = np.array([0.0, 0.5, 0.4, 0.3, 0.0])
    nearest = {}
    for name, limits in (("free", ()), ("kept", (limit,))):
        controller = osik.Controller(arm, tasks, scheme=osik.WeightedQP(damping=1e-4), limits=limits, dt=0.01)
        q, gaps = start, []
        for _ in range(250):
            solution = controller.step(q, target)
            assert solution.status == osik.Status.SOLVED
            q = controller.integrate(q, solution.velocity)
            gaps.append(_distance_to_table(judge, q))
        nearest[name] = min(gaps), gaps[-1]
    assert nearest["free"][0] < -0.01
    assert nearest["kept"][0] > 0.0185 and nearest["kept"][1] < 0.022


def test_a_batch_of_scenes_equals_a_loop(arm, limit):
    q = _configurations(arm, 4, seed=9)
    places = np.array([[0.45, 0.0, 0.3], [0.2, 0.4, 0.5], [-0.3, -0.3, 0.4], [0.4, -0.3, 0.6]])
    scenes = [limit.scene.moved("table", (place, np.eye(3))) for place in places]
    together = jax.jit(jax.vmap(lambda scene, q: _rows(limit.replace(scene=scene), arm, q)))
    programs = []

    @jax.jit
    def alone(scene, q):
        programs.append(1)
        return _rows(limit.replace(scene=scene), arm, q)

    rows = together(osik.Scene.stack(scenes), q)
    for k, scene in enumerate(scenes):
        jax.tree.map(lambda a, b, k=k: np.testing.assert_allclose(a[k], b, atol=1e-12), rows, alone(scene, q[k]))
    assert len(programs) == 1


def test_clearance_of_a_batch_of_places(arm, scene):
    """One configuration, and places that are traced: their numbers alone have an axis of lanes."""
    places = np.array([[0.45, 0.0, 0.3], [0.2, 0.4, 0.5], [-0.3, -0.3, 0.4]])

    def distance(place):
        return osik.clearance(arm, arm.q0, scene.moved("table", (place, np.eye(3)))).distance

    np.testing.assert_allclose(jax.vmap(distance)(places), [distance(place) for place in places], atol=1e-12)


def test_fewer_pairs_than_rows_and_none(arm):
    """Rows of no pair are zeros without bounds; an empty scene keeps the arm's own shapes apart."""
    limit = osik.CollisionAvoidanceLimit(arm, scene=osik.Scene({}), q0_distance=-np.inf, max_pairs=50)
    rows = _rows(limit, arm, arm.q0)
    absent = np.asarray(rows.lower) == -np.inf
    assert absent.sum() >= 50 - len(limit.pairs) and not np.asarray(rows.jacobian)[absent].any()
    assert ("upper", "wrist") in limit.pairs or ("wrist", "upper") in limit.pairs
    far = limit.replace(detection_distance=1e-3, minimum_distance=-1.0)
    assert (np.asarray(_rows(far, arm, arm.q0).lower) == -np.inf).all()


def test_wrong_arguments_are_named(limit):
    refuses(TypeError, "limit.replace", limit.moved, "table", position=np.zeros(3))
    refuses(TypeError, "make an osik_jax.Scene", limit.replace, scene=3)


@pytest.mark.slow
def test_derivatives_of_a_step_with_active_rows():
    """Of the velocity, with respect to the table's place and to q, where the hand presses on the table."""
    arm = osik.Robot.from_mjcf(
        ARM.replace('"cylinder" pos', '"capsule" pos').format(_palm()), velocity_limits={"*": 3.0}
    )
    scene = osik.Scene({"table": CollisionShape.box(TABLE["half_sizes"], TABLE["position"])})
    limit, scheme = osik.CollisionAvoidanceLimit(arm, scene=scene, minimum_distance=0.02), osik.WeightedQP(damping=1e-3)
    hand = osik.FrameTask(arm, "hand", rows="position", target=(TABLE["position"], np.eye(3)))
    tasks = {"hand": hand, "posture": osik.PostureTask(arm, weight=1e-3)}
    controller, q = (
        osik.Controller(arm, tasks, scheme=scheme, limits=(limit,), dt=0.01),
        np.array([0.0, 0.5, 0.4, 0.3, 0.0]),
    )
    for _ in range(60):
        solution = controller.step(q)
        q = controller.integrate(q, solution.velocity)
    assert np.asarray(solution.warm_start)[5:].any()

    def velocity(of):
        moved = limit.replace(scene=scene.moved("table", (of[:3], np.eye(3))))
        return osik.solve(arm, of[3:], tasks, scheme=scheme, limits=(moved,), dt=0.01).velocity

    at, h = np.concatenate([TABLE["position"], q]), 1e-6
    around = jax.jit(jax.vmap(velocity))(np.concatenate([at + h * np.eye(8), at - h * np.eye(8)]))
    slope = (np.asarray(around[:8]) - np.asarray(around[8:])).T / (2.0 * h)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(velocity))(at), slope, atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.jacrev(velocity))(at), slope, atol=1e-6)
    assert np.abs(slope).max() > 10.0
