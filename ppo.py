# /// script
# requires-python = ">=3.10,<3.13"
# dependencies = [
#     "mani-skill>=3.0.1,<3.1",
#     "sapien>=3.0.3,<3.1",
#     "torch>=2.6,<3",
#     "gymnasium>=1.0,<2",
#     "tensorboard>=2.16,<3",
#     "tyro>=0.9,<2",
#     "matplotlib>=3.8,<4",
#     "psutil>=5.9,<8",
#     "imageio[ffmpeg]>=2.34,<3",
#     "filelock>=3.12,<4",
# ]
# ///
"""PPO for ManiSkill from state observations, in one file.

Train     python ppo.py --env_id PushCube-v1
On N GPUs torchrun --nproc_per_node=N ppo.py --env_id PushCube-v1
Resume    python ppo.py --resume runs/NAME
Evaluate  python ppo.py --evaluate --checkpoint runs/NAME/best.pt
Watch     runs/NAME/videos/*.mp4, runs/NAME/learning_curve.png, tensorboard --logdir runs

The same command runs on a GPU, on a CPU and without a renderer. `uv run ppo.py` installs what it needs.
To make it yours: the flags are `Args` (--help lists them), the network is `Agent`, the algorithm is `train`.
"""

import contextlib
import copy
import difflib
import gc
import importlib
import importlib.metadata
import importlib.util
import inspect
import io
import json
import math
import os
import pickle
import platform
import random
import re
import shlex
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from functools import partial, partialmethod
from pathlib import Path
from types import SimpleNamespace
from typing import Literal, NoReturn, Optional

warnings.filterwarnings("ignore", message="Failed to find system libvulkan|CUDA reports that|.*Box .*precision")

import filelock
import gymnasium as gym
import imageio
import numpy as np
import psutil
import sapien
import sapien.wrapper.urdf_loader
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
import torch.nn as nn
import tyro
from sapien import physx
from torch.distributions import Normal
from torch.utils._pytree import tree_leaves, tree_map
from tqdm import tqdm


def find_render_device() -> Optional[sapien.Device]:
    """Returns a CUDA GPU, any other Vulkan device (software included), or None where SAPIEN can render with neither."""
    for name in ("cuda", "pci:0", "cpu"):
        with contextlib.suppress(RuntimeError):
            if sapien.Device(name).can_render():
                return sapien.Device(name)
    return None


RENDER_DEVICE = find_render_device()
if RENDER_DEVICE is None:
    # Tasks create render materials even if nothing is rendered, and SAPIEN creates none without a Vulkan device.
    # Training from states needs no picture: these stand-ins accept every call, so that the tasks can be built.
    class InertRenderObject:
        __init__ = lambda self, *args, **kwargs: None
        __getattr__ = lambda self, name: lambda *args, **kwargs: None

    for module in [*sys.modules.values()]:  # of SAPIEN, and of ManiSkill if it was imported earlier
        for name in ("RenderMaterial", "RenderTexture2D"):
            if name in getattr(module, "__dict__", {}):
                setattr(module, name, InertRenderObject)

import mani_skill.envs  # registers the tasks
import mani_skill.envs.sapien_env as sapien_env
from mani_skill.agents.controllers.pd_ee_pose import PDEEPosController
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils import common, download_asset
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.gym_utils import find_max_episode_steps_value
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs import Link
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct
from mani_skill.utils.visualization.misc import tile_images
from mani_skill.utils.wrappers import flatten
from mani_skill.utils.wrappers.record import RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

gc.freeze()  # ManiSkill collects garbage whenever it builds scenes: exempt what the imports created

RANK, LOCAL_RANK = int(os.environ.get("RANK", 0)), int(os.environ.get("LOCAL_RANK", 0))  # set by torchrun
WORLD_SIZE, LOCAL_WORLD_SIZE = (int(os.environ.get(k, 1)) for k in ("WORLD_SIZE", "LOCAL_WORLD_SIZE"))
STOP_SIGNALS = {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGUSR1", signal.SIGTERM)}  # SLURM may send USR1
# how the file names of installed packages begin
PACKAGES = ("<frozen", *(str(Path(x).parent) for x in (os.__file__, Path(gym.__file__).parent, mani_skill.__file__)))
SCRIPT = Path(__file__)


# ----- Flags ----------------------------------------------------------------------------------------------------------
@dataclass
class Args:
    # --- Experiment ---
    exp_name: Optional[str] = None
    """name of the run; its files go to runs/<exp_name> (None: <env_id>__<script>__<seed>__<time>)"""
    seed: int = 1
    """seed of the weights, the actions and the training episodes"""
    torch_deterministic: bool = True
    """let cuDNN use deterministic algorithms only"""
    cuda: bool = True
    """use a CUDA GPU if there is one; --no-cuda keeps simulation and learning on the CPU"""
    track: bool = False
    """log to Weights & Biases as well (pip install wandb)"""
    wandb_project_name: str = "ManiSkill"
    """Weights & Biases project"""
    wandb_entity: Optional[str] = None
    """Weights & Biases entity (team)"""
    wandb_group: str = "PPO"
    """Weights & Biases group"""
    # --- Environment ---
    env_id: str = "PushCube-v1"
    """the task: any registered ManiSkill task, or module:EnvId for your own"""
    obs_mode: str = "state"
    """what the policy sees: this script supports state only, ppo_rgb.py supports images"""
    control_mode: Optional[str] = "pd_joint_delta_pos"
    """controller of the robot (None: the task's default, or else the robot's)"""
    robot_uids: Optional[str] = None
    """robot (None: the task's default)"""
    reward_mode: Optional[Literal["normalized_dense", "dense", "sparse", "none"]] = None
    """reward to learn from (None: the first of these that the task has)"""
    sim_backend: str = "auto"
    """physx_cuda (all environments on one GPU; physx_cuda:1 is the second GPU), physx_cpu, or auto"""
    render_backend: str = "gpu"
    """device that renders videos: gpu (gpu:1 is the second one) or none; without CUDA, any Vulkan device renders"""
    num_envs: int = 512
    """number of parallel training environments"""
    num_eval_envs: int = 64
    """number of parallel evaluation environments"""
    num_actors: Optional[int] = None
    """number of processes that simulate on a CPU, each its part of the environments (None: one a core)"""
    partial_reset: bool = True
    """end a training episode after success or at failure; --no-partial_reset: only at the time limit"""
    success_steps: float = 10.0
    """steps of success before a training episode ends, on average, so that the policy learns to stay (1: the first)"""
    staggered_resets: bool = True
    """cut the first training episodes short at random: then even a short rollout sees all parts of an episode"""
    eval_partial_reset: bool = False
    """end an evaluation episode at success or failure"""
    reconfiguration_freq: Optional[int] = None
    """rebuild the training scenes every so many resets; needs --no-partial_reset (None: the task's default, or on a CPU
    after ten episodes if the task varies its objects)"""
    eval_reconfiguration_freq: Optional[int] = None
    """rebuild the evaluation scenes every so many resets (None: 1 if the task varies its objects, else never)"""
    render_mode: Literal["rgb_array", "sensors", "all"] = "rgb_array"
    """what videos show: rgb_array (the scene), sensors (the task's cameras) or all"""
    shader: Literal["minimal", "default", "rt-fast", "rt-med", "rt"] = "default"
    """shader pack of videos; ray tracing (rt) needs CPU simulation"""
    env_kwargs: str = "{}"
    """further arguments of gym.make as JSON, such as '{"enhanced_determinism": true}'"""
    # --- PPO ---
    total_timesteps: Optional[int] = None
    """total number of environment steps (None: as many as PushCube-v1 needs; other tasks need more)"""
    learning_rate: float = 1e-3
    """Adam's learning rate"""
    critic_learning_rate: Optional[float] = None
    """learning rate of the agent's `critic` (None: learning_rate)"""
    logstd_lr_factor: float = 3.0
    """learning rate of the policy's standard deviation, in multiples of learning_rate"""
    num_steps: Optional[int] = None
    """steps in each environment per iteration (None: fewer if there are more environments, at least 5)"""
    anneal_lr: bool = True
    """lower the learning rate linearly to zero over the run (with desired_kl: that of the critic only)"""
    gamma: float = 0.9
    """discount factor"""
    gae_lambda: float = 0.8
    """lambda of generalised advantage estimation"""
    num_minibatches: int = 4
    """minibatches per epoch; if they do not divide the batch, each epoch leaves out a random remainder"""
    update_epochs: int = 8
    """passes over the batch per iteration"""
    norm_adv: bool = True
    """normalise the advantages of each minibatch"""
    clip_coef: float = 0.2
    """clipping range of the probability ratio"""
    clip_vloss: bool = False
    """clip the change of the value by clip_coef, too"""
    ent_coef: float = 0.0
    """weight of the entropy bonus"""
    vf_coef: float = 0.5
    """weight of the value loss"""
    max_grad_norm: float = 0.5
    """largest norm of the gradient"""
    target_kl: Optional[float] = None
    """stop the update after an epoch whose last minibatch has a larger KL divergence (None: never)"""
    desired_kl: Optional[float] = 0.1
    """adapt the policy's learning rate after each minibatch to keep the KL divergence near this (None: do not)"""
    reward_scale: float = 1.0
    """factor on the rewards that PPO learns from; logged returns are without it"""
    bootstrap_at_done: Literal["always", "truncated", "never"] = "always"
    """when to bootstrap from the last observation of an episode: at every end, only at time limits, or never"""
    finite_horizon_gae: bool = False
    """average the n-step returns that exist, instead of the infinite sum"""
    norm_obs: bool = True
    """normalise observations by their running mean and variance"""
    layer_norm: bool = False
    """normalise the hidden layers of policy and value (Ba et al. 2016, arXiv 1607.06450)"""
    logstd_init: float = -0.5
    """initial logarithm of the policy's standard deviation (in ManiSkill's ppo.py -0.5, in its ppo_fast.py 0)"""
    logstd_final: Optional[float] = None
    """upper limit of that logarithm, which falls from logstd_init over the second half of the run (None: no limit)"""
    compile: bool = False
    """compile the network with torch.compile: the run starts later, by up to a minute"""
    cudagraphs: bool = True
    """on a GPU, launch a step of the policy, values, and an epoch of the update as one CUDA graph each"""
    # --- Evaluation, checkpoints, videos ---
    eval_freq: int = 25
    """evaluate every so many iterations, and always before the first and after the last (0: only then)"""
    num_eval_episodes: int = 64
    """number of episodes of an evaluation"""
    num_eval_steps: Optional[int] = None
    """instead of num_eval_episodes: steps in each evaluation environment; as many episodes as fit, at least one"""
    eval_seed: int = 0
    """evaluation episode k starts from seed eval_seed + k, below 2^31; training uses seeds above"""
    stop_at_success: Optional[float] = None
    """end the run when an evaluation, other than the first one, has this success_once"""
    evaluate: bool = False
    """only evaluate --checkpoint, with the task and the network of its run"""
    checkpoint: Optional[str] = None
    """checkpoint to evaluate, or to start training from (with its weights, Adam's moments and learning rates)"""
    save_model: bool = True
    """write best.pt (the best evaluation so far) and last.pt"""
    save_freq: Optional[int] = None
    """keep a numbered checkpoint every so many iterations, too"""
    checkpoint_freq: int = 10
    """write last.pt every so many iterations"""
    resume: Optional[str] = None
    """run folder, or a checkpoint in one, to continue in place; flags that you give replace those of the run"""
    exact_resume: bool = False
    """let a resumed run repeat every bit (CPU simulation only): build new scenes every checkpoint_freq iterations"""
    capture_video: bool = True
    """film the first episodes of each evaluation, if there is a renderer"""
    save_train_video_freq: Optional[int] = None
    """film the policy as it explores, every so many iterations"""
    save_trajectory: bool = False
    """write evaluation episodes as ManiSkill trajectories next to the videos, one file an actor (of torchrun's first
    process)"""

    @property
    def batch_size(self) -> int:
        return self.num_envs * self.num_steps

    @property
    def num_iterations(self) -> int:
        return self.total_timesteps // self.batch_size


# On a CPU, an iteration has fewer steps: too few to change the policy as much. Then its noise has to fall faster.
CPU_DEFAULTS = dict(desired_kl=0.05, logstd_lr_factor=20.0, eval_freq=10)
GPU_BATCH_SIZE = 4096  # steps of an iteration, unless num_steps is given
CPU_BATCH_SIZE = 1600
NUM_ITERATIONS = 75  # unless total_timesteps is given
MIN_CPU_ENVS = 128  # with fewer, a step takes longer; with 32, PPO learns PickCube-v1 later
CPU_ENVS_PER_CORE, MAX_CPU_ENVS = 32, 512  # with more, an iteration has more steps than PPO can use
UPDATE_THREADS_PER_CORE = 0.5  # OpenMP's threads wait for the slowest one, and stall if other work takes its core

# These fix the task and the network: a resumed run cannot change them, and --checkpoint brings them along.
FIXED_FLAGS = (
    "env_id", "obs_mode", "control_mode", "robot_uids", "reward_mode", "env_kwargs", "eval_partial_reset", "norm_obs",
    "layer_norm",
)  # fmt: skip

LIMITS = (  # of numbers, if given; none may be infinite or not a number
    (1, 1e18, "num_envs num_eval_envs num_actors num_steps num_minibatches update_epochs num_eval_episodes "
              "num_eval_steps success_steps total_timesteps checkpoint_freq save_freq save_train_video_freq"),
    (1e-12, 1e12, "learning_rate desired_kl clip_coef max_grad_norm reward_scale"),
    (0, 1e18, "seed critic_learning_rate logstd_lr_factor ent_coef vf_coef target_kl eval_freq "
              "reconfiguration_freq eval_reconfiguration_freq"),
    (0, 1, "gamma gae_lambda stop_at_success"),
    (0, 2**30, "eval_seed"),
    (-20, 5, "logstd_init logstd_final"),
)  # fmt: skip


# ----- Environment ----------------------------------------------------------------------------------------------------
def check_observations(args: Args) -> None:
    """Refuse observations that `Agent` cannot see."""
    if args.obs_mode != "state":
        fail(f"--obs_mode {args.obs_mode}: this script learns from the state; ppo_rgb.py learns from images")


class GoOnAfterSuccess(gym.Wrapper):
    """A training episode ends at each step of success with the chance 1 / success_steps, and at failure. If the first
    success ended it, PPO would never see the states after it, and the robot would not learn to stay."""

    def __init__(self, env: gym.Env, success_steps: float):
        super().__init__(env)
        self.chance = 1 / success_steps

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        if "success" in info:
            goes_on = info["success"] & (torch.rand(terminated.shape, device=terminated.device) >= self.chance)
            terminated = terminated & ~goes_on
        if "fail" in info:
            terminated = terminated | info["fail"]
        return obs, reward, terminated, truncated, info


def make_env(args: Args, num_envs: int, evaluation: bool = False, film: bool = False) -> gym.Env:
    """`num_envs` environments as one ManiSkill environment. Put your wrappers here. One that changes observations gives
    ManiSkill an example of the new ones: env.unwrapped.update_obs_space(obs)."""
    modes = find_task(args.env_id).cls.SUPPORTED_REWARD_MODES
    kwargs = dict(
        num_envs=num_envs,
        obs_mode=args.obs_mode,
        control_mode=args.control_mode,
        robot_uids=tuple(args.robot_uids.split(",")) if "," in (args.robot_uids or "") else args.robot_uids,
        reward_mode=args.reward_mode or next(m for m in ("normalized_dense", "dense", "sparse", "none") if m in modes),
        reconfiguration_freq=0 if evaluation else args.reconfiguration_freq,  # `evaluate` rebuilds its scenes itself
        sim_backend=args.sim_backend,
        render_backend=args.render_backend if film else "none",
        render_mode=args.render_mode if film else None,
        human_render_camera_configs=dict(shader_pack=args.shader) if film else None,
    )
    kwargs = {k: v for k, v in kwargs.items() if v is not None} | json.loads(args.env_kwargs)
    env = make_task(args.env_id, **kwargs)
    if isinstance(env.action_space, gym.spaces.Dict):
        env = flatten.FlattenActionSpaceWrapper(env)
    if not evaluation:
        env = GoOnAfterSuccess(env, args.success_steps)
    return env


# ----- Agent ----------------------------------------------------------------------------------------------------------
def layer_init(layer: nn.Module, std: float = math.sqrt(2), bias_const: float = 0.0) -> nn.Module:
    nn.init.orthogonal_(layer.weight, std)
    nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    """Gaussian policy with state-independent standard deviation, and value function.

    Observations are float32 (batch, obs_dim), actions (batch, act_dim), values and log-probabilities (batch,).
    What you put into `critic` learns at critic_learning_rate, `actor_logstd` at logstd_lr_factor * learning_rate, and
    all other parameters at learning_rate."""

    def __init__(self, obs_space: gym.spaces.Box, action_space: gym.spaces.Box, args: Args):
        super().__init__()
        obs_dim, act_dim = obs_space.shape[0], action_space.shape[0]
        norm = nn.LayerNorm if args.layer_norm else nn.Identity

        def hidden_layers():
            return nn.Sequential(
                layer_init(nn.Linear(obs_dim, 256)), norm(256), nn.Tanh(),
                layer_init(nn.Linear(256, 256)), norm(256), nn.Tanh(),
                layer_init(nn.Linear(256, 256)), norm(256), nn.Tanh(),
            )  # fmt: skip

        actor_layers, critic_layers = hidden_layers(), hidden_layers()
        self.actor_mean = nn.Sequential(actor_layers, layer_init(nn.Linear(256, act_dim), std=0.01 * math.sqrt(2)))
        self.actor_logstd = nn.Parameter(torch.full((1, act_dim), args.logstd_init))
        self.critic = nn.Sequential(critic_layers, layer_init(nn.Linear(256, 1), std=0.01))
        self.register_buffer("action_low", torch.from_numpy(action_space.low))
        self.register_buffer("action_high", torch.from_numpy(action_space.high))
        self.norm_obs = args.norm_obs
        self.register_buffer("obs_mean", torch.zeros(obs_dim))
        self.register_buffer("obs_var", torch.ones(obs_dim))
        self.register_buffer("obs_count", torch.tensor(1e-4))

    def normalize(self, obs):
        if not self.norm_obs:
            return obs
        return ((obs - self.obs_mean) * torch.rsqrt(self.obs_var + 1e-5)).clamp(-10, 10)

    @torch.no_grad()
    def update_normalization(self, obs):
        """Merge the mean and variance of a batch of observations into the running ones (Chan et al. 1979)."""
        n = len(obs) * WORLD_SIZE
        mean = all_reduce_mean(obs.mean(0))
        var = all_reduce_mean(((obs - mean) ** 2).mean(0))
        count, delta = self.obs_count + n, mean - self.obs_mean
        m2 = self.obs_var * self.obs_count + var * n
        self.obs_var.copy_((m2 + delta**2 * self.obs_count * n / count) / count)
        self.obs_mean.add_(delta * n / count)
        self.obs_count.copy_(count)

    def get_value(self, obs):
        return self.critic(self.normalize(obs)).squeeze(-1)

    def clip_action(self, action):
        """Returns what the simulator accepts: actions inside the bounds of the action space, and zero for NaN."""
        return action.clamp(self.action_low, self.action_high).nan_to_num()

    def get_action(self, obs):
        """Returns the deterministic action: the mean of the policy, inside the bounds of the action space."""
        return self.clip_action(self.actor_mean(self.normalize(obs)))

    def get_action_and_value(self, obs, action=None):
        """Returns the action (a random one if none is given), its log-probability, the entropy, and the value."""
        obs = self.normalize(obs)
        mean = self.actor_mean(obs)
        policy = Normal(mean, self.actor_logstd.exp().expand_as(mean), validate_args=False)
        if action is None:  # policy.sample() would make the host wait for the GPU
            action = (mean + policy.stddev * torch.randn_like(mean)).detach()
        value = self.critic(obs).squeeze(-1)
        return action, policy.log_prob(action).sum(-1), policy.entropy().sum(-1), value


# ----- PPO ------------------------------------------------------------------------------------------------------------
def compute_gae(rewards, values, next_values, dones, gamma, gae_lambda, finite_horizon=False):
    """Generalised advantage estimation (Schulman et al. 2016, arXiv 1506.02438).

    Args:
        rewards, values: (num_steps, num_envs), of the step and of the observation it started from.
        next_values: (num_steps, num_envs), value of the step's true next observation: at the end of an episode the
            final one, not the reset one. Zero where the end is not bootstrapped.
        dones: (num_steps, num_envs), whether the episode ended with the step.
        finite_horizon: False: eq. 16, line 2, the infinite lambda-weighted sum. True: line 1, the lambda-weighted mean
            of the n-step returns that exist before the episode or the rollout ends.

    Returns (advantages, returns), each (num_steps, num_envs); returns = advantages + values."""
    not_done = 1.0 - dones.to(rewards.dtype)
    advantages = torch.zeros_like(rewards)
    if finite_horizon:
        # sums over n of lambda^(n-1) times: 1, the rewards within n steps, the value after n steps
        weight_sum = reward_sum = value_sum = torch.zeros_like(rewards[0])
        for step in reversed(range(len(rewards))):
            weight_sum = 1.0 + gae_lambda * not_done[step] * weight_sum
            reward_sum = weight_sum * rewards[step] + gamma * gae_lambda * not_done[step] * reward_sum
            value_sum = gamma * next_values[step] + gamma * gae_lambda * not_done[step] * value_sum
            advantages[step] = (reward_sum + value_sum) / weight_sum - values[step]
    else:
        deltas = rewards + gamma * next_values - values
        next_advantage = torch.zeros_like(rewards[0])
        for step in reversed(range(len(rewards))):
            next_advantage = deltas[step] + gamma * gae_lambda * not_done[step] * next_advantage
            advantages[step] = next_advantage
    return advantages, advantages + values


def make_optimizer(agent: nn.Module, args: Args, device: torch.device) -> torch.optim.Optimizer:
    """Adam with one group each for `actor_logstd`, for `critic`, and for all else."""
    special = {id(p) for p in (agent.actor_logstd, *agent.critic.parameters())}
    actor = [p for p in agent.parameters() if id(p) not in special]
    critic_lr = args.learning_rate if args.critic_learning_rate is None else args.critic_learning_rate
    adapts = args.desired_kl is not None
    groups = [
        dict(params=actor, initial_lr=args.learning_rate, adapts=adapts),
        dict(params=[agent.actor_logstd], initial_lr=args.learning_rate * args.logstd_lr_factor, adapts=adapts),
        dict(params=[*agent.critic.parameters()], initial_lr=critic_lr, adapts=False),
    ]
    for group in groups:
        group["lr"] = torch.tensor(group["initial_lr"], device=device)  # where a CUDA graph reads it
    return torch.optim.Adam(groups, eps=1e-5, fused=True, capturable=device.type == "cuda")


def load_optimizer(optimizer: torch.optim.Optimizer, saved: dict) -> None:
    """Load Adam's moments, and each learning rate as far as it was adapted, unless its flag has changed."""
    flags = [{k: v for k, v in group.items() if k != "params"} for group in optimizer.param_groups]
    optimizer.load_state_dict(saved)
    for group, flag in zip(optimizer.param_groups, flags):
        if group["adapts"] and flag["adapts"] and group["initial_lr"] == flag["initial_lr"]:
            flag["lr"].copy_(group["lr"])
        group.update(flag)


def adapt_learning_rate(optimizer, kl: torch.Tensor, desired_kl: float) -> None:
    """Lower the policy's learning rate if the KL divergence is more than twice the desired one, and raise it if it is
    less than half of it (Rudin et al. 2022, arXiv 2109.11978), within 0.01 to 10 times the initial one."""
    factor = torch.where(kl > 2 * desired_kl, 1 / 1.5, torch.where(kl < desired_kl / 2, 1.5, 1.0))
    for group in optimizer.param_groups:
        if group["adapts"]:
            group["lr"].mul_(factor).clamp_(group["initial_lr"] / 100, group["initial_lr"] * 10)


UPDATE_METRICS = ("policy_loss", "value_loss", "entropy", "approx_kl", "clipfrac", "grad_norm")


def update_minibatch(agent, optimizer, args, obs, actions, logprobs, advantages, returns, values) -> torch.Tensor:
    """One gradient step of PPO (Schulman et al. 2017, arXiv 1707.06347, eq. 7 and 9) on tensors of `minibatch` rows.
    With several processes it is the step of all their rows together.

    Returns the UPDATE_METRICS of the minibatch, one tensor on the device."""
    _, newlogprob, entropy, newvalue = agent.get_action_and_value(obs, actions)
    logratio = newlogprob - logprobs
    ratio = logratio.exp()
    if args.norm_adv:
        advantages = advantages - all_reduce_mean(advantages.mean())
        advantages = advantages / (all_reduce_mean((advantages**2).mean()).sqrt() + 1e-8)

    clipped_ratio = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    policy_loss = torch.max(-advantages * ratio, -advantages * clipped_ratio).mean()
    value_error = (newvalue - returns) ** 2
    if args.clip_vloss:
        clipped_value = values + (newvalue - values).clamp(-args.clip_coef, args.clip_coef)
        value_error = torch.max(value_error, (clipped_value - returns) ** 2)
    value_loss = 0.5 * value_error.mean()
    entropy = entropy.mean()
    loss = policy_loss - args.ent_coef * entropy + args.vf_coef * value_loss

    optimizer.zero_grad()
    loss.backward()
    average_gradients(agent)
    grad_norm = nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
    optimizer.step()

    with torch.no_grad():
        approx_kl = ((ratio - 1) - logratio).mean()  # estimator k3 of http://joschu.net/blog/kl-approx.html
        if args.desired_kl is not None:
            adapt_learning_rate(optimizer, all_reduce_mean(approx_kl), args.desired_kl)
        clipfrac = ((ratio - 1).abs() > args.clip_coef).float().mean()
        return torch.stack([policy_loss, value_loss, entropy, approx_kl, clipfrac, grad_norm])


@torch.no_grad()
def rollout(agent, envs, storage: dict, obs, args: Args, act, get_value) -> tuple:
    """Act for num_steps in the environments of one actor, and write what happens into its columns of the storage.

    Args:
        storage: obs, actions, logprobs, rewards, dones, values and next_values, each (num_steps, num_envs, ...).
        obs: (num_envs, obs_dim), the first observation.
        act, get_value: agent.get_action_and_value and agent.get_value, or CUDA graphs of them.

    Returns the next observation, and sums over the episodes that ended: a dict of scalars."""
    final_values = torch.zeros_like(storage["next_values"])
    sums = {"num_episodes": torch.zeros((), device=envs.device)}
    for step in range(args.num_steps):
        action, logprob, _, value = act(obs)
        storage["obs"][step] = obs
        storage["actions"][step], storage["logprobs"][step], storage["values"][step] = action, logprob, value
        obs, reward, terminated, truncated, infos = envs.step(agent.clip_action(action))
        done = terminated | truncated
        storage["rewards"][step] = reward * args.reward_scale
        storage["dones"][step] = done
        if "final_observation" in infos:  # some episodes ended: there, obs is the first one of the next episode
            # ManiSkill's rewards are positive at every step: without the final value, an early success would earn less
            # than dawdling. "truncated" is the textbook rule (Pardo et al. 2018, arXiv 1712.00378).
            bootstraps = {"always": done, "truncated": truncated & ~terminated, "never": torch.zeros_like(done)}
            final_value = get_value(infos["final_observation"])
            final_values[step] = torch.where(bootstraps[args.bootstrap_at_done], final_value, 0.0)
            add_episodes(sums, infos["final_info"], done)
    following_values = torch.cat([storage["values"][1:], get_value(obs)[None]])
    storage["next_values"].copy_(torch.where(storage["dones"].bool(), final_values, following_values))
    return obs, sums


def score(episodes: dict[str, torch.Tensor]) -> list[float]:
    """What best.pt is chosen by: the success rates at some step and at the last one, added; if equal, the return."""
    rates = [episodes[name].mean().item() for name in ("success_once", "success_at_end") if name in episodes]
    return [sum(rates), episodes["return"].mean().item()]


def train(args: Args, closing: contextlib.ExitStack) -> None:
    """A run from its first evaluation to its last checkpoint. However it ends, `closing` then writes last.pt, closes
    the files and ends the actors."""
    # --- environments, agent, optimizer; `args` counts what all processes of torchrun have, `local` what this one has
    args, local, device, run_dir = start_processes(args, closing)
    loaded = load_checkpoint(args.resume or args.checkpoint) if args.resume or args.checkpoint else {}
    resumed = loaded if args.resume else {}
    first_iteration, global_step = resumed.get("iteration", 0), resumed.get("global_step", 0)
    torch.set_num_threads(1)  # idle threads would spin on cores that the simulation needs

    film = Film(local, run_dir, closing)
    actors = Actors(local, run_dir / "videos", closing)
    seed_all(args.seed)  # the same weights, whatever the environments drew
    agent = make_agent(*actors.spaces, args, loaded).to(device)
    optimizer = make_optimizer(agent, args, device)
    if loaded:  # the initial learning rate would wreck a policy whose standard deviation has shrunk
        load_optimizer(optimizer, loaded["optimizer"])

    # --- buffers: `storage` has tensors (num_steps, num_envs, ...), `batch` views of them (num_steps * num_envs, ...)
    storage = actors.distribute(agent, device)
    names = ("obs", "actions", "logprobs", "values")
    batch = tree_map(lambda x: x.flatten(0, 1), {name: storage[name] for name in names})
    batch |= {name: torch.zeros(local.batch_size, device=device) for name in ("advantages", "returns")}
    permutation = torch.zeros(local.batch_size, dtype=torch.long, device=device)

    def update_epoch():
        """All minibatches of a permutation of the batch; returns their UPDATE_METRICS, a row each."""
        rows = []
        for mb_inds in permutation.split(local.batch_size // args.num_minibatches)[: args.num_minibatches]:
            mb = tree_map(lambda x: x[mb_inds], batch)
            rows.append(update_minibatch(agent, optimizer, args, **mb))
        return all_reduce_mean(torch.stack(rows))

    run_update_epoch = CudaGraph(update_epoch, args, device)
    closing.callback(run_update_epoch.close)

    logger = Logger(args, run_dir, device, resumed)
    closing.callback(logger.close)
    checkpoints = Checkpoints(args, run_dir, resumed, agent, optimizer, actors.spaces[0], logger)
    closing.callback(checkpoints.close)

    for iteration in range(first_iteration, args.num_iterations + 1):  # the number of finished updates
        # --- checkpoint: a run that ends in this iteration, for whatever reason, can be resumed from here ---
        checkpoints.take(iteration, global_step)

        # --- evaluate: the untrained policy, every eval_freq iterations, and the final policy ---
        is_last = iteration == args.num_iterations
        if is_last or iteration == 0 or args.eval_freq and iteration % args.eval_freq == 0:
            episodes = actors.evaluate(args.eval_seed)
            metrics = {key: values.mean().item() for key, values in episodes.items()}
            logger.log("eval", global_step, metrics | {"num_episodes": len(episodes["return"])})
            if score(episodes) > checkpoints.best_score:  # perhaps by luck: as many other episodes count as well
                more = actors.evaluate(args.eval_seed + len(episodes["return"]))
                checkpoints.update_best(score(concatenate([episodes, more])))
            if local.capture_video:
                film.record(actors.agent, f"videos/step_{global_step:09d}", args.eval_seed)
            is_solved = args.stop_at_success is not None and metrics.get("success_once", 0) >= args.stop_at_success
            if is_last or is_solved and iteration > first_iteration:  # a solved run can be resumed
                checkpoints.contents["finished"] = is_last
                break

        # --- rollout: num_steps in every environment, in all actors at the same time ---
        start = time.perf_counter()
        sums_of_actors = actors.rollout(iteration, is_first=iteration == first_iteration)
        rollout_time = time.perf_counter() - start

        # --- advantages ---
        gae_inputs = [storage[name] for name in ("rewards", "values", "next_values", "dones")]
        advantages, returns = compute_gae(*gae_inputs, args.gamma, args.gae_lambda, args.finite_horizon_gae)
        batch["advantages"].copy_(advantages.flatten())
        batch["returns"].copy_(returns.flatten())
        explained_variance = all_reduce_mean(1 - advantages.var() / returns.var().clamp(min=1e-8))

        # --- update: update_epochs times over the batch, in shuffled minibatches ---
        torch.set_num_threads(max(1, int(num_cores() * UPDATE_THREADS_PER_CORE)))
        if args.anneal_lr:
            for group in optimizer.param_groups:
                if not group["adapts"]:  # fill a tensor: Python numbers are frozen in a CUDA graph
                    group["lr"].fill_(group["initial_lr"] * (1 - iteration / args.num_iterations))
        update_metrics = []
        for _ in range(args.update_epochs):
            torch.randperm(local.batch_size, out=permutation)
            update_metrics.append(run_update_epoch().clone())
            last_kl = update_metrics[-1][-1, UPDATE_METRICS.index("approx_kl")]
            if args.target_kl is not None and last_kl > args.target_kl:  # the host waits, once an epoch
                break
        if args.norm_obs:  # only now: the update needs the rollout's log-probabilities
            agent.update_normalization(batch["obs"])
        progress = (iteration + 1) / args.num_iterations
        if args.logstd_final is not None and progress > 0.5:  # noise that is left hides where the mean falls short
            limit = args.logstd_init + (2 * progress - 1) * (args.logstd_final - args.logstd_init)
            agent.actor_logstd.data.clamp_(max=limit)
        torch.set_num_threads(1)
        global_step += args.batch_size

        # --- log: here the host waits for the device ---
        if not torch.stack([x.isfinite().all() for x in (*agent.parameters(), agent.obs_var)]).all():
            raise RunError("the update gave weights that are not finite: try a lower --learning_rate")
        metrics = average_episodes(sums_of_actors)
        metrics |= dict(zip(UPDATE_METRICS, torch.cat(update_metrics).mean(0).tolist()))
        elapsed = time.perf_counter() - start
        metrics |= dict(
            iteration=iteration + 1, explained_variance=explained_variance.item(),
            learning_rate=optimizer.param_groups[0]["lr"].item(), sps=args.batch_size / elapsed,
            rollout_time=rollout_time, update_time=elapsed - rollout_time,
        )  # fmt: skip
        logger.log("train", global_step, metrics)
        if local.save_train_video_freq and iteration % local.save_train_video_freq == 0:
            actors.agent.load_state_dict(agent.state_dict())  # it may be a copy on another device
            film.record(actors.agent, f"train_videos/step_{global_step:09d}", args.eval_seed, exploring=True)


# ----- Machinery: nothing below is PPO --------------------------------------------------------------------------------


# ----- Evaluation -----------------------------------------------------------------------------------------------------
@torch.no_grad()
def evaluate(agent, envs, args: Args, num_episodes, seed, separately=False, exploring=False, video=None) -> dict:
    """Run whole episodes; episode k starts from seed + k. Actions are deterministic, unless `exploring`. `separately`:
    see start_episodes. `video`: an imageio writer that gets a picture of each step.

    Returns return, episode_len, success_once and so on: a float tensor (num_episodes,) each, on the CPU."""
    seed_all(seed)  # for tasks that draw random numbers during an episode
    rounds, num_steps, rebuild_freq = [], evaluation_size(envs, args)[1], args.eval_reconfiguration_freq
    if rebuild_freq is None:  # in rounds of all environments
        rebuild_freq = 1 if varies_objects(args.env_id) or args.exact_resume else 0
    for first in range(seed, seed + num_episodes, envs.num_envs):
        seeds = list(range(first, first + envs.num_envs))
        if rebuild_freq and len(rounds) % rebuild_freq == 0:
            envs.reset(seed=seeds, options=dict(reconfigure=True))
        obs = start_episodes(envs, seeds, separately)
        add_picture(video, envs)
        running = torch.ones(envs.num_envs, dtype=torch.bool, device=envs.device)
        episodes = {}
        for step in range(1, num_steps + 1):
            action = agent.clip_action(agent.get_action_and_value(obs)[0]) if exploring else agent.get_action(obs)
            obs, _, terminated, truncated, infos = envs.step(action)
            add_picture(video, envs)
            ended = running & (terminated | truncated | (step == num_steps))
            running &= ~ended
            for k, v in episode_metrics(infos).items():
                episodes[k] = torch.where(ended, v.float(), episodes.get(k, 0.0))
            if not running.any():
                break
        if isinstance(envs._env, RecordEpisode):
            envs._env.flush_trajectory()
            envs._env._h5_file.flush()
        rounds.append(episodes)
    names = [k for k in (rounds[0] if rounds else {}) if k != "reward"]
    return {k: torch.cat([episodes[k] for episodes in rounds])[:num_episodes].cpu() for k in names}


def add_picture(video, envs) -> None:
    if video is not None:
        pictures = common.to_numpy(envs._env.render())
        video.append_data(tile_images(list(pictures), nrows=math.isqrt(len(pictures))))


def episode_metrics(info: dict) -> dict[str, torch.Tensor]:
    """What ManiSkillVectorEnv records of an episode, and what the task's `evaluate` says at its end, each (num_envs,):
    success_at_end, fail_at_end, and the task's own numbers as final_<name>."""
    names = {"success": "success_at_end", "fail": "fail_at_end"}
    metrics = dict(info["episode"])
    for k, v in info.items():
        if isinstance(v, torch.Tensor) and v.shape == metrics["return"].shape and k != "elapsed_steps":
            metrics[names.get(k, f"final_{k}")] = v
    return metrics


def add_episodes(sums: dict, info: dict, done: torch.Tensor) -> None:
    """Add the metrics of the episodes that are done, and their number, to the sums."""
    metrics = episode_metrics(info) | dict(num_episodes=done)
    totals = torch.where(done, torch.stack([value.float() for value in metrics.values()]), 0.0).sum(1)
    for key, total in zip(metrics, totals):
        sums[key] = sums.get(key, 0.0) + total


def start_episodes(envs: ManiSkillVectorEnv, seeds: list[int], separately: bool):
    """Start an episode from each seed; returns the first observations. ManiSkill draws a whole batch from its first
    seed. `separately` resets each environment by itself, so that each episode follows from its own seed alone."""
    if not separately:
        return envs.reset(seed=seeds)[0]
    for i, seed in enumerate(seeds):
        obs, _ = envs.reset(seed=[seed] * len(seeds), options=dict(env_idx=torch.tensor([i])))
    envs.base_env._set_main_rng(seeds)
    envs.base_env._set_episode_rng(seeds, torch.arange(len(seeds)))  # for what a task draws during its episodes
    return obs


def concatenate(parts: list[dict]) -> dict[str, torch.Tensor]:
    """The episodes of several actors or processes, in order."""
    parts = [part for part in parts if part]
    return {k: torch.cat([part[k] for part in parts]) for k in parts[0]}


def interval(values: torch.Tensor) -> tuple[float, float]:
    """95% confidence interval of the mean: Wilson's score interval if all values are 0 or 1, else the normal one."""
    n, mean, z = len(values), values.double().mean().item(), 1.96
    if ((values == 0) | (values == 1)).all():
        centre = (mean + z**2 / (2 * n)) / (1 + z**2 / n)
        half = z / (1 + z**2 / n) * math.sqrt(mean * (1 - mean) / n + z**2 / (4 * n**2))
        return max(0.0, centre - half), min(1.0, centre + half)
    half = z * values.double().std().item() / math.sqrt(n) if n > 1 else math.inf
    return mean - half, mean + half


def evaluate_checkpoint(args: Args, closing: contextlib.ExitStack) -> None:
    """--evaluate: play the episodes, print, film and write the results."""
    torch.set_num_threads(1)
    _, _, _, folder = start_processes(args, closing)
    film = Film(args, folder, closing)
    actors = Actors(args, folder / "test_videos", closing)
    agent = make_agent(*actors.spaces, args, load_checkpoint(args.checkpoint)).to(actors.device)
    actors.distribute(agent, actors.device)
    episodes = actors.evaluate(args.eval_seed)
    if args.capture_video:
        for seed in range(args.eval_seed, args.eval_seed + 4, film.num_envs):
            film.record(agent, f"test_videos/seed_{seed}", seed)

    num_episodes, first = len(episodes["return"]), args.eval_seed
    results = dict(env_id=args.env_id, num_episodes=num_episodes, eval_seed=first)
    print(f"{args.env_id} on {args.sim_backend}, {num_episodes} episodes from seed {first} on, 95% intervals:")
    for key, values in episodes.items():
        results[key] = values.mean().item()
        line = f"  {key:<20}{results[key]:8.3f}"
        low, high = interval(values)
        if math.isfinite(low):  # a single episode has none
            results[f"{key}_interval"] = low, high
            line += f"  [{low:.3f}, {high:.3f}]"
        print(line)
    (folder / "eval.json").write_text(json.dumps(results, indent=2) + "\n")
    print(f"written: {folder / 'eval.json'}" + ("" if film.envs is None else f", {folder / 'test_videos'}"))


def find_render_error(args: Args) -> Optional[str]:
    """Why nothing can render what is simulated, or None: GPU simulation needs a GPU for it, too."""
    if RENDER_DEVICE is not None and (args.sim_backend == "physx_cpu" or RENDER_DEVICE.is_cuda()):
        return None
    return ("there is no Vulkan device to render images (CPU: apt install mesa-vulkan-drivers, 23.1 or newer; "
            "GPU: NVIDIA_DRIVER_CAPABILITIES=all in a container)")  # fmt: skip


class Film:
    """A small batch of its own that plays the first evaluation episodes again, into videos. Make it before any other
    environment."""

    def __init__(self, args: Args, folder: Path, closing: contextlib.ExitStack):
        self.args, self.folder, self.closing, self.envs = args, folder, closing, None
        self.is_off = args.render_backend == "none" or not (args.capture_video or args.save_train_video_freq)
        if not self.is_off and find_render_error(args) is None:
            # A process renders on one device: that of the first render object, which would be a task's on any device.
            device = parse_backends_and_find_renderer(args.sim_backend, args.render_backend).render_device
            self.renderer = sapien.render.RenderSystem(device)
        self.num_envs = 1 if args.sim_backend == "physx_cpu" else 4

    def record(self, agent, name: str, seed: int, exploring: bool = False) -> None:
        """Write <folder>/<name>.mp4, frame by frame. If that fails, the run goes on without videos."""
        if self.is_off:
            return
        path = self.folder / f"{name}.mp4"
        try:
            if reason := find_render_error(self.args):
                raise RunError(reason)
            if self.envs is None:
                self.envs = make_envs(self.args, self.num_envs, seed, evaluation=True, film=True)
                self.closing.callback(self.envs.close)
            path.parent.mkdir(parents=True, exist_ok=True)
            with imageio.get_writer(path, fps=self.envs.base_env.control_freq) as video:
                evaluate(agent, self.envs, self.args, self.num_envs, seed, exploring=exploring, video=video)
        except Exception as error:
            self.is_off = True
            tqdm.write(f"no videos: {describe(error)}")
            path.unlink(missing_ok=True)


# ----- Environments ---------------------------------------------------------------------------------------------------
def find_task(env_id: str):
    """The registration of a task. Raises KeyError or ImportError if there is none."""
    module, _, name = env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    return REGISTERED_ENVS[name]


def varies_objects(env_id: str) -> bool:
    """Whether the task builds other objects for each episode. Such tasks take reconfiguration_freq as an argument."""
    for cls in find_task(env_id).cls.__mro__:
        if cls is sapien_env.BaseEnv:  # it takes the argument for all tasks
            return False
        if "__init__" in vars(cls) and "reconfiguration_freq" in inspect.signature(cls.__init__).parameters:
            return True
    return False


def make_task(env_id: str, **kwargs) -> gym.Env:
    """gym.make. What ManiSkill says of an argument becomes one line; an error in your own code keeps its traceback."""
    try:
        return gym.make(env_id, **kwargs)
    except Exception as error:
        cause = error.__cause__ or error  # gym.make raises some errors again
        if isinstance(error, RunError) or not is_from_packages(cause):
            raise
        raise RunError(f"{env_id}: {describe(cause)}") from None


def make_envs(args: Args, num_envs: int, seed: int, evaluation=False, film=False, record=None) -> ManiSkillVectorEnv:
    """Environments with ManiSkill's interface for a batch. Those for evaluation do not reset by themselves. If the task
    varies its objects, they follow from the seed. `record`: arguments of RecordEpisode, which writes trajectories."""
    sapien_env.BaseEnv.build_seed = seed
    env = make_env(args, num_envs, evaluation, film)
    if record:
        env = RecordEpisode(env, save_video=False, save_on_reset=True, source_type="rl", source_desc="PPO", **record)
    ends_early = args.eval_partial_reset if evaluation else args.partial_reset
    return ManiSkillVectorEnv(env, auto_reset=not evaluation, ignore_terminations=not ends_early, record_metrics=True)


def evaluation_size(envs, args: Args) -> tuple[int, int]:
    """Number of evaluation episodes, and of steps in each."""
    limit = find_max_episode_steps_value(envs)
    if limit and args.num_eval_steps:
        return args.num_eval_envs * max(1, args.num_eval_steps // limit), limit
    return args.num_eval_episodes, limit or args.num_eval_steps or 1000


def training_rebuild_freq(args: Args, envs: ManiSkillVectorEnv) -> float:
    """After how many iterations training builds new scenes (infinity: never)."""
    limit = find_max_episode_steps_value(envs)
    if args.exact_resume:  # PhysX remembers contacts of earlier episodes
        return args.checkpoint_freq
    if args.sim_backend == "physx_cpu" and varies_objects(args.env_id) and limit and args.reconfiguration_freq is None:
        return math.ceil(10 * limit / args.num_steps)  # other objects after ten episodes of full length
    return math.inf


def find_reset_error(envs: ManiSkillVectorEnv) -> Optional[Exception]:
    """The error that a task raises when some of several environments are reset, as a few of ManiSkill's do, or None."""
    if envs.num_envs > 1:
        try:
            envs.reset(options=dict(env_idx=torch.zeros(1, dtype=torch.long, device=envs.device)))
        except (RuntimeError, IndexError, ValueError, AssertionError) as error:
            return error
    return None


def check_task(args: Args, envs: ManiSkillVectorEnv) -> None:
    """Refuse observations that do not fit their space, and partial resets that the task cannot do; print a note if
    gamma does not suit the length of its episodes."""
    obs, info = envs.reset()
    spaces = getattr(envs.single_observation_space, "spaces", {"obs": envs.single_observation_space})
    for k, space in spaces.items():
        x = obs[k] if isinstance(obs, dict) else obs
        if (x.shape[1:], x.dtype) != (space.shape, getattr(torch, space.dtype.name)):
            raise RunError(f"the observation {k} is {x.dtype} {tuple(x.shape[1:])}, and its space has {space.dtype} "
                           f"{space.shape}: a wrapper that changes it must call update_obs_space")  # fmt: skip
    reset_error = find_reset_error(envs)
    if args.partial_reset and reset_error and {"success", "fail"} & info.keys():
        fail(f"{args.env_id} cannot reset some of several environments ({describe(reset_error)}): --no-partial_reset "
             "resets all; --sim_backend physx_cpu --num_actors N --num_envs N gives each a process")  # fmt: skip
    limit = find_max_episode_steps_value(envs)
    if limit and args.gamma < 1 and not limit / 25 <= 1 / (1 - args.gamma) <= 10 * limit:
        ahead, better = 1 / (1 - args.gamma), 1 - 10 / max(limit, 20)
        print(f"note: --gamma {args.gamma} looks {ahead:.0f} steps ahead, and an episode has {limit}: try {better:.3g}")


def refuse_download(message: str) -> NoReturn:
    """ManiSkill asks on the terminal whether it may download assets, which a batch job cannot answer."""
    name = message.split()[1]
    raise RunError(f"{name} needs assets: python -m mani_skill.utils.download_asset {name}")


download_asset.prompt_yes_no = refuse_download
parse_backends = sapien_env.parse_sim_and_render_backend


def parse_backends_and_find_renderer(sim_backend: str, render_backend: str):
    """Render on the GPU that simulates. ManiSkill has no name for a Vulkan device without CUDA: use it if CUDA cannot
    render."""
    if render_backend == "gpu" and sim_backend.startswith("physx_cuda"):
        render_backend = sim_backend.replace("physx_cuda", "gpu")
    backend = parse_backends(sim_backend, render_backend)
    if RENDER_DEVICE and backend.render_device and not backend.render_device.can_render():
        backend.render_device, backend.render_backend = RENDER_DEVICE, "sapien_cpu"
    return backend


sapien_env.parse_sim_and_render_backend = parse_backends_and_find_renderer

# Warnings about the device that is replaced above, and about robots as they are, concern no user.
NOISE = "Requested to use render device|mani_skill is not installed with git|"
NOISE += "Currently ManiSkill does not support loading plane|No initial pose set for"
mani_skill.logger.addFilter(lambda record: not re.match(NOISE, record.getMessage()))


def seed_all(*numbers: int) -> None:
    """Seed every random generator of this process."""
    seed = int(np.random.SeedSequence(numbers).generate_state(1)[0])
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


# ----- Batched CPU simulation -----------------------------------------------------------------------------------------
MAX_SCENES_OF_PROCESS = 800  # each takes one of 1,024 thread-local keys (torch takes some); PhysX does not check


class Array:
    """Stands for SAPIEN's CUDA arrays, which ManiSkill reads and writes as .torch()."""

    def __init__(self, *shape: int):
        self.data = torch.zeros(shape)
        self.applied = torch.zeros(shape)  # what the simulation has

    def fetch(self, values: torch.Tensor, rows=slice(None), columns=slice(None)) -> None:
        self.data[rows, columns] = self.applied[rows, columns] = values

    def find_changes(self, rows=slice(None), columns=slice(None)) -> torch.Tensor:
        """Indices (num_changes, 2) of the numbers that ManiSkill changed since they were fetched or applied. The
        simulation keeps all others, to the last bit."""
        data, applied = self.data[rows, columns], self.applied[rows, columns]
        if torch.equal(data, applied):
            return torch.zeros(0, 2, dtype=torch.long)
        changed = (data != applied) & ~(data.isnan() & applied.isnan())
        self.applied[rows, columns] = data
        return changed.nonzero()

    def torch(self):
        return self.data


class BatchedPhysx:
    """The interface of SAPIEN's PhysxGpuSystem over one PhysxCpuSystem per environment, with tensors on the CPU.

    `gpu_apply_*` moves what ManiSkill wrote into the tensors `cuda_*` into the simulation, `gpu_fetch_*` moves what was
    simulated into the tensors. `cuda_rigid_body_data` has a row for each body, first the free ones, then all links:
    position, quaternion, linear and angular velocity. `cuda_articulation_*` has a row for each robot, padded."""

    __class__ = physx.PhysxGpuSystem  # for isinstance

    def __init__(self, scenes: list[sapien.Scene]):
        self.scenes, self.systems = scenes, [scene.physx_system for scene in scenes]
        self.timestep, self.num_steps = self.systems[0].timestep, 0
        for scene in scenes:
            scene.batch = self

    def gpu_init(self) -> None:
        self.free = [body for system in self.systems for body in system.rigid_dynamic_components]
        self.links = [link for system in self.systems for link in system.articulation_link_components]
        self.robots = [link.articulation for link in self.links if link.is_root]
        self.joints = [robot.active_joints for robot in self.robots]
        self.driven, self.contacts, self.is_read, self.pose_sizes = set(), None, False, None
        self.row = {body: i for i, body in enumerate(self.free + self.links)}
        self.row |= {robot: i for i, robot in enumerate(self.robots)}
        self.root_rows = torch.tensor([self.row[link] for link in self.links if link.is_root], dtype=torch.long)
        num_bodies, num_robots = len(self.free) + len(self.links), len(self.robots)
        max_dof = max([robot.dof for robot in self.robots], default=0)
        max_links = max([len(robot.links) for robot in self.robots], default=0)
        self.cuda_rigid_body_data, self.cuda_rigid_body_force = Array(num_bodies, 13), Array(num_bodies, 4)
        for name in ("qpos", "qvel", "qacc", "qf", "target_qpos", "target_qvel"):
            setattr(self, f"cuda_articulation_{name}", Array(num_robots, max_dof))
        self.cuda_articulation_link_incoming_joint_forces = Array(num_robots, max_links, 6)

        # Where the numbers are in the bytes of pack(): for each free body, then for each articulation, quaternion (w
        # first), position, linear and angular velocity; for articulations then each joint's position and velocity.
        starts, end = {}, 0
        for system in self.systems:
            robots = [link.articulation for link in system.articulation_link_components if link.is_root]
            for x in system.rigid_dynamic_components + robots:
                starts[x] = end
                end += 13 + 4 * getattr(x, "dof", 0)
        order = torch.tensor([4, 5, 6, 0, 1, 2, 3, 7, 8, 9, 10, 11, 12])
        self.free_columns = torch.tensor([starts[x] for x in self.free], dtype=torch.long)[:, None] + order
        self.root_columns = torch.tensor([starts[x] for x in self.robots], dtype=torch.long)[:, None] + order[7:]
        self.joint_columns = torch.full((2, num_robots, max_dof), end)  # padding reads a zero at the end
        for i, robot in enumerate(self.robots):
            columns = starts[robot] + 13 + torch.arange(2 * robot.dof)
            self.joint_columns[:, i, : robot.dof] = columns.view(2, robot.dof)
        self.gpu_fetch_rigid_dynamic_data()
        self.gpu_fetch_articulation_link_pose()
        self.gpu_fetch_articulation_qpos()
        self.gpu_fetch_articulation_qvel()

    def step(self) -> None:
        self.gpu_apply_articulation_target_position()
        self.gpu_apply_articulation_target_velocity()
        for i in self.driven:
            self.robots[i].root.wake_up()  # as in a single environment, where setting a target wakes the robot
        for system in self.systems:
            system.step()
        self.contacts, self.is_read = None, False
        self.num_steps += 1

    def _read(self) -> None:
        """Read the state of all scenes, unless nothing has changed since."""
        if self.is_read:
            return
        self.is_read = True
        states = [system.pack() for system in self.systems]
        poses = [scene.pack_poses() for scene in self.scenes]  # quaternion and position of each entity
        self.states = torch.frombuffer(bytearray().join([*states, bytes(4)]), dtype=torch.float32)
        self.poses = torch.frombuffer(bytearray().join([*poses, bytes(4)]), dtype=torch.float32)
        sizes = [len(x) // 4 for x in poses]
        if sizes != self.pose_sizes:  # lights and cameras, which are entities, may be added at any time
            self.pose_sizes, entity_at = sizes, {}
            for scene, start in zip(self.scenes, np.cumsum([0, *sizes])):
                entity_at |= {entity: int(start) + 7 * i for i, entity in enumerate(scene.entities)}
            links_at = torch.tensor([entity_at[link.entity] for link in self.links], dtype=torch.long)
            self.link_columns = links_at[:, None] + torch.tensor([4, 5, 6, 0, 1, 2, 3])

    def gpu_fetch_rigid_dynamic_data(self) -> None:
        self._read()
        self.cuda_rigid_body_data.fetch(self.states[self.free_columns], slice(0, len(self.free)))

    def gpu_fetch_articulation_link_pose(self) -> None:
        self._read()
        self.cuda_rigid_body_data.fetch(self.poses[self.link_columns], slice(len(self.free), None), slice(0, 7))

    def gpu_fetch_articulation_link_velocity(self) -> None:
        """Fetches the roots' velocities. Few tasks ask for other links: `read_velocities` then reads theirs."""
        self._read()
        self.cuda_rigid_body_data.fetch(self.states[self.root_columns], self.root_rows, slice(7, 13))

    def _fetch_joints(self, name: str, row: int) -> None:
        self._read()
        getattr(self, f"cuda_articulation_{name}").fetch(self.states[self.joint_columns[row]])

    gpu_fetch_articulation_qpos = partialmethod(_fetch_joints, "qpos", 0)
    gpu_fetch_articulation_qvel = partialmethod(_fetch_joints, "qvel", 1)

    def read_velocities(self, links: list) -> None:
        for link in links:
            if not link.is_root:
                velocity = torch.tensor([*link.linear_velocity, *link.angular_velocity])
                self.cuda_rigid_body_data.data[self.row[link], 7:] = velocity

    def gpu_fetch_articulation_qacc(self) -> None:
        for robot, row in zip(self.robots, self.cuda_articulation_qacc.data):
            row[: robot.dof] = torch.from_numpy(robot.qacc)

    def gpu_fetch_articulation_link_incoming_joint_forces(self) -> None:
        for robot, row in zip(self.robots, self.cuda_articulation_link_incoming_joint_forces.data):
            row[: len(robot.links)] = torch.from_numpy(robot.get_link_incoming_joint_forces())

    def _changed_rows(self, array: Array, rows=slice(None), columns=slice(None)) -> list[int]:
        changed = array.find_changes(rows, columns)[:, 0].unique().tolist()
        self.is_read &= not changed
        return changed

    def gpu_apply_rigid_dynamic_data(self) -> None:
        data, free = self.cuda_rigid_body_data.data.numpy(), slice(0, len(self.free))
        for i in self._changed_rows(self.cuda_rigid_body_data, free, slice(0, 7)):
            self.free[i].pose = sapien.Pose(data[i, :3], data[i, 3:7])
        for i in self._changed_rows(self.cuda_rigid_body_data, free, slice(7, 13)):
            if not self.free[i].kinematic:
                self.free[i].linear_velocity, self.free[i].angular_velocity = data[i, 7:10], data[i, 10:13]

    def gpu_apply_articulation_root_pose(self) -> None:
        for i in self._changed_rows(self.cuda_rigid_body_data, self.root_rows, slice(0, 7)):
            row = self.cuda_rigid_body_data.data[self.root_rows[i]].numpy()
            self.robots[i].root_pose = sapien.Pose(row[:3], row[3:7])
            self.robots[i].qvel = self.robots[i].qvel  # so that PhysX computes the links' velocities again

    def gpu_apply_articulation_root_velocity(self) -> None:
        for i in self._changed_rows(self.cuda_rigid_body_data, self.root_rows, slice(7, 13)):
            row = self.cuda_rigid_body_data.data[self.root_rows[i]].numpy()
            self.robots[i].root_linear_velocity, self.robots[i].root_angular_velocity = row[7:10], row[10:13]

    def _apply_joints(self, name: str) -> None:
        array = getattr(self, f"cuda_articulation_{name}")
        for i in self._changed_rows(array):
            setattr(self.robots[i], name, array.data[i, : self.robots[i].dof].numpy())

    gpu_apply_articulation_qpos = partialmethod(_apply_joints, "qpos")
    gpu_apply_articulation_qvel = partialmethod(_apply_joints, "qvel")
    gpu_apply_articulation_qf = partialmethod(_apply_joints, "qf")

    def _apply_targets(self, name: str, setter: str) -> None:
        array = getattr(self, f"cuda_articulation_{name}")
        changes = array.find_changes().tolist()
        targets = array.data.tolist() if changes else None
        for i, j in changes:
            getattr(self.joints[i][j], setter)(targets[i][j])
            self.driven.add(i)

    gpu_apply_articulation_target_position = partialmethod(_apply_targets, "target_qpos", "set_drive_target")
    gpu_apply_articulation_target_velocity = partialmethod(_apply_targets, "target_qvel", "set_drive_velocity_target")

    def gpu_apply_rigid_dynamic_force(self) -> None:
        """Forces act once, at the centre of mass."""
        for body, force in zip(self.free + self.links, self.cuda_rigid_body_force.data):
            if force.any():
                body.add_force_at_point(force[:3].numpy(), (body.pose * body.cmass_local_pose).p)
        self.cuda_rigid_body_force.data.zero_()

    def gpu_create_contact_body_impulse_query(self, bodies: list) -> SimpleNamespace:
        """For the net impulse on each of these bodies or, of each pair, on the first body from the second."""
        return SimpleNamespace(bodies=bodies, cuda_impulses=Array(len(bodies), 3))

    def gpu_query_contact_body_impulses(self, query) -> None:
        if self.contacts is None:  # the simulation is asked once a step, and only if the task asks
            self.contacts = defaultdict(list)
            for contact in [contact for system in self.systems for contact in system.get_contacts()]:
                a, b = contact.bodies
                for key, sign in ((a, 1), (b, -1), ((a, b), 1), ((b, a), -1)):
                    self.contacts[key].append((contact, sign))
        for row, key in zip(query.cuda_impulses.data.zero_().numpy(), query.bodies):
            for contact, sign in self.contacts.get(key, ()):
                for point in contact.points:
                    row += sign * point.impulse

    gpu_create_contact_pair_impulse_query = gpu_create_contact_body_impulse_query
    gpu_query_contact_pair_impulses = gpu_query_contact_body_impulses

    _nothing = lambda self: None  # for what a CPU simulation need not do
    gpu_fetch_articulation_target_qpos = gpu_fetch_articulation_target_qvel = _nothing
    gpu_update_articulation_kinematics = sync_poses_gpu_to_cpu = _nothing


class BatchedRenderer:
    """Stands for SAPIEN's RenderSystemGroup and its camera groups: renders all scenes one after the other."""

    def __init__(self, scenes: list[sapien.Scene], cameras: tuple = ()):
        self.scenes, self.cameras = scenes, cameras
        self.states, self.pictures = [None] * len(cameras), [{} for _ in cameras]

    def update_render(self) -> None:
        for scene in self.scenes:
            scene.update_render()

    def create_camera_group(self, cameras: list, names: list[str]) -> "BatchedRenderer":
        return BatchedRenderer(self.scenes, cameras)

    def take_picture(self) -> None:
        """A partial reset asks for pictures of all scenes: those that it left alone keep theirs."""
        for i, camera in enumerate(self.cameras):
            scene = camera.entity.scene
            state = scene.batch.num_steps, scene.pack_poses()
            if self.states[i] != state:
                camera.take_picture()
                self.states[i], self.pictures[i] = state, {}

    def get_picture_cuda(self, name: str) -> SimpleNamespace:
        for camera, pictures in zip(self.cameras, self.pictures):
            if name not in pictures:
                pictures[name] = camera.get_picture(name)
        batch = common.to_tensor(np.stack([pictures[name] for pictures in self.pictures]))
        return SimpleNamespace(torch=lambda: batch)


def is_batch(scene: ManiSkillScene) -> bool:
    return scene.gpu_sim_enabled and scene.device.type == "cpu"


def batch_on_cpu() -> None:
    """Let gym.make(task, num_envs=N, sim_backend="physx_cpu") build a batch, with the contract of physx_cuda.
    ManiSkill's single environments, and its batches on a GPU, stay as they are."""
    setup_scene, reset = sapien_env.BaseEnv._setup_scene, sapien_env.BaseEnv.reset
    build_physx_component = ActorBuilder.build_physx_component

    def setup_batch(env):
        setup_scene(env)
        scenes = env.scene.sub_scenes
        if env.num_envs == 1 or env._sim_device.is_cuda():
            return
        while len(scenes) < env.num_envs:  # ManiSkill's simulation on a CPU has one
            setup_scene(env)
            scenes = scenes + env.scene.sub_scenes
        env.scene = ManiSkillScene(scenes, sim_config=env.sim_config, device=env.device, backend=env.backend)
        env.scene.px, env.scene.gpu_sim_enabled = BatchedPhysx(scenes), True
        env.scene.render_system_group = BatchedRenderer(scenes)

    def reset_from_own_seeds(env, seed=None, options=None):
        if env._last_obs is None and env.num_envs > 1:  # the environment is being built
            seed = [env.build_seed + i for i in range(env.num_envs)]
        return reset(env, seed=seed, options=options)

    def build_with_planes(builder, *args, **kwargs):
        """On a GPU the first environment's ground serves all. Here each environment needs its own."""
        if is_batch(builder.scene):
            builder._plane_collision_poses.clear()
        return build_physx_component(builder, *args, **kwargs)

    sapien_env.CPU_SIM_BACKENDS = set()  # those for which ManiSkill refuses more than one environment
    sapien_env.BaseEnv._setup_scene, sapien_env.BaseEnv.reset = setup_batch, reset_from_own_seeds
    sapien_env.BaseEnv.build_seed = 2022  # ManiSkill's; make_envs sets others, so that actors build other objects
    ActorBuilder.build_physx_component = build_with_planes


def find_rows() -> None:
    """ManiSkill asks bodies and articulations for their rows in the tensors, and links for their velocities."""
    body_data = PhysxRigidBodyComponentStruct._body_data

    def body_data_with_velocities(struct):
        if isinstance(struct, Link) and is_batch(struct.scene):
            struct.px.read_velocities(struct._objs)
        return body_data.fget(struct)

    def find_row(index, component):
        scene = getattr(component, "root", component).entity.scene  # an articulation is where its root is
        return scene.batch.row[component] if hasattr(scene, "batch") else index.fget(component)

    PhysxRigidBodyComponentStruct._body_data = property(body_data_with_velocities)
    physx.PhysxArticulation.gpu_index = property(partial(find_row, physx.PhysxArticulation.gpu_index))
    for cls in (physx.PhysxRigidDynamicComponent, physx.PhysxArticulationLinkComponent):
        cls.gpu_pose_index = property(partial(find_row, cls.gpu_pose_index))


def solve_inverse_kinematics_of_batches() -> None:
    """On a CPU, ManiSkill's solver handles one environment, and wants a pose to reach instead of a change of pose."""
    set_action, compute_ik = PDEEPosController.set_action, Kinematics.compute_ik

    def set_action_by_pose(controller, action):
        scene = controller.scene
        if is_batch(scene):
            controller.scene = SimpleNamespace(gpu_sim_enabled=False, num_envs=scene.num_envs)
        set_action(controller, action)
        controller.scene = scene

    def compute_ik_by_row(kinematics, pose, q0, **kwargs):
        if kinematics.use_gpu_ik or len(q0) == 1:
            return compute_ik(kinematics, pose, q0, **kwargs)
        controlled = kinematics.active_joint_indices
        solutions = [compute_ik(kinematics, pose[i : i + 1], q0[i : i + 1]) for i in range(len(q0))]
        return torch.cat([q0[i, controlled][None] if x is None else x for i, x in enumerate(solutions)])

    PDEEPosController.set_action, Kinematics.compute_ik = set_action_by_pose, compute_ik_by_row


batch_on_cpu()
find_rows()
solve_inverse_kinematics_of_batches()


# ----- Actors: processes that simulate on a CPU -----------------------------------------------------------------------
def num_scenes(args: Args) -> int:
    """Number of environments that all actors build together."""
    num_eval_envs = args.num_eval_envs
    if args.num_eval_steps is None:
        num_eval_envs = min(num_eval_envs, args.num_eval_episodes)
    return num_eval_envs if args.evaluate else args.num_envs + num_eval_envs


def even_share(total: int, index: int, shares: int) -> range:
    """Which of `total` things belong to one of several equal shares."""
    return range(math.ceil(total * index / shares), math.ceil(total * (index + 1) / shares))


class Actor:
    """The environments of one process: its share of training, and its share of each evaluation."""

    def __init__(self, args: Args, index: int, folder: Optional[Path] = None):
        self.args, self.index = args, index
        seed_all(args.seed, RANK, index)  # some tasks draw random numbers while they are built
        self.env_idx = even_share(args.num_envs, index, args.num_actors)
        eval_episodes = even_share(args.num_eval_episodes, index, args.num_actors)
        num_eval_envs = len(even_share(args.num_eval_envs, index, args.num_actors))
        if args.num_eval_steps is None:
            num_eval_envs = min(num_eval_envs, len(eval_episodes))
        self.envs = None
        if not args.evaluate:
            seed = int(np.random.SeedSequence([args.seed, RANK, index]).generate_state(1)[0]) // 2
            self.envs = make_envs(args, len(self.env_idx), seed)
            self.rebuild_freq = training_rebuild_freq(args, self.envs)
            self.staggers = args.staggered_resets and args.partial_reset and find_reset_error(self.envs) is None
        record = dict(output_dir=str(folder), trajectory_name=f"trajectory_{index}") if args.save_trajectory else None
        seed = args.eval_seed + RANK * args.num_eval_episodes + eval_episodes.start
        self.eval_envs = make_envs(args, max(1, num_eval_envs), seed, evaluation=True, record=record)
        self.separately = is_batch(self.eval_envs.base_env.scene) and find_reset_error(self.eval_envs) is None

    def receive(self, agent, storage: dict) -> None:
        """Take the agent, and the storage to write into: this actor's columns."""
        columns = slice(self.env_idx.start, self.env_idx.stop)
        self.agent, self.act, self.get_value = agent, agent.get_action_and_value, agent.get_value
        self.storage = tree_map(lambda x: x[:, columns], storage)

    @torch.no_grad()
    def rollout(self, iteration: int, is_first: bool) -> dict:
        """Returns the sums that `rollout` returns. All its noise follows from the seed, the iteration and the actor."""
        seed_all(self.args.seed, iteration, RANK, self.index)
        if is_first or iteration % self.rebuild_freq == 0:
            seeds = np.random.SeedSequence([self.args.seed, iteration, RANK]).generate_state(self.args.num_envs)
            seeds = (seeds[self.env_idx] // 2 + 2**31).tolist()  # evaluation seeds are below
            self.obs, _ = self.envs.reset(seed=seeds, options=dict(reconfigure=self.rebuild_freq < math.inf))
            limit = find_max_episode_steps_value(self.envs)
            if self.staggers and limit:
                # these episodes count as begun earlier, in the log as well (Bharthulwar et al. 2025, arXiv 2511.21011)
                self.envs.base_env.elapsed_steps.random_(limit)
        self.obs, sums = rollout(self.agent, self.envs, self.storage, self.obs, self.args, self.act, self.get_value)
        if (iteration + 1) % self.rebuild_freq == 0:
            self.finish_all_episodes(sums)
        return sums

    def finish_all_episodes(self, sums: dict) -> None:
        """Play the running episodes to their ends, so that new scenes cut none. PPO does not learn from these steps."""
        running = self.envs.base_env.elapsed_steps > 0
        for _ in range(evaluation_size(self.envs, self.args)[1]):
            if not running.any():
                break
            action = self.agent.clip_action(self.act(self.obs)[0])
            self.obs, _, terminated, truncated, infos = self.envs.step(action)
            ended = running & (terminated | truncated)
            if ended.any():
                add_episodes(sums, infos["final_info"], ended)
            running = running & ~ended

    def evaluate(self, num_episodes: int, seed: int) -> dict[str, torch.Tensor]:
        """This actor's share of the episodes from `seed` on."""
        share = even_share(num_episodes, self.index, self.args.num_actors)
        return evaluate(self.agent, self.eval_envs, self.args, len(share), seed + share.start, self.separately)

    def close(self) -> None:
        for envs in (self.envs, self.eval_envs):
            if envs is not None:
                envs.close()


def run_in_actor(method: str, *arguments) -> bytes:
    """Runs in an actor's process. The first call is "build", with the arguments of Actor. Returns the pickled result:
    tensors themselves would go through shared memory, and a process that is killed meanwhile leaves a file there."""
    global ACTOR
    if method != "build":
        return pickle.dumps(getattr(ACTOR, method)(*arguments))
    torch.set_num_threads(1)
    os.environ["CUDA_VISIBLE_DEVICES"] = ""  # ManiSkill would save the random state of each GPU, and take memory there
    threading.Thread(target=end_with_main_process, daemon=True).start()
    ACTOR = Actor(*arguments)
    return pickle.dumps(None)


def end_with_main_process() -> None:
    mp.parent_process().join()
    os._exit(1)


class Actors:
    """Actor 0 in this process and, with CPU simulation, each further one in a process of its own."""

    def __init__(self, args: Args, trajectory_dir: Path, closing: contextlib.ExitStack):
        if hasattr(psutil, "RLIMIT_NOFILE"):  # Linux: torch sends each actor its tensors as open files
            _, highest = psutil.Process().rlimit(psutil.RLIMIT_NOFILE)
            psutil.Process().rlimit(psutil.RLIMIT_NOFILE, (highest, highest))
        # Processes inherit this: they ignore these signals, and the main process ends them.
        handlers = set_handlers(dict.fromkeys(STOP_SIGNALS, signal.SIG_IGN))
        self.pools = [ProcessPoolExecutor(1, mp.get_context("spawn")) for _ in range(1, args.num_actors)]
        closing.callback(self.close)
        further = enumerate(self.pools, start=1)
        self.built = [pool.submit(run_in_actor, "build", args, i, trajectory_dir) for i, pool in further]
        set_handlers(handlers)
        self.args, self.actor0 = args, Actor(args, 0, trajectory_dir)
        if not args.evaluate:
            check_task(args, self.actor0.envs)
        envs = self.actor0.eval_envs
        self.device, self.spaces = envs.device, (envs.single_observation_space, envs.single_action_space)
        self.num_eval_episodes, _ = evaluation_size(envs, args)

    def distribute(self, agent: nn.Module, device: torch.device) -> dict:
        """Give all actors the agent and, to train, a storage to write into: the tensors themselves, or a copy if the
        learner is on another device. Returns the learner's storage: tensors (num_steps, num_envs, ...)."""
        args, has_copies = self.args, self.device.type != device.type
        self.learner, self.agent = agent, copy.deepcopy(agent).to(self.device) if has_copies else agent
        self.storage = {} if args.evaluate else make_storage(agent, *self.spaces, args, self.device)
        self.learner_storage = tree_map(lambda x: x.to(device), self.storage) if has_copies else self.storage
        if self.pools:
            for x in tree_leaves([self.agent.state_dict(), self.storage]):
                x.share_memory_()
        self.call("receive", self.agent, self.storage)
        self.built = []
        if args.compile:  # only now: a compiled function cannot be sent to other actors
            for network in {self.learner, self.agent}:  # on one device they are the same
                network.get_action_and_value = torch.compile(network.get_action_and_value, dynamic=False)
        self.actor0.act = CudaGraph(self.agent.get_action_and_value, args, self.device)
        self.actor0.get_value = CudaGraph(self.agent.get_value, args, self.device)
        return self.learner_storage

    def call(self, method: str, *arguments) -> list:
        """Call a method of all actors at the same time; returns their results in order."""
        try:
            futures = [pool.submit(run_in_actor, method, *arguments) for pool in self.pools]
            own = getattr(self.actor0, method)(*arguments)
            return [own, *(pickle.loads(future.result()) for future in self.built + futures)]
        except BrokenProcessPool:
            raise RunError("the process of an actor died (killed? out of memory?)") from None

    def rollout(self, iteration: int, is_first: bool) -> list[dict]:
        """Fill the storage; returns sums over the episodes that ended, of each actor."""
        self.agent.load_state_dict(self.learner.state_dict())  # it may be a copy on another device
        sums_of_actors = self.call("rollout", iteration, is_first)
        floats = [x for x in tree_leaves(self.storage) if x.is_floating_point()]
        is_broken = torch.stack([~x.isfinite().reshape(*x.shape[:2], -1).all(2).all(0) for x in floats]).any(0)
        broken = all_gather([i for i, x in enumerate(is_broken.tolist()) if x])  # a list of each process
        if any(broken):  # all processes stop together
            raise RunError(f"the rollout has NaN or infinity in environments {', '.join(map(str, broken))}")
        if self.learner_storage is not self.storage:
            tree_map(lambda new, old: new.copy_(old), self.learner_storage, self.storage)
        return sums_of_actors

    def evaluate(self, seed: int) -> dict[str, torch.Tensor]:
        """The episodes from `seed` on, of all actors and processes: see the function `evaluate`."""
        self.agent.load_state_dict(self.learner.state_dict())
        seed += RANK * self.num_eval_episodes
        return concatenate(all_gather(concatenate(self.call("evaluate", self.num_eval_episodes, seed))))

    def close(self) -> None:
        if sys.exc_info()[0] is None:
            self.call("close")
        else:  # whatever they are doing
            for process in mp.active_children():
                process.kill()
        for pool in self.pools:  # it waits: a thread of the pool that outlives the run may print a traceback
            pool.shutdown()


def make_storage(agent, obs_space, action_space, args: Args, device: torch.device) -> dict:
    """Buffers of a rollout, (num_steps, num_envs, ...) each; observations are a tensor or a dict, like their space.
    Refuses what does not fit: Linux would end the run without a word, or with 'Bus error' alone."""
    learner_device = agent.actor_logstd.device

    def empty(shape=(), dtype="float32"):
        return torch.empty(args.num_steps, args.num_envs, *shape, dtype=getattr(torch, dtype), device="meta")

    storage = {name: empty() for name in ("logprobs", "rewards", "dones", "values", "next_values")}
    obs_spaces = getattr(obs_space, "spaces", obs_space)  # of a dict, or of one tensor
    storage["obs"] = tree_map(lambda space: empty(space.shape, space.dtype.name), obs_spaces)
    storage["actions"] = empty(action_space.shape)

    stored = sum(x.numel() * x.element_size() for x in tree_leaves(storage))
    num_rows = args.batch_size // args.num_minibatches + 2 * args.num_envs  # a gradient, acting, final values
    weights = sum(x.numel() * x.element_size() for x in agent.parameters())
    used = stored + num_rows * layers_size(agent, storage) + 3 * weights  # gradients, and Adam's two moments
    places = []
    if device.type == "cpu":
        places.append(("memory", psutil.virtual_memory().available / LOCAL_WORLD_SIZE, used))
    if args.num_actors > 1 and Path("/dev/shm").exists():
        free = shutil.disk_usage("/dev/shm").free / LOCAL_WORLD_SIZE
        places.append(("shared memory (docker run --shm-size; --num_actors 1 needs none)", free, stored))
    if learner_device.type == "cuda":
        places.append(("the GPU's memory", torch.cuda.mem_get_info(learner_device)[0], used))
    for place, free, needed in places:
        if needed > 0.9 * free:
            remedy = f"--num_steps {args.num_steps // 2}, more --num_minibatches or smaller images"
            needed, free = (f"{size / 2**20:,.0f} MiB" for size in (needed, free))
            fail(f"training needs {needed}, and {free} of {place} are free: try {remedy}")
    return tree_map(lambda x: torch.zeros_like(x, device=device), storage)


def layers_size(agent, storage: dict) -> float:
    """Bytes that the layers of the network keep for the gradient of one observation, measured with two."""
    agent, kept = copy.deepcopy(agent).cpu(), []
    rows = [tree_map(lambda x: torch.zeros(2, *x.shape[2:], dtype=x.dtype), storage[k]) for k in ("obs", "actions")]
    with torch.autograd.graph.saved_tensors_hooks(kept.append, lambda x: x):  # no gradient is computed
        agent.get_action_and_value(*rows)
    weights = {x.untyped_storage() for x in agent.parameters()}
    storages = {x.untyped_storage() for x in kept}
    return sum(x.nbytes() for x in storages if x not in weights) / 2


# ----- Checkpoints ----------------------------------------------------------------------------------------------------
def load_checkpoint(path: str | Path) -> dict:
    """What `Checkpoints` wrote, and its path. A run folder stands for its last.pt."""
    path = Path(path) / "last.pt" if Path(path).is_dir() else Path(path)
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        if not {"agent", "optimizer", "args", "obs_spaces", "finished"} <= checkpoint.keys():
            raise ValueError("it was written by another version of this script")
    except Exception as error:
        fail(f"{path} is not a readable checkpoint: {str(error).partition('. ')[0] or 'it is empty'}")
    return checkpoint | dict(path=str(path))


def make_agent(obs_space, action_space, args: Args, checkpoint: dict) -> Agent:
    """An agent with random weights or those of the checkpoint, if there is one: the same in all processes."""
    agent = Agent(obs_space, action_space, args)
    if checkpoint:
        try:
            bounds = dict(action_low=agent.action_low, action_high=agent.action_high)
            agent.load_state_dict(checkpoint["agent"] | bounds)  # those of the checkpoint may be of another controller
        except RuntimeError as error:
            fail(f"{checkpoint['path']} is of another network or task: {error}")
    agent.load_state_dict(all_gather(agent.state_dict())[0])  # machines may turn a seed into different weights
    return agent


def load_agent(path: str | Path) -> tuple[Agent, Args]:
    """A trained policy for your own program: the agent, on the CPU, and the flags of its run.

    agent.get_action(obs) returns the actions (batch, act_dim) for observations as `Agent` describes them.
    make_envs(args, num_envs, seed, evaluation=True) builds environments that fit."""
    checkpoint = load_checkpoint(path)
    args, weights = Args(**checkpoint["args"]), checkpoint["agent"]
    spaces = {k: gym.spaces.Box(0, 1, shape, dtype) for k, (shape, dtype) in checkpoint["obs_spaces"].items()}
    obs_space = spaces["obs"] if "obs" in spaces else gym.spaces.Dict(spaces)
    action_space = gym.spaces.Box(weights["action_low"].numpy(), weights["action_high"].numpy())
    return make_agent(obs_space, action_space, args, checkpoint).eval(), args


class Checkpoints:
    """Writes last.pt, numbered checkpoints and best.pt. Closing it writes last.pt, however the run ends."""

    def __init__(self, args: Args, run_dir: Path, resumed: dict, agent, optimizer, obs_space, logger: "Logger"):
        self.args, self.run_dir, self.logger = args, run_dir, logger
        self.saved = dict(agent=agent, optimizer=optimizer)
        self.run_info = dict(args=asdict(args), world_size=WORLD_SIZE, wandb_id=logger.wandb_id)
        obs_spaces = getattr(obs_space, "spaces", {"obs": obs_space})  # of a dict of images and state, or of a tensor
        self.run_info["obs_spaces"] = {k: (tuple(x.shape), x.dtype.name) for k, x in obs_spaces.items()}
        best = run_dir / "best.pt"  # only the first process has it, and it may be newer than the checkpoint
        best_score = load_checkpoint(best)["best_score"] if resumed and best.exists() else [-math.inf]
        self.contents, self.best_score = {}, all_gather(best_score)[0]

    def take(self, iteration: int, global_step: int) -> None:
        """Copy the state from which a resumed run goes on, and write it if that is due."""
        copied = lambda x: x.to("cpu", copy=True, non_blocking=True) if isinstance(x, torch.Tensor) else x
        state = {name: tree_map(copied, x.state_dict()) for name, x in self.saved.items()}
        if self.saved["agent"].actor_logstd.is_cuda:
            torch.cuda.synchronize()  # the host waits once, not for each tensor
        progress = dict(iteration=iteration, global_step=global_step, finished=False, best_score=self.best_score)
        self.contents = state | progress | self.run_info | dict(metrics_size=self.logger.file.tell())
        if iteration % self.args.checkpoint_freq == 0:
            self.write("last.pt")
        if self.args.save_freq and iteration > 0 and iteration % self.args.save_freq == 0:
            self.write(f"iteration_{iteration}.pt")

    def update_best(self, score: list[float]) -> None:
        """Write best.pt if this score is the best so far: of two scores, the first number that differs decides."""
        if score > self.best_score and all(map(math.isfinite, score)):
            self.best_score = self.contents["best_score"] = score
            self.write("best.pt")

    def write(self, name: str) -> None:
        """Write another file, then rename it: at any moment there is the old checkpoint or the new one, whole."""
        if self.args.save_model and RANK == 0:
            buffer = io.BytesIO()  # while torch writes to a file, it turns a signal into another error
            torch.save(self.contents, buffer)
            with open(self.run_dir / name.replace(".pt", ".tmp"), "wb") as file:
                file.write(buffer.getbuffer())
                file.flush()
                os.fsync(file.fileno())
            os.replace(file.name, self.run_dir / name)

    def close(self) -> None:
        # with exact_resume, a run goes on from every checkpoint_freq-th iteration only
        if self.contents and (self.contents["finished"] or not self.args.exact_resume):
            self.write("last.pt")


# ----- Logging --------------------------------------------------------------------------------------------------------
class Logger:
    """metrics.jsonl, TensorBoard, Weights & Biases, the learning curve, and the progress bar or lines instead."""

    def __init__(self, args: Args, run_dir: Path, device: torch.device, resumed: dict):
        from torch.utils.tensorboard import SummaryWriter  # slow to import, and the other actors need none

        run_dir.mkdir(parents=True, exist_ok=True)
        self.run_dir, self.wandb_run, self.last_line = run_dir, None, time.monotonic()
        self.lock = filelock.FileLock(run_dir / ".lock")
        try:
            self.lock.acquire(timeout=0)
        except filelock.Timeout:
            fail(f"another process is writing to {run_dir}: stop it first, or choose another --exp_name")
        hardware = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{num_cores()} CPU core(s)"
        packages = ("mani-skill", "sapien", "torch", "gymnasium", "numpy")
        versions = {"python": platform.python_version()} | {p: importlib.metadata.version(p) for p in packages}
        run_info = dict(args=asdict(args), versions=versions, device=hardware, command=shlex.join(sys.argv))
        (run_dir / "args.json").write_text(json.dumps(run_info, indent=2) + "\n")
        if args.track and RANK == 0:
            import wandb

            self.wandb_run = wandb.init(
                project=args.wandb_project_name, entity=args.wandb_entity, group=args.wandb_group, name=run_dir.name,
                config=run_info, save_code=True, id=resumed.get("wandb_id"), resume="allow", sync_tensorboard=True,
            )  # fmt: skip
        path = run_dir / "metrics.jsonl"  # only now: where it exists, a run has begun
        path.touch()
        os.truncate(path, min(path.stat().st_size, resumed.get("metrics_size", 0)))  # later steps are done again
        self.file = open(path, "a")
        self.wandb_id = self.wandb_run.id if self.wandb_run else resumed.get("wandb_id")
        global_step = resumed.get("global_step", 0)
        self.writer = SummaryWriter(str(run_dir), purge_step=global_step + 1 if resumed else None)
        self.bar = tqdm(
            total=args.num_iterations * args.batch_size, initial=global_step, dynamic_ncols=True,
            disable=None if RANK == 0 else True,  # None: no bar where there is no terminal
            bar_format="{percentage:3.0f}%|{bar:20}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]{postfix}",
        )  # fmt: skip
        tqdm.write(f"{args.env_id}: {args.num_envs} environments on {args.sim_backend}, learning on {hardware}")
        tqdm.write(f"resuming {run_dir} at step {global_step:,}" if resumed else f"writing to {run_dir}")

    def log(self, kind: str, global_step: int, metrics: dict) -> None:
        finite = {k: v for k, v in metrics.items() if math.isfinite(v)}
        self.file.write(json.dumps(dict(kind=kind, global_step=global_step, time=time.time(), **finite)) + "\n")
        self.file.flush()
        for key, value in finite.items():
            self.writer.add_scalar(f"{kind}/{key}", value, global_step)
        names = {"success_once": "success", "success_at_end": "at end", "return": "return", "episode_len": "length"}
        summary = [f"{name} {metrics[key]:.3g}" for key, name in names.items() if key in metrics]
        if kind == "eval":
            tqdm.write(f"step {global_step:>9,}  evaluation: {', '.join(summary)}")
            if global_step > 0:
                plot_learning_curve(self.run_dir)
                gc.collect()  # figures contain reference cycles, which would keep megabytes
            return
        status = ", ".join([f"{metrics['sps']:,.0f} steps/s", *summary])
        self.bar.set_postfix_str(status, refresh=False)
        self.bar.update(global_step - self.bar.n)
        if self.bar.disable and time.monotonic() - self.last_line > 10:  # no terminal
            print(f"step {global_step:>9,}  training: {status}", flush=True)
            self.last_line = time.monotonic()

    def close(self) -> None:
        for resource in (self.bar, self.writer, self.file):
            resource.close()
        if self.wandb_run:
            self.wandb_run.finish(exit_code=int(sys.exc_info()[0] is not None))
        self.lock.release()


def plot_learning_curve(run_dir: Path) -> None:
    """Draw learning_curve.png from metrics.jsonl: success at some step and at the last one, if the task has it, and
    return over steps."""
    from matplotlib.figure import Figure

    rows = [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
    keys = [key for key in ("success_once", "success_at_end", "return") if any(key in row for row in rows)]
    figure = Figure(figsize=(5 * len(keys), 3.5), layout="constrained")
    for axis, key in zip(figure.subplots(1, len(keys), squeeze=False)[0], keys):
        for kind, style in (("train", dict(alpha=0.4)), ("eval", dict(marker="o", markersize=3))):
            points = [(row["global_step"], row[key]) for row in rows if row["kind"] == kind and key in row]
            axis.plot(*zip(*points or [(0, math.nan)]), label=kind, **style)
        axis.set(title=key, xlabel="environment steps")
        axis.legend()
    figure.savefig(run_dir / "learning_curve.png", dpi=120)


def average_episodes(sums_of_actors: list[dict]) -> dict:
    """Means over the episodes that ended in all actors and processes, and their number."""
    total = Counter()
    on_host = [dict(zip(x, torch.stack([*x.values()]).tolist())) for x in sums_of_actors]
    for sums in sum(all_gather(on_host), []):
        total.update(sums)
    num_episodes = int(total.pop("num_episodes"))
    return {key: x / num_episodes for key, x in total.items()} | dict(num_episodes=num_episodes)


# ----- CUDA graphs, several processes ---------------------------------------------------------------------------------
class CudaGraph:
    """A function that is launched as one CUDA graph: small networks compute faster than Python launches their kernels.

    The function takes nothing or an observation, never makes the host wait, and keeps its tensors in place. The next
    call overwrites what it returned. Three calls warm up on another stream, the fourth captures, all others replay."""

    def __init__(self, function, args: Args, device: torch.device):
        self.enabled = args.cudagraphs and device.type == "cuda"
        self.function, self.num_calls, self.graph = function, 0, None

    def __call__(self, *obs):
        if not self.enabled:
            return self.function(*obs)
        self.num_calls += 1
        if self.num_calls == 1:
            self.obs, self.stream = copy.deepcopy(obs), torch.cuda.Stream()
        for old, new in zip(tree_leaves(self.obs), tree_leaves(obs)):
            old.copy_(new)
        if self.num_calls <= 3:
            self.stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(self.stream):
                self.result = self.function(*self.obs)
            torch.cuda.current_stream().wait_stream(self.stream)
            return self.result
        if self.graph is None:
            gc.collect()  # memory of the GPU that is freed during the capture would end it
            self.graph = torch.cuda.CUDAGraph()
            try:  # other threads, such as NCCL's, go on
                with torch.cuda.graph(self.graph, stream=self.stream, capture_error_mode="thread_local"):
                    self.result = self.function(*self.obs)
            except torch.OutOfMemoryError:
                raise
            except RuntimeError as error:
                name = self.function.__name__
                raise RunError(f"{name} cannot be a CUDA graph, --no-cudagraphs does without: {error}") from None
        self.graph.replay()
        return self.result

    def close(self) -> None:
        self.graph = self.function = None  # NCCL waits for graphs that contain its operations


def start_processes(args: Args, closing: contextlib.ExitStack) -> tuple[Args, Args, torch.device, Path]:
    """Connect the processes of torchrun; returns the flags of all, the flags of this one, its device and its folder."""
    torch.backends.cudnn.deterministic = args.torch_deterministic
    device = choose_device(local_args(args))
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if WORLD_SIZE > 1:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
        closing.callback(dist.destroy_process_group)
    run_dir = find_run_dir(args)
    if RANK > 0:  # only the first process writes the run
        run_dir = Path(closing.enter_context(tempfile.TemporaryDirectory()))
    args = all_gather(args)[0]  # all need the same, and defaults depend on the machine
    return args, local_args(args), device, run_dir


def local_args(args: Args) -> Args:
    """The flags for one of the processes that torchrun started: its part of the environments, on its own GPU."""
    if WORLD_SIZE == 1:
        return args
    names = ("num_envs", "num_actors", "num_eval_envs", "num_eval_episodes")
    local = replace(args, **{name: math.ceil(getattr(args, name) / WORLD_SIZE) for name in names})
    if args.sim_backend == "physx_cuda":
        local.sim_backend = f"physx_cuda:{LOCAL_RANK}"
    if RANK > 0:  # only the first process writes
        local.save_trajectory = local.capture_video = local.save_train_video_freq = False
    return local


def all_reduce_mean(x: torch.Tensor) -> torch.Tensor:
    """Mean of a tensor over all processes, in place."""
    if WORLD_SIZE > 1:
        dist.all_reduce(x)
        x /= WORLD_SIZE
    return x


def average_gradients(agent: nn.Module) -> None:
    """Average all gradients over all processes, in one message."""
    if WORLD_SIZE > 1:
        grads = [p.grad for p in agent.parameters() if p.grad is not None]
        means = all_reduce_mean(torch.cat([grad.flatten() for grad in grads])).split([grad.numel() for grad in grads])
        for grad, mean in zip(grads, means):
            grad.copy_(mean.view(grad.shape))


def all_gather(x) -> list:
    """What each process has, in the order of their ranks."""
    everything = [x] * WORLD_SIZE
    if WORLD_SIZE > 1:
        dist.all_gather_object(everything, x)
    return everything


def num_cores() -> int:
    """CPU cores for this process."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with contextlib.suppress(OSError, ValueError):  # the quota of a container; "max": it has none
        quota, period = map(int, Path("/sys/fs/cgroup/cpu.max").read_text().split())
        cores = min(cores, math.ceil(quota / period))
    return max(1, cores // LOCAL_WORLD_SIZE)


# ----- Command line ---------------------------------------------------------------------------------------------------
def fail(message: str) -> NoReturn:
    """Refuse bad input: one line, exit code 2."""
    print(f"{SCRIPT.name}: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(2)


class RunError(RuntimeError):
    """Ends a run with one line, without a traceback."""


def parse_args(argv: list[str]) -> Args:
    """Defaults depend on the simulation; a checkpoint brings its task and network, a run to resume all its flags."""
    description = f"{__doc__.splitlines()[0]} The defaults are those of this machine."
    parse = partial(tyro.cli, Args, prog=SCRIPT.name, description=description)
    given, default = parse(args=[arg for arg in argv if arg not in ("-h", "--help")]), Args()
    if choose_backend(given) == "physx_cpu":
        num_envs = max(CPU_ENVS_PER_CORE * num_cores(), MIN_CPU_ENVS // WORLD_SIZE)
        num_envs = min(num_envs, MAX_CPU_ENVS // WORLD_SIZE) * WORLD_SIZE
        default = replace(default, **CPU_DEFAULTS, num_envs=num_envs, num_eval_envs=num_envs)
    default.num_envs -= default.num_envs % WORLD_SIZE
    if given.evaluate and given.checkpoint is None:
        fail("--evaluate needs --checkpoint runs/NAME/best.pt")
    if given.resume is not None and (given.evaluate or given.checkpoint):
        fail("--resume continues a run: leave out --evaluate and --checkpoint")
    path = given.checkpoint if given.resume is None else given.resume
    if path is not None:
        checkpoint = load_checkpoint(path)
        run, flags = checkpoint["args"], FIXED_FLAGS if given.resume is None else asdict(default)
        default = replace(default, **{k: run[k] for k in flags if k in run})
    args = parse(args=argv, default=default)
    args.sim_backend = choose_backend(args)
    if given.resume is not None and args.sim_backend != run["sim_backend"]:
        args.num_actors = given.num_actors  # a GPU has one, a CPU one a core
    if args.num_steps is None:
        batch_size = CPU_BATCH_SIZE if args.sim_backend == "physx_cpu" else GPU_BATCH_SIZE
        args.num_steps = max(5, batch_size // max(1, args.num_envs))
    if args.total_timesteps is None:
        args.total_timesteps = NUM_ITERATIONS * args.batch_size
    if args.num_actors is None:
        args.num_actors = WORLD_SIZE
        if args.sim_backend == "physx_cpu":
            needed = math.ceil(num_scenes(args) / WORLD_SIZE / MAX_SCENES_OF_PROCESS)
            args.num_actors = max(1, min(max(num_cores(), needed) * WORLD_SIZE, args.num_envs))
    if args.exp_name is None:
        args.exp_name = f"{args.env_id.split(':')[-1]}__{SCRIPT.stem}__{args.seed}__{int(time.time())}"
    if args.resume is not None:
        args.resume = checkpoint["path"]
        check_resume(args, checkpoint)
    elif path is not None:
        args.checkpoint = checkpoint["path"]
    return args


def check_resume(args: Args, checkpoint: dict) -> None:
    """Refuse what a resumed run cannot change; print what it changes."""
    run = checkpoint["args"]
    for k in FIXED_FLAGS:
        if getattr(args, k) != run.get(k):
            fail(f"the run has --{k} {run.get(k)}, not {getattr(args, k)}: start a new run to change that")
    batch_size = run["num_envs"] * run["num_steps"]
    if args.batch_size != batch_size:
        fail(f"the run has {batch_size} steps an iteration, not {args.batch_size}: keep --num_envs x --num_steps")
    if (size := checkpoint["world_size"]) != WORLD_SIZE:
        fail(f"the run has {size} processes, not {WORLD_SIZE}: torchrun --nproc_per_node={size} ...")
    if args.num_iterations < checkpoint["iteration"]:
        fail(f"--total_timesteps {args.total_timesteps}: the run already has {checkpoint['global_step']} steps")
    if args.num_iterations == checkpoint["iteration"] and checkpoint["finished"]:
        print(f"the run is finished; to go on, give more than --total_timesteps {args.total_timesteps}")
        sys.exit(0)
    changes = [f"--{k} {v} (was {run[k]})" for k, v in asdict(args).items() if v != run.get(k, v) and k != "resume"]
    if changes:
        print(f"changed: {', '.join(changes)}")


def find_run_dir(args: Args) -> Path:
    checkpoint = args.resume or (args.checkpoint if args.evaluate else None)
    return Path(checkpoint).parent if checkpoint else Path("runs") / args.exp_name


def choose_backend(args: Args) -> str:
    backend = {"cpu": "physx_cpu", "gpu": "physx_cuda", "cuda": "physx_cuda"}.get(args.sim_backend, args.sim_backend)
    if backend == "auto":
        backend = "physx_cuda" if args.cuda and torch.cuda.is_available() else "physx_cpu"
    if backend == "physx_cuda" and WORLD_SIZE == 1:
        backend = "physx_cuda:0"  # without an index SAPIEN takes Vulkan's first device, torch takes CUDA's
    return backend


def choose_device(args: Args) -> torch.device:
    """Where the agent learns: on the GPU that simulates, else on any GPU, else on the CPU."""
    backend, _, index = args.sim_backend.partition(":")
    if backend == "physx_cuda" or args.cuda and torch.cuda.is_available():
        return torch.device(f"cuda:{index or LOCAL_RANK}")
    return torch.device("cpu")


def check(args: Args) -> None:
    """Refuse what cannot work, before anything is built or written."""
    for low, high, flags in LIMITS:
        for flag in flags.split():
            if getattr(args, flag) is not None and not low <= getattr(args, flag) <= high:
                fail(f"--{flag} {getattr(args, flag)}: must lie between {low:g} and {high:g}")
    if args.num_envs % WORLD_SIZE or args.num_actors % WORLD_SIZE:
        fail(f"--num_envs {args.num_envs}, --num_actors {args.num_actors}: not multiples of {WORLD_SIZE} processes")
    if args.num_actors > args.num_envs:
        fail(f"--num_actors {args.num_actors}: there are {args.num_envs} environments (--num_envs)")
    if args.batch_size < args.num_minibatches * WORLD_SIZE:
        fail(f"--num_minibatches {args.num_minibatches}: an iteration has {args.batch_size} steps")
    if args.num_iterations < 1 and not args.evaluate:
        fail(f"--total_timesteps {args.total_timesteps}: an iteration has --num_envs {args.num_envs} x --num_steps "
             f"{args.num_steps} = {args.batch_size} steps")  # fmt: skip
    if args.reconfiguration_freq and args.partial_reset and args.num_envs > args.num_actors:
        fail("--reconfiguration_freq rebuilds the environments of a batch together: it needs --no-partial_reset")
    if args.track and importlib.util.find_spec("wandb") is None:
        fail("--track needs Weights & Biases: pip install wandb")
    if WORLD_SIZE > 1 and args.evaluate:
        fail("--evaluate is for one process: leave out torchrun")
    run_dir = find_run_dir(args)
    if not (args.resume or args.evaluate) and os.path.exists(run_dir / "metrics.jsonl"):
        fail(f"{run_dir} holds a run: continue it with --resume {run_dir}, or choose another --exp_name")
    try:
        find_task(args.env_id)
    except KeyError:
        near = ", ".join(difflib.get_close_matches(args.env_id, REGISTERED_ENVS)) or "none"
        fail(f"--env_id {args.env_id}: no such task; similar: {near}; a task in your own file is module:{args.env_id}")
    except Exception as error:
        if not is_from_packages(error):  # a mistake in the task's module: show where
            raise
        fail(f"--env_id {args.env_id}: {describe(error)}")
    try:
        env_kwargs = dict(**json.loads(args.env_kwargs))
    except (ValueError, TypeError):
        fail(f"--env_kwargs must be a JSON object like '{{\"enhanced_determinism\": true}}', not {args.env_kwargs}")
    for k in env_kwargs:
        if hasattr(args, k):
            fail(f"--env_kwargs: {k} has its own flag: --{k}")
    check_simulation(args)
    check_observations(args)


def check_simulation(args: Args) -> None:
    """Refuse flags that do not fit the simulation, and a GPU that is not there or cannot be used."""
    on_gpu = args.sim_backend != "physx_cpu"
    if on_gpu and not args.cuda:
        fail(f"--no-cuda, and --sim_backend is {args.sim_backend}: give --sim_backend physx_cpu as well")
    if on_gpu and args.num_actors > WORLD_SIZE:
        fail(f"--num_actors {args.num_actors}: on a GPU one process simulates all environments")
    if not on_gpu and num_scenes(args) > args.num_actors * MAX_SCENES_OF_PROCESS:
        fail(f"--num_envs {args.num_envs}, --num_eval_envs {args.num_eval_envs}: on a CPU, one process simulates at "
             f"most {MAX_SCENES_OF_PROCESS} environments, and --num_actors is {args.num_actors}")  # fmt: skip
    if on_gpu and (args.shader or "").startswith("rt"):
        fail(f"--shader {args.shader}: ray tracing needs CPU simulation: --sim_backend physx_cpu")
    if on_gpu and args.exact_resume:
        fail("--exact_resume needs CPU simulation: --sim_backend physx_cpu")
    if WORLD_SIZE > 1 and ":" in args.sim_backend:
        fail(f"--sim_backend {args.sim_backend}: with torchrun each process takes its own GPU: physx_cuda")
    if args.cuda and 0 < torch.cuda.device_count() < LOCAL_WORLD_SIZE:
        fail(f"torchrun started {LOCAL_WORLD_SIZE} processes for {torch.cuda.device_count()} GPUs: each needs its own")
    if on_gpu or args.cuda and Path("/proc/driver/nvidia").exists():
        try:
            torch.zeros(1, device=choose_device(local_args(args)) if on_gpu else f"cuda:{LOCAL_RANK}")
            if on_gpu:  # SAPIEN downloads PhysX's GPU library when it first needs it: one process at a time
                with contextlib.ExitStack() as downloading:
                    with contextlib.suppress(OSError):  # a home that cannot be written
                        downloading.enter_context(filelock.FileLock(Path.home() / ".sapien/physx.lock"))
                    sapien.physx.enable_gpu()
        except Exception as error:  # no driver, one too old for this torch, no such device, no library
            reason = str(error).splitlines()[0]
            if on_gpu or torch.cuda.is_available():
                remedy = "link libcuda.so.1 as libcuda.so" if "libcuda" in reason else "see examples/check_machine.py"
                fail(f"--sim_backend {args.sim_backend}: {reason}: {remedy}, or use --sim_backend physx_cpu --no-cuda")
            print(f"the GPU is not used: {reason}")
    try:
        parse_backends(args.sim_backend, args.render_backend)
    except (KeyError, ValueError, RuntimeError) as error:
        fail(f"--sim_backend {args.sim_backend} --render_backend {args.render_backend}: {error}")


def set_handlers(handlers: dict) -> dict:
    """Set the handlers of signals; returns those before."""
    return {s: signal.signal(s, handler) for s, handler in handlers.items()}


def stop(signum: int, frame) -> NoReturn:
    """End the run here, with what it had learned when the iteration began."""
    raise KeyboardInterrupt(signum)


def is_from_packages(error: BaseException) -> bool:
    """Whether nothing but installed packages, called by this script, raised it."""
    files = [frame.filename for frame in traceback.extract_tb(error.__traceback__)]
    return all(file == __file__ or file.startswith(PACKAGES) for file in files)


def describe(error: BaseException) -> str:
    """What was raised, and where, in one line."""
    if isinstance(error, (RunError, OSError)):
        return str(error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(place.filename).name}, line {place.lineno})"


def main(argv: list[str]) -> int:
    if RANK > 0:  # only the first process prints, apart from errors
        sys.stdout = open(os.devnull, "w")
    args = parse_args(argv)
    check(args)
    run_dir, code = find_run_dir(args), 0
    handlers = set_handlers(dict.fromkeys(STOP_SIGNALS, stop))
    try:
        with contextlib.ExitStack() as closing:
            try:
                (evaluate_checkpoint if args.evaluate else train)(args, closing)
            finally:  # from here on, a signal must not keep last.pt from being written
                set_handlers(dict.fromkeys(STOP_SIGNALS, signal.SIG_IGN))
    except KeyboardInterrupt as interrupt:
        code = 128 + interrupt.args[0]
        print(f"{SCRIPT.name}: stopped by {signal.Signals(interrupt.args[0]).name}", file=sys.stderr)
    except Exception as error:
        if isinstance(error, torch.OutOfMemoryError):
            error = RunError("the GPU's memory is full: try fewer --num_envs or more --num_minibatches")
        code, is_expected = 1, isinstance(error, RunError) or isinstance(error, OSError) and is_from_packages(error)
        if is_expected and not os.path.exists(run_dir / "metrics.jsonl"):  # nothing was learned yet: bad input
            fail(str(error))
        if is_expected:
            print(f"{SCRIPT.name}: {error}", file=sys.stderr)
        else:
            traceback.print_exc()
    finally:
        set_handlers(handlers)
    if args.evaluate or RANK > 0:
        return code
    command = f"{'uv run' if 'UV_RUN_RECURSION_DEPTH' in os.environ else 'python'} {sys.argv[0]}"
    if code == 0 and (run_dir / "best.pt").exists():
        print(f"learning curve, videos and metrics are in {run_dir}; to evaluate the best policy on other episodes:")
        print(f"    {command} --evaluate --checkpoint {run_dir / 'best.pt'} --eval_seed 1000")
    elif (run_dir / "last.pt").exists():
        if WORLD_SIZE > 1:
            command = f"torchrun --nproc_per_node={LOCAL_WORLD_SIZE} {sys.argv[0]}"
        print(f"{run_dir / 'last.pt'} is safe; to go on: {command} --resume {run_dir}", file=sys.stderr)
    return code


if __name__ == "__main__":
    if hasattr(signal, "SIGPIPE") and ("-h" in sys.argv or "--help" in sys.argv):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # for --help | head
    sys.exit(main(sys.argv[1:]))
