"""Poses of bodies and axes of dofs, as ``kinematics/_forward.py`` defines them, for kernels of plans.

It goes through the bodies from the root, so that each finds its parent done. What a joint does in its body's parent is
MJX's ``kinematics``, for quaternions of any length too.
"""

from __future__ import annotations

import numpy as np

from ._frame import lean
from ._rigid import (
    carried,
    composed,
    minus,
    multiplied,
    normalized,
    plus,
    put,
    put_turning,
    rotation_of,
    triple,
    turning,
)
from ._rigid import turned as rotated

FREE, BALL, SLIDE = 0, 1, 2  # MuJoCo's; a hinge is what is left


@lean
def place_bodies(parents, kinds, owners, value, reference, at, along, joint_at, joint_along, P, R, lin, ang, anchors):
    """Write poses of all bodies to P and R, axes of hinges and slides and all anchors to the arrays over dofs.

    Args:
        parents: of each body. (nbody,)
        kinds: of each joint. (njoint,)
        owners: body of each joint; those of a body follow each other. (njoint,)
        value: MuJoCo's configuration. (nqfull,)
        reference: at which bodies sit as described. (nqfull,)
        at: of each body in its parent. (nbody, 3)
        along: of each body in its parent, a quaternion. (nbody, 4)
        joint_at: anchor of each joint in its body. (njoint, 3)
        joint_along: axis of each joint in its body. (njoint, 3)
        P: (nbody, 3)
        R: (nbody, 9)
        lin: (nvfull, 3)
        ang: (nvfull, 3)
        anchors: (nvfull, 3)
    """
    nothing = 0.0, 0.0, 0.0
    put(P, 0, nothing)
    put_turning(R, 0, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    joint, entry, dof = 0, 0, 0  # of the next joint: its first entry in the configuration, its first dof
    for body in range(1, len(parents)):
        there, frame = triple(P, parents[body]), turning(R, parents[body])
        pos, quat = triple(at, body), (along[body, 0], along[body, 1], along[body, 2], along[body, 3])
        while joint < len(owners) and owners[joint] == body:
            kind, fixed = kinds[joint], triple(joint_at, joint)
            if kind == FREE:
                pos = value[entry], value[entry + 1], value[entry + 2]
                quat = normalized((value[entry + 3], value[entry + 4], value[entry + 5], value[entry + 6]))
                for k in range(6):
                    put(lin, dof + k, nothing)
                    put(ang, dof + k, nothing)
                    put(anchors, dof + k, plus(there, rotated(frame, pos)))
                for k in range(3):
                    lin[dof + k, k] = 1.0
                joint, entry, dof = joint + 1, entry + 7, dof + 6
                continue
            anchor = plus(carried(quat, fixed), pos)
            seen, axis = plus(there, rotated(frame, anchor)), carried(quat, triple(joint_along, joint))
            if kind == BALL:
                own = normalized((value[entry], value[entry + 1], value[entry + 2], value[entry + 3]))
                quat = multiplied(quat, own)
                pos = minus(anchor, carried(quat, fixed))
                for k in range(3):
                    put(lin, dof + k, nothing)
                    put(anchors, dof + k, seen)
                joint, entry, dof = joint + 1, entry + 4, dof + 3
                continue
            displacement = value[entry] - reference[entry]
            put(anchors, dof, seen)
            if kind == SLIDE:
                pos = plus(pos, (displacement * axis[0], displacement * axis[1], displacement * axis[2]))
                put(lin, dof, rotated(frame, axis))
                put(ang, dof, nothing)
            else:
                sine, cosine = np.sin(0.5 * displacement), np.cos(0.5 * displacement)
                x, y, z = triple(joint_along, joint)
                quat = multiplied(quat, (cosine, sine * x, sine * y, sine * z))
                pos = minus(anchor, carried(quat, fixed))
                put(lin, dof, nothing)
                put(ang, dof, rotated(frame, axis))
            joint, entry, dof = joint + 1, entry + 1, dof + 1
        put(P, body, plus(there, rotated(frame, pos)))
        put_turning(R, body, composed(frame, rotation_of(quat)))


@lean
def turn_with_bodies(kinds, owners, R, ang):
    """Write the axes of ball and free joints, which are those of the body."""
    dof = 0
    for joint in range(len(kinds)):
        kind = kinds[joint]
        dof += 3 if kind == FREE else 0
        if kind in (FREE, BALL):
            for k in range(3):
                for i in range(3):
                    ang[dof + k, i] = R[owners[joint], 3 * i + k]
            dof += 3
        else:
            dof += 1
