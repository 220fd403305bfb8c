"""Choice of the robot among the trees of a scene: trees with driven or limited joints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np

from ..._errors import OsikTypeError, OsikValueError, unknown_name

ROBOT_ROOTS = "robot_roots"
"""A custom text of this name holds the bodies whose trees are the robot, separated by spaces."""

_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_BALL))


def robot_trees(
    model: mujoco.MjModel, names: Sequence[str], locked: Iterable[int], root: str | Sequence[str] | None
) -> tuple[tuple[int, ...], ...]:
    """Return the trees of each robot that a model may show: one robot if that is clear.

    A tree is all that hangs from one body of the world, and is called by that body's number. Of the trees that move,
    the robot is the one with a joint that an actuator drives; if there is none, the one with a limited joint; if there
    is none, the only one with a joint that is not free. All that moves is one robot where none of this applies.
    ``root`` names bodies or sites whose trees are the robot; None: the model's custom text ``robot_roots``, or the
    rule.
    """
    moving = np.setdiff1d(np.arange(model.njnt), list(locked)).astype(int)
    trees = _trees(model, moving)
    asked = _asked(model, root)
    if asked:
        return (tuple(dict.fromkeys(_tree_of(model, names, name, trees) for name in asked)),)
    kinds, limited = model.jnt_type[moving], model.jnt_limited[moving].astype(bool)
    for chosen in (_driven_trees(model) & trees, _trees(model, moving[limited])):
        if chosen:
            return tuple((tree,) for tree in sorted(chosen))
    jointed = _trees(model, moving[np.isin(kinds, _SINGLE)])
    return (tuple(sorted(jointed if len(jointed) == 1 else trees)),)


def _trees(model: mujoco.MjModel, joints: np.ndarray) -> set[int]:
    return set(model.body_rootid[model.jnt_bodyid[joints]].tolist())


def _asked(model: mujoco.MjModel, root: str | Sequence[str] | None) -> list[str]:
    if root is not None:
        asked = [root] if isinstance(root, str) else list(root)
        if not asked or not all(isinstance(name, str) for name in asked):
            raise OsikTypeError(f"root is {root!r}; it is the name of a body of the robot, or several")
        return asked
    text = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, ROBOT_ROOTS)
    if text < 0:
        return []
    start = model.text_adr[text]
    return bytes(model.text_data[start : start + model.text_size[text]]).rstrip(b"\0").decode().split()


def _tree_of(model: mujoco.MjModel, names: Sequence[str], name: str, trees: set[int]) -> int:
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    shown = tuple(names[tree] for tree in sorted(trees))
    if name not in names and site < 0:
        raise unknown_name("robot root", name, shown)
    tree = int(model.body_rootid[names.index(name) if name in names else model.site_bodyid[site]])
    if tree not in trees:
        raise OsikValueError(f"root names {name!r}, and nothing moves in its tree; trees that move: {', '.join(shown)}")
    return tree


def _driven_trees(model: mujoco.MjModel) -> set[int]:
    """Return the trees that an actuator moves, by a joint, a tendon, a site or a body."""
    out: set[int] = set()
    for kind, (first, _) in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
        out |= set(model.body_rootid[_driven_bodies(model, mujoco.mjtTrn(int(kind)), int(first))].tolist())
    return out


def _driven_bodies(model: mujoco.MjModel, kind: mujoco.mjtTrn, number: int) -> list[int]:
    trn = mujoco.mjtTrn
    if kind in (trn.mjTRN_JOINT, trn.mjTRN_JOINTINPARENT):
        return [int(model.jnt_bodyid[number])]
    if kind in (trn.mjTRN_SITE, trn.mjTRN_SLIDERCRANK):
        return [int(model.site_bodyid[number])]
    if kind == trn.mjTRN_BODY:
        return [number]
    if kind == trn.mjTRN_TENDON:
        return _tendon_bodies(model, number)
    return []


def _tendon_bodies(model: mujoco.MjModel, tendon: int) -> list[int]:
    """Return the bodies of the joints and sites that a tendon runs over."""
    start, count = model.tendon_adr[tendon], model.tendon_num[tendon]
    wraps = range(start, start + count)
    joints = [model.wrap_objid[w] for w in wraps if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT]
    sites = [model.wrap_objid[w] for w in wraps if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_SITE]
    return [*(int(model.jnt_bodyid[j]) for j in joints), *(int(model.site_bodyid[s]) for s in sites)]
