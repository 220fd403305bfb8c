"""An arm of six joints with the lengths of a UR5, for tests that need a robot of their own."""

from model_files import mjcf

SIX_JOINTS = mjcf("six_joints")
