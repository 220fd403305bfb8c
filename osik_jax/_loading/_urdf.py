"""Interim."""
from ._mjmodel import from_mjmodel
def from_urdf(urdf, *, floating_base=None, locked_joints=()):
    import mujoco
    spec=mujoco.MjSpec.from_file(str(urdf))
    if floating_base: spec.worldbody.first_body().add_freejoint(name='floating_base')
    return from_mjmodel(spec.compile(), locked_joints=locked_joints)
