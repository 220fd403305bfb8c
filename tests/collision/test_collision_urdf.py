"""Self-collision of URDFs: which pairs are kept by default and by name, and distances against MuJoCo C and coal."""

import functools
import os
import warnings
from pathlib import Path

import coal
import jax
import numpy as np
import pytest
import scipy.spatial
import urdfs
from collision_pairs import coal_hull, mujoco_distances, named, pair_set
from example_files import example_file
from refusals import no_warnings, refuses

import osik_jax as osik
from osik_jax.collision._geometry import MOST_VERTICES, convex_hull
from osik_jax.collision._pairs import members

EMITTERS = "xla_cpu_use_fusion_emitters"  # conftest.py switches them off, where batches of loops in loops may not end


@pytest.fixture(autouse=True)
def with_emitters(monkeypatch: pytest.MonkeyPatch) -> None:
    if EMITTERS in os.environ["XLA_FLAGS"]:
        monkeypatch.setattr(jax, "jit", functools.partial(jax.jit, compiler_options={EMITTERS: True}))


def link(name, *shapes):
    """A link with collision shapes: (name, position, geometry)."""
    collisions = "".join(
        f'<collision name="{called}"><origin xyz="{place}"/><geometry>{geometry}</geometry></collision>'
        for called, place, geometry in shapes
    )
    return urdfs.link(name, urdfs.INERTIAL + collisions)


def joint(name, parent, child, place="0 0 .2", kind="revolute", axis="0 1 0"):
    limit = "" if kind == "fixed" else '<limit lower="-3" upper="3" velocity="1" effort="1"/>'
    return urdfs.joint(name, parent, child, limit, kind, origin=f'xyz="{place}"', axis=axis)


def robot(*parts, **options):
    return osik.Robot.from_urdf(urdfs.urdf(*parts), floating_base=False, **options)


def rod(name, radius=0.02, length=0.12):
    return name, "0 0 .1", f'<cylinder radius="{radius}" length="{length}"/>'


CHAIN = (
    link("a", rod("a_rod")), link("b", rod("b_rod")),
    link("c", rod("c_rod"), ("c_ball", "0 0 .15", '<sphere radius=".03"/>')),
    link("d", rod("d_rod")), joint("j1", "a", "b"), joint("j2", "b", "c"), joint("j3", "c", "d"),
)  # fmt: skip
PEDESTAL = (
    link("floor_plate", ("plate", "0 0 -.05", '<box size="1 1 .02"/>')),
    joint("bolt", "floor_plate", "a", kind="fixed"),
)
TOOL = (link("tool", ("tip", "0 0 .1", '<box size=".03 .03 .1"/>')), joint("weld", "d", "tool", kind="fixed"))


def distances(limit, model, q):
    return np.asarray(jax.jit(lambda m, q: limit.distances(m, osik.forward_kinematics(m, q)))(model, q))


every_pair = functools.partial(osik.CollisionAvoidanceLimit, q0_distance=-np.inf)
"""A limit without the distances at home, which are a program of their own."""
BASE = ("plate", "a_rod")
FUSED = [f"{one} {other}" for one in BASE for other in ("c_rod", "c_ball", "d_rod", "tip")]


@pytest.mark.parametrize(
    ("parts", "options", "pairs"),
    [
        (CHAIN, {}, ["a_rod c_rod", "a_rod c_ball", "a_rod d_rod", "b_rod d_rod"]),
        ((*PEDESTAL, *CHAIN, *TOOL), {}, [*FUSED, "b_rod d_rod", "b_rod tip"]),
        (CHAIN, dict(locked_joints=["j1"]), ["a_rod d_rod", "b_rod d_rod"]),
    ],
    ids=["a chain", "fixed joints", "a locked joint"],
)
def test_default_pairs_are_those_two_joints_apart_or_more(parts, options, pairs):
    """Links that no joint moves apart are one: the base and its pedestal, the last link and its tool."""
    assert named(every_pair(robot(*parts, **options))) == pair_set(*pairs)


def test_a_floor_in_the_world_is_no_neighbour_of_the_first_link():
    """Of an MJCF, what stands in the world itself meets all that moves; a base that is a body of its own does not."""
    text = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" pos="0 0 -1"/>
      <body name="base"><geom name="foot" size=".05"/>
        <body name="rim" pos=".1 0 0"><geom name="edge" size=".02"/></body>
        <body name="first" pos="0 0 .3"><joint axis="0 1 0"/><geom name="one" size=".05"/>
          <body name="second" pos="0 0 .3"><joint axis="0 1 0"/><geom name="two" size=".05"/></body></body></body>
      <body name="post" pos="1 0 0"><geom name="pole" size=".05"/></body></worldbody></mujoco>"""
    limit = every_pair(osik.Robot.from_mjcf(text))
    assert named(limit) == pair_set("floor one", "floor two", "pole one", "pole two", "foot two", "edge two")


@pytest.mark.variants(slow=["fused by glob"], release=["glob of links"])
@pytest.mark.parametrize(
    ("pairs", "kept"),
    [
        ([("b", "d")], ["b_rod d_rod", "b_rod tip"]),
        ([("a", "c*")], ["a_rod c_rod", "a_rod c_ball"]),
        ([("*", "tool")], ["a_rod tip", "b_rod tip"]),
        ([("c_ball", "a_rod")], ["c_ball a_rod"]),
        ([("c", "d")], ["c_rod d_rod", "c_rod tip", "c_ball d_rod", "c_ball tip"]),
        ([("a", "b")], ["a_rod b_rod"]),
    ],
    ids=["links", "glob of links", "fused by glob", "shapes", "neighbours by name", "base and first by name"],
)
def test_pairs_by_names_of_links_shapes_and_globs(pairs, kept):
    """Neighbours are kept where they are asked for by name, and left out where a glob matches them."""
    with no_warnings(osik.OsikWarning):
        limit = osik.CollisionAvoidanceLimit(robot(*CHAIN, *TOOL), pairs=pairs)
    assert named(limit) == pair_set(*kept)


def test_what_the_model_excludes_is_kept_where_it_is_asked_for_by_name():
    text = """<mujoco><worldbody><body name="a"><geom name="ga" size=".05"/>
      <body name="b" pos="0 0 .3"><joint axis="0 1 0"/><geom name="gb" size=".05"/>
        <body name="c" pos="0 0 .3"><joint axis="0 1 0"/><geom name="gc" size=".05"/></body></body></body>
      </worldbody><contact><exclude body1="a" body2="c"/></contact></mujoco>"""
    model = osik.Robot.from_mjcf(text)
    refuses(ValueError, "no pair of shapes is left", osik.CollisionAvoidanceLimit, model)
    refuses(ValueError, "no pair of shapes is left", osik.CollisionAvoidanceLimit, model, pairs=[("a*", "c")])
    assert named(osik.CollisionAvoidanceLimit(model, pairs=[("a", "c")])) == pair_set("ga gc")


def test_contacts_at_home_are_left_out_with_one_warning():
    """d is folded back and reaches b: their rods overlap. By name the pair stays."""
    parts = [link("d", rod("d_rod", length=0.5)) if 'name="d"' in part else part for part in CHAIN]
    folded = robot(*parts, home={"j3": 3.0})
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        limit = osik.CollisionAvoidanceLimit(folded)
    (message,) = [str(w.message) for w in seen if issubclass(w.category, osik.OsikWarning)]
    assert {frozenset(pair) for pair in limit.left_out} == pair_set("b_rod d_rod")
    assert "b_rod (of b)-d_rod (of d) (-0." in message and "a_rod" not in message
    assert named(limit) == pair_set("a_rod c_rod", "a_rod c_ball", "a_rod d_rod")
    with no_warnings(osik.OsikWarning):
        kept = osik.CollisionAvoidanceLimit(folded, pairs=[("b", "d")])
    assert named(kept) == pair_set("b_rod d_rod")


def test_an_obstacle_meets_the_links_of_a_urdf():
    table = {"table": osik.CollisionShape.box((0.5, 0.5, 0.02), (0.6, 0.0, -0.1))}
    chain = robot(*CHAIN)
    limit = osik.CollisionAvoidanceLimit(chain, shapes=table, pairs=[("table", "d")])
    assert named(limit) == pair_set("table d_rod")
    assert {pair for pair in named(every_pair(chain, shapes=table)) if "table" in pair} == pair_set(
        "table b_rod", "table c_rod", "table c_ball", "table d_rod"
    )


def test_names_of_shapes_that_are_given_twice_stay_apart():
    """Two links call their shape alike, and one like a link."""
    parts = (
        link("a", rod("shape")), link("b", rod("c")), link("c", rod("shape")),
        joint("j1", "a", "b"), joint("j2", "b", "c"),
    )  # fmt: skip
    twice = robot(*parts)
    limit = osik.CollisionAvoidanceLimit(twice)
    assert len(limit.pairs) == 1 and limit.pairs[0][0] == "shape" and limit.pairs[0][1].startswith("c/shape")
    assert named(osik.CollisionAvoidanceLimit(twice, pairs=[("a", "c")])) >= named(limit)


# --- meshes ---


def sphere_points(count, radius, seed=0):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def write_obj(path: Path, points: np.ndarray) -> None:
    """All points, and the faces of their hull."""
    faces = scipy.spatial.ConvexHull(points).simplices + 1
    lines = ["v {:.9f} {:.9f} {:.9f}".format(*p) for p in points] + ["f {} {} {}".format(*f) for f in faces]
    path.write_text("\n".join(lines))


@pytest.fixture
def meshed(tmp_path):
    """A chain of three links whose shapes are meshes beside the URDF, one of them scaled and turned."""
    write_obj(tmp_path / "ball.obj", sphere_points(80, 0.05))
    mesh = '<geometry><mesh filename="ball.obj" scale="1 {} 1"/></geometry>'

    def shape(stretch, place):
        return f'<collision><origin xyz="{place}" rpy="0.3 0.2 0.1"/>{mesh.format(stretch)}</collision>'

    links = "".join(f'<link name="{n}">{urdfs.INERTIAL}{shape(s, p)}</link>' for n, s, p in
                    (("a", 1, "0 0 0"), ("b", 2, "0 0 .1"), ("c", 1.5, ".02 0 .05")))  # fmt: skip
    path = tmp_path / "r.urdf"
    path.write_text(
        f"<robot name='r'>{links}{joint('j1', 'a', 'b', '0 0 .3')}{joint('j2', 'b', 'c', '0 0 .3')}</robot>"
    )
    return path


@pytest.mark.slow
def test_meshes_are_read_when_a_limit_needs_them(meshed):
    """With MuJoCo's distances, for longer links too."""
    late = osik.Robot.from_urdf(meshed, floating_base=False)
    assert late.mj_model.ngeom == 0 and late.tree.geom_names == ("a:0", "b:0", "c:0")
    q = np.array([0.4, -1.2])
    for one in (late, late.scaled(length={"c": 1.5})):
        limit = osik.CollisionAvoidanceLimit(one)
        assert limit.pairs == (("a:0", "c:0"),)
        # MuJoCo's vertices have single precision
        np.testing.assert_allclose(distances(limit, one, q), mujoco_distances(one, q, limit.pairs), atol=1e-6)


def test_a_mesh_that_is_missing_is_told_and_left_out(meshed):
    text = meshed.read_text()
    extra = link("d", rod("d_rod")) + joint("j3", "c", "d")
    meshed.write_text(text.replace("ball.obj", "gone.obj", 1).replace("</robot>", extra + "</robot>"))
    late = osik.Robot.from_urdf(meshed, floating_base=False)
    with pytest.warns(osik.OsikWarning, match=r"1 collision meshes cannot be read.*of a\): no file 'gone.obj'"):
        limit = osik.CollisionAvoidanceLimit(late)
    assert named(limit) == pair_set("b:0 d_rod")
    meshed.write_text(text.replace("ball.obj", "gone.obj"))
    late = osik.Robot.from_urdf(meshed, floating_base=False)
    refuses(ValueError, r"no collision mesh of the robot can be read.*gone.obj", osik.CollisionAvoidanceLimit, late)


def test_a_large_hull_is_covered_by_a_smaller_one():
    """The support of the replacement is at least the hull's own in every direction, and at most 2 % more."""
    points = sphere_points(3000, 0.1) * [1.0, 0.6, 1.4]
    hull = convex_hull(points)
    assert len(hull.vertices) == MOST_VERTICES and 0.0 < float(hull.radius) < 0.002
    directions = sphere_points(500, 1.0, seed=3)
    theirs = (points @ directions.T).max(0)
    ours = (np.asarray(hull.vertices) @ directions.T).max(0) + float(hull.radius)
    assert (ours >= theirs).all() and (ours - theirs).max() < 0.004


@pytest.mark.variants(slow=["0.25"], release=["0.1", "0.16"])
@pytest.mark.parametrize("apart", [0.25, 0.16, 0.1])
def test_distances_of_large_hulls_are_those_of_coal(apart):
    """Apart, just apart and overlapping; the hulls are replaced by smaller ones that cover them."""
    a, b = sphere_points(700, 0.08) * [1.0, 0.8, 1.2], sphere_points(700, 0.08, seed=1) * [1.2, 0.9, 1.0]
    shapes = {
        "a": osik.CollisionShape.convex(a),
        "b": osik.CollisionShape.convex(b, position=(apart, 0.0, 0.0), frame="b"),
    }
    free = robot(link("a"), link("b"), joint("j", "a", "b", "0 0 0", kind="revolute", axis="0 0 1"))
    limit = osik.CollisionAvoidanceLimit(free, shapes=shapes, pairs=[("a", "b")])
    for q in (0.0, 0.7):
        got = float(distances(limit, free, np.array([q]))[0])
        turn = np.array([[np.cos(q), -np.sin(q), 0.0], [np.sin(q), np.cos(q), 0.0], [0.0, 0.0, 1.0]])
        place = coal.Transform3s(turn, turn @ [apart, 0.0, 0.0])
        request, result = coal.DistanceRequest(True, True), coal.DistanceResult()
        want = coal.distance(coal_hull(a), coal.Transform3s(), coal_hull(b), place, request, result)
        assert want - 2 * 0.0025 < got < want + 1e-6


# --- robots that people know ---


ROBOTS = {
    "ur5": ("ur_description/urdf/ur5_robot.urdf", False, ("upper_arm_link", "wrist_3_link")),
    "panda": ("panda_description/urdf/panda.urdf", False, ("panda_link1", "panda_hand")),
    "tiago": ("tiago_description/robots/tiago.urdf", False, ("base_link", "arm_4_link")),
    "solo": ("solo_description/robots/solo12.urdf", True, ("base_link", "FL_LOWER_LEG")),
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", True, ("left_wrist_yaw_link", "torso_link")),
    "talos": ("talos_data/robots/talos_full_v2.urdf", True, ("torso_2_link", "arm_left_6_link")),
}


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.variants(slow=["ur5"], release=["tiago", "talos", "g1", "solo", "panda"])
def test_the_default_call_works_on_known_robots(name):
    """With shapes of all links that have some; distances at home are MuJoCo's, or up to 4 mm less."""
    path, floats, (one, other) = ROBOTS[name]
    loaded = osik.Robot.from_urdf(example_file(path), floating_base=floats)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        limit = osik.CollisionAvoidanceLimit(loaded)
    assert len([w for w in seen if issubclass(w.category, osik.OsikWarning)]) == bool(limit.left_out)
    got, want = distances(limit, loaded, loaded.q0), mujoco_distances(loaded, np.asarray(loaded.q0), limit.pairs)
    assert len(want) > 10 and (got < want + 1e-4).all() and (want - got).max() < 0.004
    links = {member.name: member.aliases[0] for member in members(loaded, {})}
    assert {one, other} in [{links[a], links[b]} for a, b in limit.pairs]
