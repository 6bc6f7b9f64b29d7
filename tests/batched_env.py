"""A small torch-native batched environment with the interface of a GPU-simulated ManiSkill task."""

import gymnasium as gym
import numpy as np
import torch

from ppo import ManiSkillVectorEnv  # ppo before mani_skill, which it prepares for machines without Vulkan


class BatchedReach(gym.Env):
    """Move a point to a goal in the plane: observation (position, goal), action the velocity, reward in [0, 1].

    Success within 0.1 of the goal, failure outside the square [-2, 2]^2, time limit after 20 steps."""

    reconfiguration_freq = 0
    max_episode_steps = 20

    def __init__(self, num_envs, device):
        self.num_envs, self.device, self.metadata = num_envs, torch.device(device), {}
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.single_action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        self.state = torch.zeros(num_envs, 4, device=self.device)
        self.elapsed_steps = torch.zeros(num_envs, dtype=torch.int32, device=self.device)

    def info(self):
        distance = (self.state[:, :2] - self.state[:, 2:]).norm(dim=1)
        success, fail = distance < 0.1, self.state[:, :2].abs().amax(1) > 2
        return dict(success=success, fail=fail, elapsed_steps=self.elapsed_steps), distance

    def reset(self, *, seed=None, options=None):
        env_idx = (options or {}).get("env_idx", torch.arange(self.num_envs, device=self.device))
        if seed is None:
            fresh = torch.rand(len(env_idx), 4, device=self.device)
        else:
            draws = [torch.rand(4, generator=torch.Generator().manual_seed(s)) for s in seed]
            fresh = torch.stack(draws).to(self.device)
        self.state[env_idx] = 2 * fresh - 1
        self.elapsed_steps[env_idx] = 0
        return self.state.clone(), self.info()[0]

    def step(self, actions):
        assert (actions.abs() <= 1).all(), "actions come clipped to the action space"
        self.state[:, :2] += 0.3 * actions
        self.elapsed_steps += 1
        info, distance = self.info()
        truncated = self.elapsed_steps >= self.max_episode_steps
        return self.state.clone(), 1 - torch.tanh(distance), info["success"] | info["fail"], truncated, info


def make_envs(args, record_dir, evaluation=False, device="cpu"):
    """Stands in for ppo.make_envs."""
    env = BatchedReach(args.num_eval_envs if evaluation else args.num_envs, device)
    ignore_terminations = not (args.eval_partial_reset if evaluation else args.partial_reset)
    return ManiSkillVectorEnv(
        env, auto_reset=not evaluation, ignore_terminations=ignore_terminations, record_metrics=True
    )
