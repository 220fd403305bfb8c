"""MJCF to the fields of a Robot. Interim: embedded robots and from_mjcf."""
from ._mjmodel import from_mjmodel
def from_mjcf(mjcf, *, floating_base=None, velocity_limits=None, locked_joints=()):
    import mujoco
    s=str(mjcf); m = mujoco.MjModel.from_xml_string(s) if s.lstrip().startswith('<') else mujoco.MjModel.from_xml_path(s)
    return from_mjmodel(m, velocity_limits=velocity_limits, locked_joints=locked_joints)
def embedded(name):
    raise KeyError(name)
