"""Training episodes that end at a fall: MS-AntRun-v1, but an ant that lies on its back has failed.

    bash examples/recipes.sh ant_walk_cpu --exp_name walk
    bash examples/recipes.sh ant_run_cpu --checkpoint runs/walk/last.pt

An ant that falls hardly ever gets up again, and an episode of the task has 1,000 steps. Here, the next episode starts
at once, so training sees more starts, when most ants fall. `--bootstrap_at_done truncated` says that no reward follows
a fall. Observations and reward are those of the task. So are evaluations, whose episodes go on after a fall.
"""

import torch
from mani_skill.envs.tasks.control.ant import AntRun
from mani_skill.utils.geometry.rotation_conversions import quaternion_to_matrix
from mani_skill.utils.registration import register_env


@register_env("AntRunUpright-v1", max_episode_steps=1000)
class AntRunUprightEnv(AntRun):
    def evaluate(self):
        upwards = quaternion_to_matrix(self.agent.robot.links_map["torso"].pose.q)[:, 2, 2]
        return super().evaluate() | dict(fail=upwards < 0)

    def _initialize_episode(self, env_idx, options):
        """The task's own draws. Its own method cannot start some of several environments (mani-skill 3.0.1), because it
        moves the cameras of all. Here, they follow with the first step.
        """
        stand, robot = self.agent.keyframes["stand"], self.agent.robot
        robot.set_root_pose(stand.pose)
        noise = torch.rand(2, len(env_idx), robot.dof[0], device=self.device) * 0.02 - 0.01
        robot.set_qpos(torch.tensor(stand.qpos, dtype=torch.float32, device=self.device) + noise[0])
        robot.set_qvel(noise[1])
