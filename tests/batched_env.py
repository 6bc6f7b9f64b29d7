"""Small torch-native batched environments with the interface of a GPU-simulated ManiSkill task."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector.utils import batch_space

import ppo_rgb
from ppo import ManiSkillVectorEnv


class BatchedReach(gym.Env):
    """Move a point to a goal in the plane: observation (position, goal), action the velocity, reward in [0, 1].

    Success within 0.1 of the goal, failure outside the square [-2, 2]^2, time limit after 20 steps."""

    reconfiguration_freq = 0
    max_episode_steps = 20
    scene = SimpleNamespace(gpu_sim_enabled=False)

    def __init__(self, num_envs, device):
        self.num_envs, self.device, self.metadata = num_envs, torch.device(device), {}
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.single_action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.state = torch.zeros(num_envs, 4, device=self.device)
        self.elapsed_steps = torch.zeros(num_envs, dtype=torch.int32, device=self.device)

    def info(self):
        distance = (self.state[:, :2] - self.state[:, 2:]).norm(dim=1)
        success, fail = distance < 0.1, self.state[:, :2].abs().amax(1) > 2
        return dict(success=success, fail=fail, elapsed_steps=self.elapsed_steps), distance

    def observe(self):
        return self.state.clone()

    def reset(self, *, seed=None, options=None):
        env_idx = (options or {}).get("env_idx", torch.arange(self.num_envs)).to(self.device)
        if seed is None:
            fresh = torch.rand(len(env_idx), 4, device=self.device)
        else:  # one seed for each environment, even if only some of them reset
            draws = [torch.rand(4, generator=torch.Generator().manual_seed(s)) for s in seed]
            fresh = torch.stack(draws).to(self.device)[env_idx]
        self.state[env_idx] = 2 * fresh - 1
        self.elapsed_steps[env_idx] = 0
        return self.observe(), self.info()[0]

    def _set_main_rng(self, seeds):  # ManiSkill's tasks have two random generators; this one has none
        pass

    def _set_episode_rng(self, seeds, env_idx):
        pass

    def step(self, actions):
        assert (actions.abs() <= 1).all(), "actions must be clipped to the action space"
        self.state[:, :2] += 0.3 * actions
        self.elapsed_steps += 1
        info, distance = self.info()
        truncated = self.elapsed_steps >= self.max_episode_steps
        return self.observe(), 1 - torch.tanh(distance), info["success"] | info["fail"], truncated, info


class BatchedReachImages(BatchedReach):
    """BatchedReach seen by two cameras, with observations in ManiSkill's raw form. Only the images show the goal."""

    size = 36

    def __init__(self, num_envs, device):
        super().__init__(num_envs, device)
        on_cpu = lambda tree: {k: on_cpu(v) for k, v in tree.items()} if isinstance(tree, dict) else tree.cpu()
        self.update_obs_space(on_cpu(self.observe()))  # ManiSkill keeps its first observation too

    def update_obs_space(self, obs):
        self._init_raw_obs = obs
        if "sensor_data" not in obs:
            spaces = {
                k: gym.spaces.Box(-np.inf, np.inf, v.shape[1:], np.float32)
                if v.is_floating_point()
                else gym.spaces.Box(0, torch.iinfo(v.dtype).max, v.shape[1:], str(v.dtype).removeprefix("torch."))
                for k, v in obs.items()
            }
            self.single_observation_space = gym.spaces.Dict(spaces)
            self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def observe(self):
        pixels = torch.linspace(-2, 2, self.size, device=self.device)
        disc = lambda xy: (
            ((pixels[None, :, None] - xy[:, 1, None, None]) ** 2 + (pixels[None, None] - xy[:, 0, None, None]) ** 2)
            < 0.05
        )
        position, goal = disc(self.state[:, :2]), disc(self.state[:, 2:])
        ids = (position + 2 * goal.short())[..., None].short()
        rgb = torch.stack([position, goal, torch.zeros_like(goal)], dim=-1).to(torch.uint8) * 255
        depth = 2000 - 100 * ids
        front = dict(rgb=rgb, depth=depth, segmentation=ids)
        back = {k: v.flip(2) for k, v in front.items()}
        agent = dict(position=self.state[:, :2].clone())
        return dict(agent=agent, extra={}, sensor_param={}, sensor_data=dict(front=front, back=back))


def make_envs(args, num_envs, seed, evaluation=False, record=None, device="cpu"):
    """Stands in for make_envs of both scripts."""
    if args.obs_mode == "state":
        env = BatchedReach(num_envs, device)
    else:
        env = ppo_rgb.ImageObservations(BatchedReachImages(num_envs, device), args)
    ignore_terminations = not (args.eval_partial_reset if evaluation else args.partial_reset)
    return ManiSkillVectorEnv(
        env, auto_reset=not evaluation, ignore_terminations=ignore_terminations, record_metrics=True
    )
