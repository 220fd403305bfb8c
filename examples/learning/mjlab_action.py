"""An action term of mjlab: a policy moves the hand of arm7, and the joints stay within their limits.

pip install mjlab   # Python 3.11 to 3.13, PyTorch; run here with mjlab 1.6.0 on a CPU
python examples/learning/mjlab_action.py
"""

from dataclasses import dataclass
from importlib.resources import files

import jax
import mujoco
import torch
from mjlab.actuator.xml_actuator import XmlActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.envs.mdp import joint_pos_rel, time_out
from mjlab.managers.action_manager import ActionTerm, ActionTermCfg
from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg

import osik_jax as osik
from osik_jax.interop.action import TaskSpaceAction
from osik_jax.interop.torch import wrap

osik.runtime.configure_cpu()
arm = osik.load_robot("arm7")
DT = 0.02
tasks = {"hand": osik.FrameTask(arm, "hand", rows="position", gain=1.0 / DT), "posture": osik.PostureTask(arm)}


class OsikAction(ActionTerm):
    """Joint targets of a TaskSpaceAction in all environments, each from the targets before."""

    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.action, self._step = cfg.action, wrap(jax.vmap(cfg.action))
        self._joints = [self._entity.joint_names.index(name) for name in cfg.action.joints]
        self._raw = torch.zeros(self.num_envs, cfg.action.size, device=self.device)
        self._q = torch.zeros(self.num_envs, len(self._joints), device=self.device)

    action_dim = property(lambda self: self.action.size)
    raw_action = property(lambda self: self._raw)

    def process_actions(self, actions):  # once for each action of the policy
        self._raw[:] = actions
        self._q = self._step(self._q, self._raw).q

    def apply_actions(self):  # in each step of the physics
        self._entity.set_joint_position_target(self._q, joint_ids=self._joints)

    def reset(self, env_ids=None):
        chosen = slice(None) if env_ids is None else env_ids
        self._raw[chosen] = 0.0
        self._q[chosen] = self._entity.data.joint_pos[chosen][:, self._joints]


@dataclass(kw_only=True)
class OsikActionCfg(ActionTermCfg):
    """Configuration of the term: the action space."""

    action: TaskSpaceAction

    def build(self, env):
        return OsikAction(self, env)


def environment(envs):
    home = dict(zip(arm.joint_names, arm.q0.tolist(), strict=True))
    entity = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_file(str(files(osik) / "robot/models/arm7.xml")),  # with its servos
        articulation=EntityArticulationInfoCfg(actuators=(XmlActuatorCfg(target_names_expr=(".*",)),)),
        init_state=EntityCfg.InitialStateCfg(joint_pos=home),
    )
    return ManagerBasedRlEnv(
        ManagerBasedRlEnvCfg(
            scene=SceneCfg(entities={"robot": entity}, num_envs=envs),
            observations={"actor": ObservationGroupCfg({"q": ObservationTermCfg(func=joint_pos_rel)})},
            actions={"hand": OsikActionCfg(entity_name="robot", action=TaskSpaceAction(arm, tasks, dt=DT))},
            terminations={"time_out": TerminationTermCfg(func=time_out, time_out=True)},
            sim=SimulationCfg(mujoco=MujocoCfg(timestep=0.005, disableflags=("contact",))),
            decimation=4,
            episode_length_s=10.0,
        ),
        device="cuda:0" if torch.cuda.is_available() else "cpu",
    )


if __name__ == "__main__":
    env = environment(8)
    env.reset()
    for _ in range(25):  # at most 5 cm a step along x
        env.step(torch.tensor([[1.0, 0.0, 0.0]], device=env.device).repeat(8, 1))
    q = jax.numpy.asarray(env.scene["robot"].data.joint_pos[0].cpu().numpy())
    moved = osik.forward_kinematics(arm, q).frame_pose(arm, "hand")[0] - tasks["hand"].target[0]
    print("the hand moved by", moved.round(3).tolist(), "m in 0.5 s")
