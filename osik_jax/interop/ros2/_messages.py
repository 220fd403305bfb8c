"""Classes of the ROS 2 messages in use, made from their definitions.

ROS 2 serialises a message as plain CDR (XCDR1, final types) under the type name ``package::msg::dds_::Name_``.
"""

from __future__ import annotations

import types
from dataclasses import dataclass, field
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from cyclonedds.idl.annotations import final

_DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec, uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "std_msgs/MultiArrayDimension": "string label, uint32 size, uint32 stride",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim, uint32 data_offset",
    "std_msgs/Float64MultiArray": "std_msgs/MultiArrayLayout layout, float64[] data",
    "sensor_msgs/JointState": (
        "std_msgs/Header header, string[] name, float64[] position, float64[] velocity, float64[] effort"
    ),
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header, geometry_msgs/Pose pose",
    "trajectory_msgs/JointTrajectoryPoint": (
        "float64[] positions, float64[] velocities, float64[] accelerations, float64[] effort, "
        "builtin_interfaces/Duration time_from_start"
    ),
    "trajectory_msgs/JointTrajectory": (
        "std_msgs/Header header, string[] joint_names, trajectory_msgs/JointTrajectoryPoint[] points"
    ),
    "diagnostic_msgs/KeyValue": "string key, string value",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte level, string name, string message, string hardware_id, diagnostic_msgs/KeyValue[] values"
    ),
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header, diagnostic_msgs/DiagnosticStatus[] status",
}
"""Fields of each type, in their order; types of fields come before those that have them. Constants are left out."""
_PLAIN: dict[str, tuple[Any, Any]] = {
    "bool": (bool, bool),
    "byte": (idl.byte, int),
    "int32": (idl.int32, int),
    "uint32": (idl.uint32, int),
    "float64": (idl.float64, float),
    "string": (str, str),
}
"""Type of DDS and maker of the default."""
_TYPES: dict[str, Any] = {}


def _made(name: str) -> Any:
    """Return the class of a message type: a dataclass with zeros, empty text and empty lists as defaults."""
    package, _, short = name.partition("/")
    namespace: dict[str, Any] = {"__doc__": f"{name} of ROS 2.", "__annotations__": {}, "__module__": __name__}
    for text, own in (part.split() for part in _DEFINITIONS[name].split(", ")):
        kind, empty = _PLAIN.get(text.removesuffix("[]")) or (_TYPES[text.removesuffix("[]")],) * 2
        listed = text.endswith("[]")
        namespace["__annotations__"][own] = idl.sequence[kind] if listed else kind
        namespace[own] = field(default_factory=list if listed else empty)
    options = {"typename": f"{package}::msg::dds_::{short}_"}
    return dataclass(final(types.new_class(short, (IdlStruct,), options, lambda body: body.update(namespace))))


for _name in _DEFINITIONS:
    _TYPES[_name] = _made(_name)


def __getattr__(name: str) -> Any:
    """Return the class of a message type by its name without the package, such as ``JointState``."""
    for full, kind in _TYPES.items():
        if full.rpartition("/")[2] == name:
            return kind
    raise AttributeError(name)
