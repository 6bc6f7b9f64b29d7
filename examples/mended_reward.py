"""Another reward for a task of ManiSkill: a subclass that overrides `compute_dense_reward`.

    FLAGS="--desired_kl 0.1 --logstd_lr_factor 3 --total_timesteps 800000"
    python ppo.py --env_id examples.mended_reward:PullCubeToolMended-v1 --exp_name pull $FLAGS
    python ppo.py --env_id PullCubeTool-v1 --checkpoint runs/pull/last.pt --gamma 0.97 $FLAGS

Seed 1, stopped after 492,000 steps of the first and 307,000 of the second, succeeded in 0.93 of 256 other episodes.

In PullCubeTool-v1, a robot pulls a cube to itself, with an L-shaped tool. The task's own reward pays for a place of the
tool near the cube. There, the hook is 6 cm behind the cube, if the tool points ahead, and the tool may point anywhere.
So policies learn to hold the tool at this place, and rarely to pull. The reward below pays for the place of the hook.

Scene, observations and success are those of the task, so a policy that was trained here can go on there.
"""

import sapien
import torch
from mani_skill.envs.tasks.tabletop.pull_cube_tool import PullCubeToolEnv
from mani_skill.utils.registration import register_env


@register_env("PullCubeToolMended-v1", max_episode_steps=100)
class PullCubeToolMendedEnv(PullCubeToolEnv):
    def compute_dense_reward(self, obs, action, info):
        """Returns (num_envs,): at most 2 for reaching the tool. While the robot holds it: 2 for that, at most 2 for a
        hook behind the cube, and 3 for a cube that is pulled with it. Success adds 5. ManiSkill divides the sum by 5.
        """
        tool, cube = self.l_shape_tool.pose, self.cube.pose.p
        handle = (tool * sapien.Pose([0.02, 0, 0])).p
        reach = torch.linalg.norm(self.agent.tcp.pose.p - handle, dim=1)

        # the middle of the hook's inner side, and the cube's side away from the robot
        hook = (tool * sapien.Pose([self.handle_length - self.hook_length, 0.0625, 0])).p
        behind = cube + torch.tensor([self.cube_half_size, 0, 0], device=self.device)
        hooked = 1 - torch.tanh(5 * torch.linalg.norm(hook - behind, dim=1))

        base = self.agent.robot.get_links()[0].pose.p
        too_far = torch.linalg.norm((cube - base)[:, :2], dim=1) - 0.6  # metres from success
        pulled = 1 - torch.tanh(5 * too_far.clamp(min=0))

        is_grasping = self.agent.is_grasping(self.l_shape_tool, max_angle=20)
        reward = 2 * (1 - torch.tanh(5 * reach)) + is_grasping * (2 + 2 * hooked + 3 * hooked * pulled)
        reward[info["success"]] += 5
        return reward
