"""Scenes with other things that move: which tree is the robot, and that its mass, momentum and base are its own."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco_states import mujoco_at
from refusals import refuses
from task_checks import kinematics_at, moved_by

import osik_jax as osik
from osik_jax.kinematics._forward import body_masses, kinematics_by, moving_center
from osik_jax.physics import build_world
from osik_jax.retargeting._body import Build
from osik_jax.retargeting._profile_file import find_profile
from osik_jax.robot._mujoco import mujoco_poses, own_masses, robot_com
from osik_jax.viewer.live._open import default_session

CUBE = '<body name="cube" pos="1 0 .1"><freejoint name="cube_free"/><geom type="box" size=".1 .1 .1" mass="5"/></body>'
FEET = ("l_sole", "r_sole")


def with_cube(nao, *, first: bool):
    text = nao.to_mjcf()
    key = text.index("<keyframe>"), text.index("</keyframe>") + len("</keyframe>")
    text = text[: key[0]] + text[key[1] :]
    at = text.index("<worldbody>") + len("<worldbody>") if first else text.index("</worldbody>")
    scene = osik.Robot.from_mjcf(text[:at] + CUBE + text[at:])
    return scene.with_home({name: float(nao.q0[nao.joint_qpos_index(name)]) for name in nao.joint_names}
                           | {base_name(scene): nao.q0[:7]})  # fmt: skip


def base_name(robot):
    return robot.tree.joint_names[robot.tree.free_bases[0]]


@pytest.fixture(scope="module", params=[True, False], ids=["cube first", "cube last"])
def scene(nao, request):
    return with_cube(nao, first=request.param)


def own(scene):
    """Entries of q and of v that are the robot's, in its order alone."""
    cube_q, cube_v = scene.joint_qpos_index("cube_free"), scene.joint_dof_index("cube_free")
    entries, dofs = np.arange(scene.nq), np.arange(scene.nv)
    return np.delete(entries, range(cube_q, cube_q + 7)), np.delete(dofs, range(cube_v, cube_v + 6))


def posed(nao, scene, seed=0):
    """The same random posture of the robot, alone and in the scene, where the cube is somewhere."""
    rng = np.random.default_rng(seed)
    q = np.asarray(moved_by(nao, nao.q0, rng.normal(size=nao.nv) * 0.2))
    whole = np.asarray(scene.q0).copy()
    whole[own(scene)[0]] = q
    cube = scene.joint_qpos_index("cube_free")
    whole[cube : cube + 3] = rng.normal(size=3)
    return jnp.asarray(q), jnp.asarray(whole)


def com_target(robot):
    """Where the centre of mass is kept, of a task that has a target."""
    target = osik.ComTask(robot).target
    assert target is not None
    return np.asarray(target)


@jax.jit
def of_masses(robot, q):
    """The centre of mass, its Jacobian, the momentum matrix and the mass matrix."""
    kinematics = osik.forward_kinematics(robot, q)
    functions = osik.center_of_mass, osik.com_jacobian, osik.centroidal_momentum_matrix, osik.mass_matrix
    return tuple(function(robot, kinematics) for function in functions)


@pytest.mark.variants(release=["cube first"])
def test_the_cube_has_no_part_in_the_robots_mass_and_momentum(nao, scene):
    """It has in the mass matrix, which is of everything."""
    q, whole = posed(nao, scene)
    center, *matrices, mass = of_masses(scene, whole)
    alone, *expected, _ = of_masses(nao, q)
    np.testing.assert_allclose(center, alone, atol=1e-12)
    for ours, theirs in zip(matrices, expected, strict=True):
        np.testing.assert_allclose(ours[:, own(scene)[1]], theirs, atol=1e-12)
        assert not np.delete(ours, own(scene)[1], axis=1).any()
    cube = scene.joint_dof_index("cube_free")
    np.testing.assert_allclose(np.diag(mass)[cube : cube + 3], 5.0, rtol=1e-12)
    data = mujoco_at(scene, whole)
    np.testing.assert_allclose(center, data.subtree_com[scene.mj_model.body(nao.body_names[0]).id], atol=1e-9)
    np.testing.assert_allclose(robot_com(scene, next(mujoco_poses(scene, whole))), center, atol=1e-9)
    np.testing.assert_allclose(com_target(scene), com_target(nao), atol=1e-12)
    assert "5.3" in repr(nao) and repr(scene).split("mass ")[1][:5] == repr(nao).split("mass ")[1][:5]


@pytest.mark.variants(slow=["cube last"], release=["cube first"])
def test_kernels_leave_the_cube_out_too(nao, scene):
    _, whole = posed(nao, scene, seed=1)
    plain = of_masses(scene, whole)[:2]
    by_kernel = jax.jit(lambda q: moving_center(scene, kinematics_by("core", scene, q)))(whole)
    for got, want in zip(by_kernel, plain, strict=True):
        np.testing.assert_allclose(got, want, atol=1e-12)
    tasks = {"com": osik.ComTask(scene, target=np.array([0.02, 0.0, 0.25]))}
    velocities = [
        osik.solve(scene, whole, tasks, scheme=osik.WeightedQP(backend=backend), dt=0.01).velocity
        for backend in ("jax", "core")
    ]
    np.testing.assert_allclose(velocities[0], velocities[1], atol=1e-7)
    assert not np.delete(np.asarray(velocities[1]), own(scene)[1]).any()


@pytest.mark.variants(release=["cube first"])
def test_balance_is_met_by_the_robot_alone(nao, scene):
    """A centre of mass beyond the polygon: the robot leans, and the cube stays where it is."""
    feet = {name: osik.FrameTask(scene, name, hard=True) for name in FEET}
    polygon = osik.support_polygon(scene, scene.q0, FEET, margin=0.03)
    aside = com_target(scene)[:2] + np.array([0.1, 0.0])
    moved = eqx.tree_at(lambda p: p.offsets, polygon, polygon.offsets + polygon.normals @ aside)
    shifted = osik.ComTask(scene, polygon=moved)
    momentum = osik.AngularMomentumTask(scene, target=np.array([0.1, 0.0, 0.0]), weight=1e-2)
    velocity = np.asarray(osik.solve(scene, scene.q0, {**feet, "balance": shifted, "spin": momentum}).velocity)
    cube = scene.joint_dof_index("cube_free")
    assert not velocity[cube : cube + 6].any() and np.abs(velocity).max() > 1e-4


def test_base_waist_and_retargeting_root_are_the_robots(nao, scene):
    assert scene.floating_base and scene.tree.body_names[scene.tree.root] == nao.body_names[0]
    base = scene.tree.free_bases[0]
    assert osik.FloatingBaseVelocityLimit(scene, linear=0.1).joint == base
    limit = osik.FloatingBaseVelocityLimit(scene, linear=0.1, joint="cube_free")
    assert scene.tree.joint_names[limit.joint] == "cube_free"
    tasks = default_session(scene, feet=FEET).tasks
    assert nao.body_names[0] in tasks and "cube" not in tasks
    profile = find_profile(nao)
    builds = Build.of(nao, profile), Build.of(scene, profile)
    np.testing.assert_allclose(builds[1].root, builds[0].root, atol=1e-12)
    assert builds[1].free == scene.joint_qpos_index(base_name(scene))


def test_the_world_of_physics_has_the_robots_mass(nao):
    world, own = build_world(nao), own_masses(nao) > 0.0
    assert world.model.body_mass[own].sum() == pytest.approx(float(nao.body_mass.sum()), rel=1e-9)


TWO = """<mujoco>{extra}<worldbody>
  <body name="left" pos="0 1 0">{free}<geom size=".1"/><body name="left_arm" pos=".2 0 0">
    <joint name="jl" axis="0 1 0" {left}/><geom size=".05"/><site name="left_tip"/></body></body>
  <body name="right" pos="0 -1 0">{free}<geom size=".1" density="2000"/><body name="right_arm" pos=".2 0 0">
    <joint name="jr" axis="0 1 0" {right}/><geom size=".05"/></body></body>
  <body name="ball" pos="1 0 0"><freejoint/><geom size=".3"/></body></worldbody>{end}</mujoco>"""
RANGE = 'range="-90 90"'
MOTOR = '<actuator><motor joint="{}"/></actuator>'


def two(left="", right="", free="<freejoint/>", extra="", end="", **options):
    return osik.Robot.from_mjcf(TWO.format(left=left, right=right, free=free, extra=extra, end=end), **options)


def mujoco_center(robot, *bodies):
    data, ids = mujoco_at(robot, robot.q0), [robot.mj_model.body(name).id for name in bodies]
    mass = robot.mj_model.body_subtreemass[ids]
    return mass @ data.subtree_com[ids] / mass.sum()


@pytest.mark.variants(release=["limited left"])
@pytest.mark.parametrize(
    ("options", "bodies"),
    [
        (dict(left=RANGE), ["left"]),
        (dict(right=RANGE), ["right"]),
        (dict(left=RANGE, right=RANGE, end=MOTOR.format("jr")), ["right"]),
        (dict(left=RANGE, right=RANGE, root="left_tip"), ["left"]),
        (dict(left=RANGE, right=RANGE, root="right_arm"), ["right"]),
        (dict(left=RANGE, right=RANGE, root=["left", "right"]), ["left", "right"]),
        (dict(left=RANGE, root="ball"), ["ball"]),
        (dict(), ["left", "right", "ball"]),
    ],
    ids=("limited left", "limited right", "driven", "a site", "a link", "both", "the ball", "nothing says"),
)
def test_the_robot_is_what_is_driven_or_limited_or_named(options, bodies):
    robot = two(**options)
    center = osik.center_of_mass(robot, kinematics_at(robot, robot.q0))
    np.testing.assert_allclose(center, mujoco_center(robot, *bodies), atol=1e-12)
    again = osik.Robot.from_mjcf(robot.to_mjcf())
    np.testing.assert_allclose(com_target(again), center, atol=1e-12)


def test_several_candidates_are_asked_about():
    robot = two(left=RANGE, right=RANGE)
    kinematics = kinematics_at(robot, robot.q0)
    asked = r"2 trees that may be the robot.*root=NAME.*trees: left, right"
    for use in (
        lambda: osik.ComTask(robot),
        lambda: osik.center_of_mass(robot, kinematics),
        lambda: osik.com_jacobian(robot, kinematics),
        lambda: osik.centroidal_momentum_matrix(robot, kinematics),
        lambda: robot.tree.root,
    ):
        refuses(ValueError, asked, use)
    one = osik.center_of_mass(robot, kinematics, "right")
    np.testing.assert_allclose(one, mujoco_center(robot, "right"), atol=1e-12)
    task = osik.FrameTask(robot, "left_tip", target=np.array([0.1, 1.0, 0.1]), rows="position")
    assert np.isfinite(osik.solve(robot, robot.q0, {"tip": task}).velocity).all()  # what needs no one robot works
    assert "kg" in repr(robot)
    refuses(KeyError, "no robot root 'lefft'; did you mean 'left'", two, left=RANGE, root="lefft")
    refuses(ValueError, "which free joint", osik.FloatingBaseVelocityLimit, robot, linear=1.0)


def test_the_only_tree_with_joints_is_the_robot():
    text = """<mujoco><worldbody><body name="ball" pos="1 0 0"><freejoint/><geom size=".3"/></body>
      <body name="pendulum" pos="0 0 1"><joint axis="0 1 0"/><geom size=".1" pos="0 0 -.5"/></body>
      </worldbody></mujoco>"""
    np.testing.assert_allclose(com_target(osik.Robot.from_mjcf(text)), [0.0, 0.0, 0.5], atol=1e-12)


def test_an_arm_beside_a_loose_ball_is_bolted_down():
    robot = two(left=RANGE, right=RANGE, free="", root="left")
    assert not robot.floating_base
    np.testing.assert_allclose(com_target(robot), [0.2, 1.0, 0.0], atol=1e-12)  # the base does not count


def test_a_scene_of_one_tree_compiles_as_before(arm, nao):
    """The masses of one robot alone are its leaf itself, so programs are those of a robot without a scene."""
    for robot in (nao, arm):
        assert robot.tree.robots == ()
        assert body_masses(robot) is robot.body_mass
