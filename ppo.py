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
# ]
# ///
"""PPO for ManiSkill from state observations, in one file.

Train     python ppo.py --env_id PushCube-v1
On N GPUs torchrun --nproc_per_node=N ppo.py --env_id PushCube-v1
Resume    python ppo.py --resume runs/NAME
Evaluate  python ppo.py --evaluate --checkpoint runs/NAME/best.pt
Watch     runs/NAME/videos/*.mp4, runs/NAME/learning_curve.png, tensorboard --logdir runs
Help      python ppo.py --help

The same command runs on a GPU, on a CPU and without a renderer. `uv run ppo.py` installs what it needs.
To make it yours: the network is `Agent`, the numbers are `Args`, the algorithm is `train`, top to bottom.
"""

import contextlib
import copy
import difflib
import gc
import importlib.metadata
import importlib.util
import inspect
import io
import itertools
import json
import math
import os
import platform
import random
import re
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Literal, NoReturn, Optional

# Vulkan's absence is said in plain words later; the others come from the depths of ManiSkill and mean nothing here
warnings.filterwarnings(
    "ignore",
    message="Failed to find system libvulkan|CUDA reports that you have|.*Box .*precision|.*capturable=True|"
    "Synchronization debug mode is a prototype",
)

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None

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
from tqdm import tqdm


def find_render_device() -> Optional[sapien.Device]:
    """The device SAPIEN can render with (a CUDA GPU, else any Vulkan device, software ones included), or None."""
    for name in ("cuda", "pci:0", "cpu"):
        try:
            device = sapien.Device(name)
        except RuntimeError:
            continue
        if device.can_render():
            return device
    return None


SCRIPT = Path(__file__)
RENDER_DEVICE = find_render_device()
RANK, LOCAL_RANK = int(os.environ.get("RANK", 0)), int(os.environ.get("LOCAL_RANK", 0))  # as torchrun tells
WORLD_SIZE, LOCAL_WORLD_SIZE = (int(os.environ.get(k, 1)) for k in ("WORLD_SIZE", "LOCAL_WORLD_SIZE"))
STOP_SIGNALS = {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGUSR1", signal.SIGTERM)}  # USR1: SLURM's warning
MAX_FAILURES = 5  # in a row: skipped updates, or files that cannot be written

if RENDER_DEVICE is None:
    # Tasks give their objects materials even when nothing is rendered, and SAPIEN makes none without a Vulkan
    # device. State observations need none either: stand-ins that accept anything let the tasks build.
    class InertRenderObject:
        def __init__(self, *args, **kwargs):
            pass

        def __getattr__(self, name):
            return lambda *args, **kwargs: None

    for module in (sapien.render, sapien.pysapien.render, sapien.wrapper.urdf_loader):
        module.RenderMaterial = module.RenderTexture2D = InertRenderObject

import mani_skill.envs  # registers the tasks
import mani_skill.envs.sapien_env as sapien_env
from mani_skill.agents.controllers.pd_ee_pose import PDEEPosController
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.render.utils import can_render
from mani_skill.utils import common
from mani_skill.utils.assets import expand_data_group_into_individual_data_source_ids, is_data_source_downloaded
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.gym_utils import find_max_episode_steps_value
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs import Articulation, Link
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct
from mani_skill.utils.visualization.misc import tile_images
from mani_skill.utils.wrappers.flatten import FlattenActionSpaceWrapper
from mani_skill.utils.wrappers.record import RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

gc.freeze()  # ManiSkill collects garbage each time it builds scenes: skip the objects that the imports made

parse_backends = sapien_env.parse_sim_and_render_backend


def parse_backends_and_find_renderer(sim_backend: str, render_backend: str):
    """ManiSkill's render_backend has no name for a Vulkan device without CUDA: put it in where CUDA is not found."""
    backend = parse_backends(sim_backend, render_backend)
    if RENDER_DEVICE and backend.render_device and not backend.render_device.can_render():
        backend.render_device, backend.render_backend = RENDER_DEVICE, "sapien_cpu"
    return backend


sapien_env.parse_sim_and_render_backend = parse_backends_and_find_renderer

# what concerns no user: the render device is replaced above, robots are as they are
NOISE = "Requested to use render device|mani_skill is not installed with git|"
NOISE += "Currently ManiSkill does not support loading plane|No initial pose set for"
mani_skill.logger.addFilter(lambda record: not re.match(NOISE, record.getMessage()))


@dataclass
class Args:
    # --- experiment ---
    exp_name: Optional[str] = None
    """name of the run, whose files go to runs/<exp_name> (None: <env_id>__<script>__<seed>__<time>)"""
    seed: int = 1
    """seed of the weights, the actions and the training episodes"""
    torch_deterministic: bool = True
    """ask cuDNN for deterministic algorithms"""
    cuda: bool = True
    """use a CUDA GPU where there is one; --no-cuda keeps simulation and learning on the CPU"""
    track: bool = False
    """log to Weights & Biases as well (needs: pip install wandb)"""
    wandb_project_name: str = "ManiSkill"
    """Weights & Biases project"""
    wandb_entity: Optional[str] = None
    """Weights & Biases entity (team)"""
    wandb_group: str = "PPO"
    """Weights & Biases group"""

    # --- environment ---
    env_id: str = "PushCube-v1"
    """the task: any registered ManiSkill task, or module:EnvId for one of your own"""
    obs_mode: Literal["state"] = "state"
    """this script learns from the state vector"""
    control_mode: Optional[str] = "pd_joint_delta_pos"
    """controller of the robot (None: the robot's own default)"""
    robot_uids: Optional[str] = None
    """robot (None: the task's own)"""
    reward_mode: Optional[Literal["normalized_dense", "dense", "sparse", "none"]] = None
    """what is learned from (None: the first of these that the task has)"""
    sim_backend: str = "auto"
    """physx_cuda (all environments on one GPU; physx_cuda:1 on the second), physx_cpu, or auto"""
    render_backend: str = "gpu"
    """where videos are rendered: gpu (gpu:1), cpu or none; what is not there is replaced by what is"""
    num_envs: int = 512
    """parallel training environments (on a CPU: 32 a core)"""
    num_eval_envs: int = 64
    """parallel evaluation environments (on a CPU: 32 a core)"""
    num_actors: Optional[int] = None
    """processes that simulate on a CPU, each its part of the environments (None: one a core)"""
    partial_reset: bool = True
    """end a training episode at success or failure; --no-partial_reset: at the time limit only"""
    eval_partial_reset: bool = False
    """end an evaluation episode at success or failure"""
    reconfiguration_freq: Optional[int] = None
    """rebuild training scenes every so many resets (None: the task's own); a batch needs --no-partial_reset for it"""
    eval_reconfiguration_freq: Optional[int] = None
    """rebuild evaluation scenes every so many resets (None: 1 for tasks that vary their objects, else 0: never)"""
    render_mode: Literal["rgb_array", "sensors", "all"] = "rgb_array"
    """what videos show: rgb_array (the scene), sensors (the task's cameras) or all"""
    shader: Literal["minimal", "default", "rt-fast", "rt-med", "rt"] = "default"
    """shader pack of videos; ray tracing (rt) works with CPU simulation only"""
    env_kwargs: str = "{}"
    """further arguments of gym.make as JSON, such as '{"enhanced_determinism": true}'"""

    # --- PPO ---
    total_timesteps: int = 10_000_000
    """environment steps in all (on a CPU: 120,000)"""
    learning_rate: float = 3e-4
    """Adam's learning rate (on a CPU: 1e-3)"""
    critic_learning_rate: Optional[float] = None
    """learning rate of the critic's layers (None: learning_rate)"""
    logstd_lr_factor: float = 1.0
    """learning rate of the policy's standard deviation, in multiples of learning_rate (on a CPU: 20)"""
    num_steps: Optional[int] = None
    """steps in each environment per iteration (None: 50; on a CPU 1,600 / num_envs, at least 5)"""
    anneal_lr: bool = False
    """let the learning rate fall linearly to zero over the run; with desired_kl the critic's alone (on a CPU: yes)"""
    gamma: float = 0.8
    """discount factor"""
    gae_lambda: float = 0.9
    """lambda of generalised advantage estimation"""
    num_minibatches: int = 32
    """minibatches per epoch (on a CPU: 4); where they do not divide the batch, a random remainder sits out"""
    update_epochs: int = 4
    """passes over the batch per iteration (on a CPU: 8)"""
    norm_adv: bool = True
    """normalise the advantages of each minibatch"""
    clip_coef: float = 0.2
    """clipping range of the probability ratio"""
    clip_vloss: bool = False
    """clip the value's change by clip_coef too"""
    ent_coef: float = 0.0
    """weight of the entropy bonus"""
    vf_coef: float = 0.5
    """weight of the value loss"""
    max_grad_norm: float = 0.5
    """largest norm of the gradient"""
    target_kl: Optional[float] = 0.1
    """end the update after an epoch whose last minibatch has a larger KL divergence (None: never, as on a CPU)"""
    desired_kl: Optional[float] = None
    """adapt the policy's learning rate after each minibatch to keep the KL divergence near this (on a CPU: 0.05)"""
    reward_scale: float = 1.0
    """factor on the rewards that are learned from; logged returns are without it"""
    bootstrap_at_done: Literal["always", "truncated", "never"] = "always"
    """episode ends at which the value of the final observation still counts"""
    finite_horizon_gae: bool = False
    """lambda-weighted mean over the n-step returns that exist, instead of the infinite sum"""
    shared_features: bool = False
    """one feature extractor for policy and value, instead of one for each"""
    norm_obs: bool = False
    """normalise observations by their running mean and variance (on a CPU: yes)"""
    logstd_init: float = -0.5
    """initial logarithm of the policy's standard deviation (ManiSkill: ppo.py -0.5, ppo_fast.py 0)"""

    # --- evaluation and checkpoints ---
    eval_freq: int = 25
    """evaluate every so many iterations (on a CPU: 10), and always before the first and after the last; 0: only then"""
    num_eval_episodes: int = 64
    """episodes of an evaluation"""
    num_eval_steps: Optional[int] = None
    """instead of num_eval_episodes: steps in each evaluation environment, as many episodes as fit, at least one"""
    eval_seed: int = 0
    """evaluation episode k starts from seed eval_seed + k, below 2^31; training's seeds lie above"""
    stop_at_success: Optional[float] = None
    """end the run once an evaluation's success_once reaches this rate"""
    evaluate: bool = False
    """only evaluate --checkpoint, which brings its task, network and flags along"""
    checkpoint: Optional[str] = None
    """checkpoint to evaluate, or whose weights training starts from"""
    save_model: bool = True
    """write best.pt (the best evaluation so far) and last.pt"""
    save_freq: Optional[int] = None
    """keep a numbered checkpoint every so many iterations too"""
    checkpoint_freq: int = 10
    """write last.pt every so many iterations"""
    checkpoint_minutes: float = 5
    """write last.pt also when the one before is so old (not with --exact_resume)"""
    resume: Optional[str] = None
    """run folder, or checkpoint in one, to continue in place, with the run's own flags; those of the machine, logging,
    videos and checkpoints, eval_freq, stop_at_success and total_timesteps may be given anew"""
    exact_resume: bool = False
    """start new episodes in new scenes at every checkpoint_freq-th iteration and write last.pt there only: a run on CPU
    simulation that was stopped and resumed is then bit-identical to one that was not (a GPU's is not deterministic)"""
    capture_video: bool = True
    """film the first episodes of each evaluation, where there is a renderer"""
    save_train_video_freq: Optional[int] = None
    """film the policy as it explores in training, every so many iterations"""
    save_trajectory: bool = False
    """write evaluation episodes as ManiSkill trajectories next to the videos, one file an actor
    (python -m mani_skill.trajectory.merge_trajectory joins them)"""

    # --- runtime ---
    compile: bool = False
    """compile the network with torch.compile, which takes a minute"""
    cudagraphs: bool = True
    """on a GPU, launch an epoch of the update, and a step of the policy, as one CUDA graph each"""

    @property
    def batch_size(self) -> int:
        return self.num_envs * self.num_steps

    @property
    def minibatch_size(self) -> int:
        return self.batch_size // self.num_minibatches

    @property
    def num_iterations(self) -> int:
        return self.total_timesteps // self.batch_size

    def share(self) -> "Args":
        """Those of one of the processes that torchrun started: its part of the environments, on its own GPU."""
        if WORLD_SIZE == 1:
            return self
        backend = self.sim_backend + f":{LOCAL_RANK}" * (self.sim_backend == "physx_cuda")
        return replace(
            self, num_envs=self.num_envs // WORLD_SIZE, num_eval_envs=math.ceil(self.num_eval_envs / WORLD_SIZE),
            num_eval_episodes=math.ceil(self.num_eval_episodes / WORLD_SIZE), sim_backend=backend,
            num_actors=max(1, self.num_actors // WORLD_SIZE),
            **{} if RANK == 0 else dict(
                capture_video=False, save_train_video_freq=None, save_trajectory=False, save_model=False, track=False
            ),
        )  # fmt: skip


CPU_DEFAULTS = dict(
    total_timesteps=120_000, learning_rate=1e-3, anneal_lr=True, num_minibatches=4, update_epochs=8, norm_obs=True,
    logstd_lr_factor=20.0, target_kl=None, desired_kl=0.05, eval_freq=10,
)  # fmt: skip

# --evaluate takes the flags of the machine from the command line, not the run; training from a --checkpoint takes those
# of the network from the checkpoint; a resumed run may be given only some anew
OF_THE_MACHINE = {
    "cuda", "sim_backend", "render_backend", "num_eval_envs", "num_actors", "capture_video", "save_trajectory", "track"
}  # fmt: skip
OF_THE_NETWORK = ("norm_obs", "shared_features")
MAY_CHANGE = OF_THE_MACHINE | {
    "total_timesteps", "stop_at_success", "eval_freq", "save_model", "save_freq", "checkpoint_freq",
    "checkpoint_minutes", "save_train_video_freq", "render_mode", "shader", "wandb_project_name", "wandb_entity",
    "wandb_group", "torch_deterministic", "compile", "cudagraphs", "resume",
}  # fmt: skip


def fail(message: str) -> NoReturn:
    """Refuse bad input: one line, exit code 2."""
    print(f"{SCRIPT.name}: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(2)


class RunError(RuntimeError):
    """What ends a run through no fault of this script: told without a traceback of it."""


def num_cores() -> int:
    """Of this machine, for this process."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, cores // LOCAL_WORLD_SIZE)


def num_update_threads() -> int:
    """Half the cores: OpenMP's threads wait for the slowest of them, and stall when other work takes its core."""
    return max(1, num_cores() // 2)


@contextlib.contextmanager
def together():
    """With the other processes that train together; RunError where one of them is gone."""
    try:
        yield
    except RuntimeError as error:
        raise RunError(f"rank {RANK} lost another process of the run, which may have said why: {error}") from None


def average(x: torch.Tensor) -> torch.Tensor:
    """Mean of a tensor over the processes that train together, in place."""
    if WORLD_SIZE > 1:
        with together():
            dist.all_reduce(x)
        x /= WORLD_SIZE
    return x


def gather(x) -> list:
    """What each of the processes that train together has, in the order of their ranks."""
    everything = [x] * WORLD_SIZE
    if WORLD_SIZE > 1:
        with together():
            dist.all_gather_object(everything, x)
    return everything


def parse_args(argv: list[str]) -> Args:
    """Command line to Args. Defaults are those of the run to resume or to evaluate, or of the simulation backend: on
    a GPU steps are cheap and hundreds of environments run at once, on a CPU each step is learned from more often."""

    def parse(argv, default):
        errors = io.StringIO()
        try:
            with contextlib.redirect_stderr(errors):
                args = tyro.cli(Args, args=argv, default=default)
        except SystemExit as error:
            if error.code == 0:  # --help
                raise
            message = errors.getvalue().partition("\n")[2].partition("│ ──")[0]  # of a box with a title and a footer
            fail(re.sub("[│╰╯─]+", " ", message) + " (see --help)")
        return replace(args, sim_backend=resolve_backend(args))

    args = parse([arg for arg in argv if arg not in ("-h", "--help")], Args())
    default, stored, kept = Args(), {}, ()
    if args.sim_backend == "physx_cpu":
        cores = num_cores() * WORLD_SIZE
        default = replace(default, **CPU_DEFAULTS, num_envs=32 * cores, num_eval_envs=32 * cores)
    if args.resume is not None:
        if args.evaluate or args.checkpoint:
            fail("--resume continues a run as it was: leave out --evaluate and --checkpoint")
        stored = load_checkpoint(find_checkpoint(args.resume))["args"]
        kept = stored.keys()
    elif args.evaluate or args.checkpoint is not None:
        stored = load_checkpoint(args.checkpoint)["args"]
        of_this_evaluation = OF_THE_MACHINE | {"num_eval_episodes", "num_eval_steps", "eval_seed", "exp_name", "resume"}
        kept = stored.keys() - of_this_evaluation if args.evaluate else OF_THE_NETWORK
    args = parse(argv, replace(default, **{k: stored[k] for k in kept if k in stored and hasattr(default, k)}))
    if args.resume is not None:
        for k in kept - MAY_CHANGE:
            if hasattr(args, k) and getattr(args, k) != stored[k]:
                fail(f"--resume: the run has --{k} {stored[k]}, not {getattr(args, k)}; start a new one to change that")
        args.resume = str(find_checkpoint(args.resume))
    if args.num_steps is None:
        args.num_steps = max(5, 1600 // max(1, args.num_envs)) if args.sim_backend == "physx_cpu" else 50
    if args.num_actors is None:
        cores = num_cores() * WORLD_SIZE if args.sim_backend == "physx_cpu" else WORLD_SIZE
        args.num_actors = max(1, min(cores, args.num_envs))
    if args.exp_name is None:
        args.exp_name = f"{args.env_id.split(':')[-1]}__{SCRIPT.stem}__{args.seed}__{int(time.time())}"
    return args


def find_checkpoint(path: str) -> Path:
    """The checkpoint that --resume means: the file itself, or a run folder's last.pt."""
    return Path(path) / "last.pt" if Path(path).is_dir() else Path(path)


def find_run_dir(args: Args) -> Path:
    checkpoint = args.resume or (args.checkpoint if args.evaluate else None)
    return Path(checkpoint).parent if checkpoint else Path("runs") / args.exp_name


def resolve_backend(args: Args) -> str:
    backend = {"cpu": "physx_cpu", "gpu": "physx_cuda", "cuda": "physx_cuda"}.get(args.sim_backend, args.sim_backend)
    if backend == "auto":
        backend = "physx_cuda" if args.cuda and torch.cuda.is_available() else "physx_cpu"
    if backend == "physx_cuda" and WORLD_SIZE == 1:
        backend = "physx_cuda:0"  # without an index SAPIEN takes the first device in Vulkan's order, torch in CUDA's
    return backend


# ----- Environments ---------------------------------------------------------------------------------------------------


def find_task(env_id: str):
    """The registration of a task; KeyError or ImportError if there is none."""
    module, _, name = env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    return REGISTERED_ENVS[name]


def default_reward_mode(task) -> str:
    """The most telling reward that a task offers; some name "none" first."""
    return next(m for m in ("normalized_dense", "dense", "sparse", "none") if m in task.SUPPORTED_REWARD_MODES)


def varies_objects(task) -> bool:
    """Whether a task builds other objects for each episode of a single environment. ManiSkill's tasks then take
    reconfiguration_freq, to switch that off for batches."""
    return "reconfiguration_freq" in inspect.signature(task.cls.__init__).parameters


def make_env(args: Args, num_envs: int, evaluation: bool = False, film: bool = False) -> gym.Env:
    """`num_envs` environments of the task as one ManiSkill environment: a batch, or on a CPU also a single one."""
    kwargs = dict(
        num_envs=num_envs,
        obs_mode=args.obs_mode,
        control_mode=args.control_mode,
        robot_uids=tuple(args.robot_uids.split(",")) if "," in (args.robot_uids or "") else args.robot_uids,
        reward_mode=args.reward_mode or default_reward_mode(find_task(args.env_id).cls),
        reconfiguration_freq=0 if evaluation else args.reconfiguration_freq,  # `evaluate` rebuilds its scenes itself
        sim_backend=args.sim_backend,
        render_backend=args.render_backend if film else "none",
        render_mode=args.render_mode if film else None,
        human_render_camera_configs=dict(shader_pack=args.shader) if film else None,
    )
    kwargs = {k: v for k, v in kwargs.items() if v is not None} | json.loads(args.env_kwargs)
    env = gym.make(args.env_id, **kwargs)
    if isinstance(env.action_space, gym.spaces.Dict):
        env = FlattenActionSpaceWrapper(env)
    return env


def make_envs(
    args: Args, num_envs: int, seed: int, evaluation: bool = False, film: bool = False, record: Optional[dict] = None
) -> ManiSkillVectorEnv:
    """Environments with ManiSkill's interface for a batch. Those for evaluation do not reset by themselves: `evaluate`
    starts each episode from its seed.

    Args:
        seed: what the objects of a batch are built from, in tasks that vary them.
        film: render the environments.
        record: arguments of RecordEpisode, to write trajectories."""
    sapien_env.BaseEnv.build_seed = seed
    env = make_env(args, num_envs, evaluation, film)
    if record:
        env = RecordEpisode(env, save_video=False, save_on_reset=True, source_type="rl", source_desc="PPO", **record)
    return ManiSkillVectorEnv(
        env,
        auto_reset=not evaluation,
        ignore_terminations=not (args.eval_partial_reset if evaluation else args.partial_reset),
        record_metrics=True,
    )


def rebuilding(args: Args) -> int:
    """In every how many rounds of an evaluation its scenes are rebuilt."""
    if args.eval_reconfiguration_freq is not None:
        return args.eval_reconfiguration_freq
    return int(varies_objects(find_task(args.env_id)) or args.exact_resume and args.sim_backend == "physx_cpu")


def can_reset_some(envs: ManiSkillVectorEnv) -> bool:
    """Whether the task can reset some of several environments: a few of ManiSkill's fail."""
    try:
        envs.reset(options=dict(env_idx=torch.zeros(1, dtype=torch.long, device=envs.device)))
    except (RuntimeError, IndexError, ValueError, AssertionError):
        return envs.num_envs == 1
    return True


def start_episodes(envs: ManiSkillVectorEnv, seeds: list[int], separately: bool):
    """Start an episode from each seed; returns the first observations. ManiSkill draws a batch from its first seed:
    `separately` resets each environment by itself, so that each episode follows from its own seed alone."""
    if not separately:
        return envs.reset(seed=seeds)[0]
    for i, seed in enumerate(seeds):
        obs, _ = envs.reset(seed=[seed] * len(seeds), options=dict(env_idx=torch.tensor([i])))
    envs.base_env._set_main_rng(seeds)
    envs.base_env._set_episode_rng(seeds, torch.arange(len(seeds)))  # for what a task draws during its episodes
    return obs


def evaluation_size(env: gym.Env, args: Args) -> tuple[int, int]:
    """Number of evaluation episodes, and of steps in each: the task's time limit, or num_eval_steps if it has none."""
    limit = find_max_episode_steps_value(env)
    if limit is None or args.num_eval_steps is None:
        return args.num_eval_episodes, limit or args.num_eval_steps or 1000
    return args.num_eval_envs * max(1, args.num_eval_steps // limit), limit


def seed_all(*numbers: int) -> None:
    """Seed every random generator of this process."""
    seed = int(np.random.SeedSequence(numbers).generate_state(1)[0])
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def as_dict(obs) -> dict:
    """Observations by name, also where there is one only."""
    return obs if isinstance(obs, (dict, gym.spaces.Dict)) else {"state": obs}


class Film:
    """A small batch of its own that is rendered: it plays the first evaluation episodes again, into videos."""

    def __init__(self, args: Args, folder: Path):
        self.args, self.folder, self.envs = args, folder, None
        self.num_envs = 1 if args.sim_backend == "physx_cpu" else 4

    def record(self, agent, name: str, num_steps: int, seed: int, exploring: bool = False) -> None:
        """Write episodes that start from `seed` on as <folder>/<name>.mp4; no more than a frame is held."""
        if self.envs is None:
            self.envs = make_envs(self.args, self.num_envs, seed, evaluation=True, film=True)
            self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{name}.mp4"
        try:
            with imageio.get_writer(path, fps=self.envs.base_env.control_freq) as writer:

                def write_frame():
                    pictures = common.to_numpy(self.envs._env.render())
                    writer.append_data(tile_images(list(pictures), nrows=math.isqrt(self.num_envs)))

                flags = dict(exploring=exploring, write_frame=write_frame)
                evaluate(agent, self.envs, self.num_envs, seed, num_steps, rebuilding(self.args), **flags)
        except OSError as error:  # such as a full disk
            print(f"a video could not be written, the run goes on: {error}", flush=True)
            path.unlink(missing_ok=True)

    def close(self) -> None:
        if self.envs is not None:
            self.envs.close()


# ----- Batched CPU simulation -----------------------------------------------------------------------------------------


ALL, NO_ROWS = slice(None), torch.zeros(0, 1, dtype=torch.bool)


class Array:
    """What SAPIEN's CUDA arrays are to ManiSkill: something with .torch(). `refresh` fills an outdated one."""

    def __init__(self, *shape: int, refresh=None):
        with torch.inference_mode(False):  # in which a tensor has no version
            self.data = torch.zeros(shape)
        self.applied = torch.zeros(shape)  # what the simulation has of it
        self.version = None  # of the tensor when the simulation had all of it: torch counts the writes
        self.refresh, self.outdated = refresh, False

    def fetch(self, values: torch.Tensor, rows=ALL, columns=ALL) -> None:
        self.data[rows, columns] = values
        self.applied[rows, columns] = values
        if rows is columns is ALL:
            self.version = self.data._version

    def changes(self, rows=ALL, columns=ALL) -> torch.Tensor:
        """Where the tensor was written since it was fetched or applied: bool, of these rows and columns, and of no row
        if nothing was. What was not written is left alone in the simulation, to the last bit."""
        if self.data._version == self.version:
            return NO_ROWS
        changed = self.data[rows, columns] != self.applied[rows, columns]
        if changed.any():
            self.applied[rows, columns] = self.data[rows, columns]
        if rows is columns is ALL:
            self.version = self.data._version
        return changed

    def torch(self):
        if self.outdated:
            self.outdated = False
            self.refresh()
        return self.data


class BatchedPhysx:
    """One PhysxCpuSystem per environment behind the interface of SAPIEN's PhysxGpuSystem, with tensors on the CPU.

    ManiSkill simulates a batch of environments through the tensors `cuda_*` of that interface: `gpu_apply_*` moves what
    was written into the simulation, `gpu_fetch_*` moves what was simulated into the tensors. Each body has a row in
    `cuda_rigid_body_data` (position, quaternion, linear and angular velocity: 13 numbers), first all free bodies, then
    all links; each articulation has one in `cuda_articulation_*`, padded to the largest number of joints."""

    __class__ = physx.PhysxGpuSystem  # so says isinstance

    def __init__(self, scenes: list[sapien.Scene]):
        self.scenes, self.systems = scenes, [scene.physx_system for scene in scenes]
        for scene in scenes:
            scene.batch = self

    @property
    def timestep(self) -> float:
        return self.systems[0].timestep

    @timestep.setter
    def timestep(self, value: float):
        for system in self.systems:
            system.timestep = value

    def gpu_init(self) -> None:
        self.free = [body for system in self.systems for body in system.rigid_dynamic_components]
        self.links = [link for system in self.systems for link in system.articulation_link_components]
        self.articulations = [link.articulation for link in self.links if link.is_root]
        self.joints = [articulation.active_joints for articulation in self.articulations]
        self.row = {body: i for i, body in enumerate(self.free + self.links)}
        self.articulation_row = {articulation: i for i, articulation in enumerate(self.articulations)}
        self.root_rows = torch.tensor([self.row[link] for link in self.links if link.is_root], dtype=torch.long)
        num_bodies, num_articulations = len(self.row), len(self.articulations)
        max_dof = max([articulation.dof for articulation in self.articulations], default=0)
        max_links = max([len(articulation.links) for articulation in self.articulations], default=0)
        self.cuda_rigid_body_data = Array(num_bodies, 13)
        self.cuda_rigid_body_force, self.cuda_rigid_body_torque = Array(num_bodies, 4), Array(num_bodies, 4)
        for name in ("qpos", "qvel", "qf", "target_qpos", "target_qvel"):
            setattr(self, f"cuda_articulation_{name}", Array(num_articulations, max_dof))
        self.cuda_articulation_qacc = Array(num_articulations, max_dof, refresh=self._read_qacc)
        self.cuda_articulation_link_incoming_joint_forces = Array(num_articulations, max_links, 6)

        # Where the numbers stand in what pack() returns: for each free body, then each articulation of a scene, the
        # quaternion (w first), position, linear and angular velocity; for articulations also positions, velocities and
        # both kinds of drive targets of their joints.
        free_at, roots_at, joints_at, end = [], [], [], 0
        self.scene_of_free, self.scene_of_articulation = [], []
        for i, system in enumerate(self.systems):
            for _ in system.rigid_dynamic_components:
                self.scene_of_free.append(i)
                free_at.append(end)
                end += 13
            for link in system.articulation_link_components:
                if link.is_root:
                    self.scene_of_articulation.append(i)
                    roots_at.append(end)
                    joints_at.append(end + 13)
                    end += 13 + 4 * link.articulation.dof
        state = torch.tensor([4, 5, 6, 0, 1, 2, 3, 7, 8, 9, 10, 11, 12])
        self.free_columns = torch.tensor(free_at, dtype=torch.long)[:, None] + state
        self.root_columns = torch.tensor(roots_at, dtype=torch.long)[:, None] + state[7:]
        self.joint_columns = torch.full((2, num_articulations, max_dof), end)  # for padding: a zero at the end
        for i, articulation in enumerate(self.articulations):
            positions = joints_at[i] + torch.arange(articulation.dof)
            self.joint_columns[0, i, : articulation.dof] = positions
            self.joint_columns[1, i, : articulation.dof] = positions + articulation.dof
        self.states, self.poses, self.pose_sizes = [b""] * len(self.systems), [b""] * len(self.systems), None
        self.moved, self.contacts = set(range(len(self.systems))), None
        self.gpu_fetch_rigid_dynamic_data()
        self.gpu_fetch_articulation_link_pose()
        self.gpu_fetch_articulation_qpos()
        self.gpu_fetch_articulation_qvel()

    def step(self) -> None:
        self.gpu_apply_articulation_target_position()
        self.gpu_apply_articulation_target_velocity()
        for system in self.systems:
            system.step()
        self.moved, self.contacts = set(range(len(self.systems))), None

    # --- from the simulation to the tensors ---

    def _pack(self) -> None:
        """Read the whole state of the scenes in which something has moved since."""
        if not self.moved:
            return
        for i in self.moved:
            self.states[i], self.poses[i] = self.systems[i].pack(), self.scenes[i].pack_poses()
        self.moved = set()
        self.cuda_articulation_qacc.outdated = True
        self.packed = torch.frombuffer(bytearray().join([*self.states, bytes(4)]), dtype=torch.float32)
        if [*map(len, self.poses)] != self.pose_sizes:  # lights and cameras may be added at any time
            self._find_links()
        if self.links:
            self.packed_poses = torch.frombuffer(bytearray().join(self.poses), dtype=torch.float32)

    def _find_links(self) -> None:
        """Where each link's pose stands in what pack_poses() returns: quaternion and position of each entity."""
        self.poses = [scene.pack_poses() for scene in self.scenes]
        self.pose_sizes = [*map(len, self.poses)]
        starts = np.cumsum([0, *self.pose_sizes]) // 4
        entity_at = {}
        for scene, start in zip(self.scenes, starts):
            entity_at |= {entity: start + 7 * i for i, entity in enumerate(scene.entities)}
        links_at = torch.tensor([int(entity_at[link.entity]) for link in self.links], dtype=torch.long)
        self.link_columns = links_at[:, None] + torch.tensor([4, 5, 6, 0, 1, 2, 3])

    def gpu_fetch_rigid_dynamic_data(self) -> None:
        self._pack()
        self.cuda_rigid_body_data.fetch(self.packed[self.free_columns], slice(0, len(self.free)))

    def gpu_fetch_articulation_link_pose(self) -> None:
        self._pack()
        if self.links:
            poses = self.packed_poses[self.link_columns]
            self.cuda_rigid_body_data.fetch(poses, slice(len(self.free), None), slice(0, 7))

    def gpu_fetch_articulation_link_velocity(self) -> None:
        """Of the roots; `read_velocities` gets those of other links, for which few tasks ask."""
        self._pack()
        self.cuda_rigid_body_data.fetch(self.packed[self.root_columns], self.root_rows, slice(7, 13))

    def read_velocities(self, links: list) -> None:
        links = [link for link in links if not link.is_root]
        if links:
            rows = [self.row[link] for link in links]
            velocities = np.array([[*link.linear_velocity, *link.angular_velocity] for link in links])
            self.cuda_rigid_body_data.data[rows, 7:] = torch.from_numpy(velocities).float()

    def gpu_fetch_articulation_qpos(self) -> None:
        self._pack()
        self.cuda_articulation_qpos.fetch(self.packed[self.joint_columns[0]])

    def gpu_fetch_articulation_qvel(self) -> None:
        self._pack()
        self.cuda_articulation_qvel.fetch(self.packed[self.joint_columns[1]])

    def _read_qacc(self) -> None:
        for articulation, row in zip(self.articulations, self.cuda_articulation_qacc.data):
            row[: articulation.dof] = torch.from_numpy(articulation.qacc)

    def gpu_fetch_articulation_link_incoming_joint_forces(self) -> None:
        for articulation, row in zip(self.articulations, self.cuda_articulation_link_incoming_joint_forces.data):
            row[: len(articulation.links)] = torch.from_numpy(articulation.get_link_incoming_joint_forces())

    # --- from the tensors to the simulation ---

    def gpu_apply_rigid_dynamic_data(self) -> None:
        changed = self.cuda_rigid_body_data.changes(slice(0, len(self.free)))
        for i in changed.any(dim=1).nonzero().flatten().tolist():
            body, row = self.free[i], self.cuda_rigid_body_data.data[i].numpy()
            if changed[i, :7].any():
                body.pose = sapien.Pose(row[:3], row[3:7])
            if not body.kinematic and changed[i, 7:].any():
                body.linear_velocity, body.angular_velocity = row[7:10], row[10:13]
            self.moved.add(self.scene_of_free[i])

    def gpu_apply_articulation_root_pose(self) -> None:
        changed = self.cuda_rigid_body_data.changes(self.root_rows, slice(0, 7))
        for i in changed.any(dim=1).nonzero().flatten().tolist():
            row = self.cuda_rigid_body_data.data[self.root_rows[i]].numpy()
            self.articulations[i].root_pose = sapien.Pose(row[:3], row[3:7])
            self.moved.add(self.scene_of_articulation[i])

    def gpu_apply_articulation_root_velocity(self) -> None:
        changed = self.cuda_rigid_body_data.changes(self.root_rows, slice(7, 13))
        for i in changed.any(dim=1).nonzero().flatten().tolist():
            row = self.cuda_rigid_body_data.data[self.root_rows[i]].numpy()
            self.articulations[i].root_linear_velocity = row[7:10]
            self.articulations[i].root_angular_velocity = row[10:13]
            self.moved.add(self.scene_of_articulation[i])

    def _apply(self, name: str) -> None:
        array = getattr(self, f"cuda_articulation_{name}")
        for i in array.changes().any(dim=1).nonzero().flatten().tolist():
            setattr(self.articulations[i], name, array.data[i, : self.articulations[i].dof].numpy())
            self.moved.add(self.scene_of_articulation[i])

    def gpu_apply_articulation_qpos(self) -> None:
        self._apply("qpos")

    def gpu_apply_articulation_qvel(self) -> None:
        self._apply("qvel")

    def gpu_apply_articulation_qf(self) -> None:
        self._apply("qf")

    def _apply_targets(self, name: str, set_target) -> None:
        array = getattr(self, f"cuda_articulation_{name}")
        changed = array.changes()
        if changed.any():
            targets = array.data.tolist()
            for i, j in changed.nonzero().tolist():
                set_target(self.joints[i][j], targets[i][j])

    def gpu_apply_articulation_target_position(self) -> None:
        self._apply_targets("target_qpos", physx.PhysxArticulationJoint.set_drive_target)

    def gpu_apply_articulation_target_velocity(self) -> None:
        self._apply_targets("target_qvel", physx.PhysxArticulationJoint.set_drive_velocity_target)

    def gpu_apply_rigid_dynamic_force(self) -> None:
        """Forces act once, at the centre of mass."""
        forces = self.cuda_rigid_body_force.data
        for body, i in self.row.items():
            if forces[i].any():
                body.add_force_at_point(forces[i, :3].numpy(), (body.pose * body.cmass_local_pose).p)
        forces.zero_()

    def gpu_apply_rigid_dynamic_torque(self) -> None:
        torques = self.cuda_rigid_body_torque.data
        for body, i in self.row.items():
            if torques[i].any():
                body.add_force_torque(np.zeros(3, np.float32), torques[i, :3].numpy())
        torques.zero_()

    # --- contacts: asked of the simulation only where a task asks ---

    def gpu_create_contact_body_impulse_query(self, bodies: list):
        """For the net impulse on each of these bodies or, of each pair, on the first body from the second."""
        return SimpleNamespace(bodies=bodies, cuda_impulses=Array(len(bodies), 3))

    gpu_create_contact_pair_impulse_query = gpu_create_contact_body_impulse_query

    def gpu_query_contact_body_impulses(self, query) -> None:
        if self.contacts is None:
            self.contacts = defaultdict(list)
            for contact in [contact for system in self.systems for contact in system.get_contacts()]:
                a, b = contact.bodies
                for key, sign in ((a, 1), (b, -1), ((a, b), 1), ((b, a), -1)):
                    self.contacts[key].append((contact, sign))
        for impulse, key in zip(query.cuda_impulses.data.zero_(), query.bodies):
            for contact, sign in self.contacts.get(key, ()):
                total = np.sum([point.impulse for point in contact.points], axis=0, dtype=np.float32)
                impulse += sign * torch.from_numpy(total)

    gpu_query_contact_pair_impulses = gpu_query_contact_body_impulses

    # --- what a CPU simulation need not do ---

    def get_scene_offset(self, scene) -> list[float]:
        return [0.0, 0.0, 0.0]  # each scene is a world of its own

    def _nothing(self) -> None:
        pass

    gpu_fetch_articulation_qacc = gpu_fetch_articulation_target_qpos = gpu_fetch_articulation_target_qvel = _nothing
    gpu_update_articulation_kinematics = sync_poses_gpu_to_cpu = _nothing


class BatchedRenderer:
    """Stands for SAPIEN's RenderSystemGroup: the cameras of all scenes, one after the other, on any Vulkan device."""

    def __init__(self, scenes: list[sapien.Scene]):
        self.scenes = scenes

    def update_render(self) -> None:
        for scene in self.scenes:
            scene.update_render()

    def create_camera_group(self, cameras: list, names: list[str]):
        return BatchedCamera(cameras)


class BatchedCamera:
    def __init__(self, cameras: list):
        self.cameras = cameras

    def take_picture(self) -> None:
        for camera in self.cameras:
            camera.take_picture()

    def get_picture_cuda(self, name: str) -> SimpleNamespace:
        pictures = common.to_tensor(np.stack([camera.get_picture(name) for camera in self.cameras]))
        return SimpleNamespace(torch=lambda: pictures)


def is_batch(scene: ManiSkillScene) -> bool:
    return scene.gpu_sim_enabled and scene.device.type == "cpu"


def batch_on_cpu() -> None:
    """Let gym.make(task, num_envs=N, sim_backend="physx_cpu") build a batch, with the contract of physx_cuda. What
    ManiSkill does with one environment, or on a GPU, stays as it is."""
    setup_scene, reset = sapien_env.BaseEnv._setup_scene, sapien_env.BaseEnv.reset
    body_data = PhysxRigidBodyComponentStruct._body_data
    set_action, compute_ik = PDEEPosController.set_action, Kinematics.compute_ik
    build_physx_component = ActorBuilder.build_physx_component

    def setup_batch(env):
        if env.num_envs == 1 or env._sim_device.is_cuda():
            return setup_scene(env)
        env._set_scene_config()
        rendered = can_render(env._render_device)
        scenes = []
        for _ in range(env.num_envs):
            renderer = [sapien.render.RenderSystem(env._render_device)] if rendered else []
            scenes.append(sapien.Scene([physx.PhysxCpuSystem(), *renderer]))
        env.scene = ManiSkillScene(scenes, sim_config=env.sim_config, device=env.device, backend=env.backend)
        env.scene.px, env.scene.gpu_sim_enabled = BatchedPhysx(scenes), True
        env.scene.render_system_group = BatchedRenderer(scenes)
        env.scene.px.timestep = 1 / env._sim_freq

    def reset_from_own_seeds(env, seed=None, options=None):
        if env._last_obs is None and env.num_envs > 1:  # it is being made
            seed = [env.build_seed + i for i in range(env.num_envs)]
        return reset(env, seed=seed, options=options)

    def build_with_planes(builder, *args, **kwargs):
        """On a GPU all environments share the ground that the first of them is given."""
        if is_batch(builder.scene):
            builder._plane_collision_poses.clear()
        return build_physx_component(builder, *args, **kwargs)

    def body_data_with_velocities(struct):
        if isinstance(struct, Link) and is_batch(struct.scene):
            struct.px.read_velocities(struct._objs)
        return body_data.fget(struct)

    def keep_awake(name):
        """In each step, drive targets that are set keep the robot of a single environment awake, unchanged ones too."""
        set_targets = getattr(Articulation, name)

        def set_and_wake(articulation, *args, **kwargs):
            set_targets(articulation, *args, **kwargs)
            if is_batch(articulation.scene):
                for robot in articulation._objs:
                    robot.root.wake_up()

        setattr(Articulation, name, set_and_wake)

    def set_action_by_pose(controller, action):
        """The solver for one environment wants a pose to reach, not a change of pose."""
        scene = controller.scene
        if is_batch(scene):
            controller.scene = SimpleNamespace(gpu_sim_enabled=False, num_envs=scene.num_envs)
        try:
            set_action(controller, action)
        finally:
            controller.scene = scene

    def compute_ik_by_row(kinematics, pose, q0, **kwargs):
        if kinematics.use_gpu_ik or len(q0) == 1:
            return compute_ik(kinematics, pose, q0, **kwargs)
        controlled = kinematics.active_joint_indices
        solutions = [compute_ik(kinematics, pose[i : i + 1], q0[i : i + 1]) for i in range(len(q0))]
        return torch.cat([q0[i, controlled][None] if x is None else x for i, x in enumerate(solutions)])

    def row_of(cls, name, table, scene_of):
        """ManiSkill asks bodies and articulations for their rows in the tensors."""
        index = getattr(cls, name)

        def find(component):
            batch = getattr(scene_of(component), "batch", None)
            return getattr(batch, table)[component] if batch else index.fget(component)

        setattr(cls, name, property(find))

    row_of(physx.PhysxRigidDynamicComponent, "gpu_pose_index", "row", lambda body: body.entity.scene)
    row_of(physx.PhysxArticulationLinkComponent, "gpu_pose_index", "row", lambda link: link.entity.scene)
    row_of(physx.PhysxArticulation, "gpu_index", "articulation_row", lambda robot: robot.root.entity.scene)
    sapien_env.CPU_SIM_BACKENDS = set()  # for which ManiSkill refuses more than one environment
    sapien_env.BaseEnv._setup_scene, sapien_env.BaseEnv.reset = setup_batch, reset_from_own_seeds
    sapien_env.BaseEnv.build_seed = 2022  # ManiSkill's; a run sets its own, so that its processes build other objects
    PhysxRigidBodyComponentStruct._body_data = property(body_data_with_velocities)
    PDEEPosController.set_action, Kinematics.compute_ik = set_action_by_pose, compute_ik_by_row
    ActorBuilder.build_physx_component = build_with_planes
    keep_awake("set_joint_drive_targets")
    keep_awake("set_joint_drive_velocity_targets")


batch_on_cpu()


# ----- Actors ---------------------------------------------------------------------------------------------------------


def part(total: int, index: int, parts: int) -> range:
    """What falls to one of several when `total` things are shared out."""
    return range(total * index // parts, total * (index + 1) // parts)


class Actor:
    """The environments of one process: their part of training, and their part of each evaluation."""

    def __init__(self, args: Args, index: int, trajectory_dir: Optional[Path] = None):
        self.args, self.index = args, index
        self.env_idx = part(args.num_envs, index, args.num_actors)
        num_eval_envs = len(part(args.num_eval_envs, index, args.num_actors))
        if args.num_eval_steps is None:
            num_eval_envs = min(num_eval_envs, len(part(args.num_eval_episodes, index, args.num_actors)))
        self.envs = None
        if not args.evaluate:
            seed = int(np.random.SeedSequence([args.seed, RANK, index]).generate_state(1)[0]) // 2
            self.envs = make_envs(args, len(self.env_idx), seed)
            self.resets_some = can_reset_some(self.envs)
        record = None
        if args.save_trajectory and trajectory_dir:
            record = dict(output_dir=str(trajectory_dir), trajectory_name=f"trajectory_{index}")
        first = RANK * args.num_eval_episodes + part(args.num_eval_episodes, index, args.num_actors).start
        self.eval_envs = make_envs(args, num_eval_envs or 1, args.eval_seed + first, evaluation=True, record=record)
        base_env = self.eval_envs.base_env
        batched = isinstance(base_env, sapien_env.BaseEnv) and is_batch(base_env.scene)
        self.separately = batched and can_reset_some(self.eval_envs)

    def connect(self, agent, storage: Optional[dict] = None, sample_action=None) -> None:
        """What to act with, and what to write into: this actor's columns."""
        columns = slice(self.env_idx.start, self.env_idx.stop)
        self.agent, self.storage = agent, storage and {k: v[:, columns] for k, v in storage.items()}
        self.sample_action = sample_action or agent.sample_action

    def rollout(self, iteration: int, restart: bool, rebuild: bool) -> tuple[dict, Optional[str]]:
        """All noise follows from seed, iteration and actor. Returns what `rollout` does, and what was not finite."""
        args = self.args
        seed_all(args.seed, iteration, RANK, self.index)
        if restart:
            seeds = np.random.SeedSequence([args.seed, iteration, RANK]).generate_state(args.num_envs)
            seeds = (seeds // 2 + 2**31).tolist()  # evaluation's lie below 2^31
            options = dict(reconfigure=True) if rebuild else None
            with torch.no_grad():
                self.obs, _ = self.envs.reset(seed=seeds[self.env_idx.start : self.env_idx.stop], options=options)
        self.obs, sums = rollout(self.agent, self.envs, self.storage, self.obs, args, self.sample_action)
        shape = self.storage["rewards"].shape
        names = {"obs": "observation", "rewards": "reward", "next_values": "value"}
        derived = ("actions", "logprobs", "values", "dones")  # from the others
        checked = {names.get(k, k): v for k, v in self.storage.items() if v.is_floating_point() and k not in derived}
        finite = torch.stack([v.isfinite().view(*shape, -1).all(-1).all(0) for v in checked.values()])
        if finite.all():
            return sums, None
        names = [name for name, row in zip(checked, finite) if not row.all()]
        broken = (~finite.all(0)).nonzero().flatten()
        some = self.resets_some and not args.reconfiguration_freq  # ManiSkill rebuilds scenes all at once
        self.obs, _ = self.envs.reset(options=dict(env_idx=broken) if some else None)
        env_idx = (broken.cpu() + self.env_idx.start).tolist()
        return sums, f"non-finite {', '.join(names)} in environments {env_idx}"

    def evaluate(self, num_episodes: int, seed: int, num_steps: int, rebuild: int) -> dict[str, torch.Tensor]:
        """This actor's part of the episodes that start from `seed` on."""
        episodes = part(num_episodes, self.index, self.args.num_actors)
        first = seed + episodes.start
        return evaluate(self.agent, self.eval_envs, len(episodes), first, num_steps, rebuild, self.separately)

    def close(self) -> None:
        for envs in (self.envs, self.eval_envs):
            if envs is not None:
                envs.close()


def check_shared_memory(needed: int) -> None:
    """Refuse what does not fit into the memory that processes share: it would end in a bare 'Bus error'."""
    free = shutil.disk_usage("/dev/shm").free if Path("/dev/shm").exists() else math.inf
    if needed > free:
        fail(f"this run needs {needed / 2**20:,.0f} MiB of shared memory, and {free / 2**20:,.0f} are free: give the "
             "container more (--shm-size), or use fewer environments or steps, or --num_actors 1")  # fmt: skip


def share_memory(agent: nn.Module, storage: dict) -> None:
    """Move them to memory that all processes see."""
    check_shared_memory(sum(x.numel() * x.element_size() for x in [*agent.state_dict().values(), *storage.values()]))
    agent.share_memory()
    for x in storage.values():
        x.share_memory_()


def run_actor(conn, *arguments) -> None:
    """Body of a further process: build an actor, then answer each message, a method and its arguments, with one."""
    torch.set_num_threads(1)
    try:
        actor = Actor(*arguments)
        while True:
            try:
                method, *rest = conn.recv()
            except EOFError:  # the main process closed the pipe, or is gone
                break
            conn.send(getattr(actor, method)(*rest))
        actor.close()
    except ConnectionError:
        pass  # the main process is gone
    except BaseException:
        with contextlib.suppress(ConnectionError):
            conn.send(RunError(f"failed:\n{traceback.format_exc()}"))


class Actors:
    """Actor 0, in this process, and with CPU simulation further ones in processes of their own.

    Raises RunError, with the traceback or the exit code, where one of them fails."""

    def __init__(self, args: Args, trajectory_dir: Path):
        context = mp.get_context("spawn")
        self.conns, self.processes = [], []
        # inherited by the processes: they ignore these signals, and the main process tells them when to stop
        handlers = {s: signal.signal(s, signal.SIG_IGN) for s in STOP_SIGNALS}
        for index in range(1, args.num_actors):
            conn, other_end = context.Pipe()
            process = context.Process(target=run_actor, args=(other_end, args, index, trajectory_dir), daemon=True)
            process.start()
            other_end.close()  # so that a dead process reads as the end of its pipe
            self.conns.append(conn)
            self.processes.append(process)
        for s, handler in handlers.items():
            signal.signal(s, handler)
        try:
            self.local = Actor(args, 0, trajectory_dir)
        except BaseException:
            self.close()
            raise

    def _receive(self, i: int):
        try:
            message = self.conns[i].recv()
        except (EOFError, ConnectionResetError):
            self.processes[i].join(5)
            code = self.processes[i].exitcode
            message = RunError(f"died with exit code {code}" + (" (killed; out of memory?)" if code == -9 else ""))
        if isinstance(message, RunError):
            raise RunError(f"actor {i + 1} {message}")
        return message

    def _send(self, *message) -> None:
        for conn in self.conns:
            with contextlib.suppress(ConnectionError):  # _receive says what became of the process
                conn.send(message)

    def call(self, method: str, *arguments) -> list:
        """Call a method of all actors at once; returns their results in order."""
        self._send(method, *arguments)
        result = getattr(self.local, method)(*arguments)
        return [result, *(self._receive(i) for i in range(len(self.conns)))]

    def connect(self, agent, storage: Optional[dict] = None, sample_action=None) -> None:
        """Hand the weights and the storage to all, in shared memory where there are others."""
        if self.processes:
            share_memory(agent, storage or {})
        self._send("connect", agent, storage)
        self.local.connect(agent, storage, sample_action)
        for i in range(len(self.conns)):
            self._receive(i)

    def memory(self) -> float:
        """Resident memory of the further processes in MiB."""
        return sum(psutil.Process(process.pid).memory_info().rss for process in self.processes) / 2**20

    def close(self) -> None:
        for conn in self.conns:
            conn.close()  # by which an actor learns that it is over
        if hasattr(self, "local"):
            self.local.close()
        for process in self.processes:
            process.join(10)
            process.kill()


# ----- Agent ----------------------------------------------------------------------------------------------------------


def layer_init(layer: nn.Module, std: float = math.sqrt(2), bias_const: float = 0.0) -> nn.Module:
    nn.init.orthogonal_(layer.weight, std)
    nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    """Gaussian policy with state-independent standard deviation, and value function.

    Observations are float32 (batch, obs_dim), actions (batch, act_dim), values and log-probabilities (batch,)."""

    def __init__(self, obs_space: gym.spaces.Box, action_space: gym.spaces.Box, args: Args):
        super().__init__()
        obs_dim, act_dim = obs_space.shape[0], action_space.shape[0]

        def features():
            return nn.Sequential(
                layer_init(nn.Linear(obs_dim, 256)), nn.Tanh(),
                layer_init(nn.Linear(256, 256)), nn.Tanh(),
                layer_init(nn.Linear(256, 256)), nn.Tanh(),
            )  # fmt: skip

        self.actor_features = features()
        self.critic_features = self.actor_features if args.shared_features else features()
        self.actor_mean = layer_init(nn.Linear(256, act_dim), std=0.01 * math.sqrt(2))
        self.actor_logstd = nn.Parameter(torch.full((1, act_dim), args.logstd_init))
        self.critic = layer_init(nn.Linear(256, 1), std=0.01)
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
        mean = average(obs.mean(0))
        var = average(((obs - mean) ** 2).mean(0))
        count, delta = self.obs_count + n, mean - self.obs_mean
        m2 = self.obs_var * self.obs_count + var * n
        self.obs_var.copy_((m2 + delta**2 * self.obs_count * n / count) / count)
        self.obs_mean.add_(delta * n / count)
        self.obs_count.copy_(count)

    def get_value(self, obs):
        return self.critic(self.critic_features(self.normalize(obs))).squeeze(-1)

    def get_action(self, obs):
        """The deterministic action: the mean of the policy."""
        return self.actor_mean(self.actor_features(self.normalize(obs)))

    def get_policy(self, features):
        mean = self.actor_mean(features)
        return Normal(mean, self.actor_logstd.exp().expand_as(mean), validate_args=False)

    def sample_action(self, obs):
        """Returns an action drawn from the policy, and its log-probability."""
        policy = self.get_policy(self.actor_features(self.normalize(obs)))
        # not policy.sample(), for which the host waits: torch.normal looks at the deviations
        action = (policy.mean + policy.stddev * torch.randn_like(policy.mean)).detach()
        return action, policy.log_prob(action).sum(-1)

    def get_action_and_value(self, obs, action):
        """Returns the action, its log-probability, the policy's entropy, and the value."""
        obs = self.normalize(obs)
        features = self.actor_features(obs)
        policy = self.get_policy(features)
        if self.critic_features is not self.actor_features:
            features = self.critic_features(obs)
        value = self.critic(features).squeeze(-1)
        return action, policy.log_prob(action).sum(-1), policy.entropy().sum(-1), value


# ----- Algorithm ------------------------------------------------------------------------------------------------------


def compute_gae(rewards, values, next_values, dones, gamma, gae_lambda, finite_horizon=False):
    """Generalised advantage estimation (Schulman et al. 2016, arXiv 1506.02438).

    Args:
        rewards, values: (num_steps, num_envs), of the step and of the observation it started from.
        next_values: (num_steps, num_envs), value of the step's true next observation (at the end of an episode: the
            final one, not the reset one), zero where the episode's end is not to be bootstrapped.
        dones: (num_steps, num_envs), whether the episode ended with the step.
        finite_horizon: False: eq. 16, line 2, the infinite lambda-weighted sum. True: line 1, the lambda-weighted mean
            over those n-step returns that exist before the episode or the rollout ends.

    Returns:
        (advantages, returns), each (num_steps, num_envs); returns = advantages + values.
    """
    not_done = 1.0 - dones.to(rewards.dtype)
    advantages = torch.zeros_like(rewards)
    if finite_horizon:
        # sums over n of lambda^(n-1) times: 1, the rewards within n steps, the value after n steps
        weight_sum = reward_sum = value_sum = torch.zeros_like(rewards[0])
        for t in reversed(range(len(rewards))):
            weight_sum = 1.0 + gae_lambda * not_done[t] * weight_sum
            reward_sum = weight_sum * rewards[t] + gamma * gae_lambda * not_done[t] * reward_sum
            value_sum = gamma * next_values[t] + gamma * gae_lambda * not_done[t] * value_sum
            advantages[t] = (reward_sum + value_sum) / weight_sum - values[t]
    else:
        deltas = rewards + gamma * next_values - values
        decay = gamma * gae_lambda * not_done
        last = torch.zeros_like(rewards[0])
        for t in reversed(range(len(rewards))):
            advantages[t] = last = deltas[t] + decay[t] * last
    return advantages, advantages + values


def bootstraps(rule: str, terminated: torch.Tensor, truncated: torch.Tensor) -> torch.Tensor:
    """Whether the value of an episode's final observation counts, for each environment, bool (num_envs,).

    ManiSkill's rewards are positive at every step, so that without it ("never") an early success would be worth less
    than dawdling; "truncated" is the textbook's rule (Pardo et al. 2018, arXiv 1712.00378)."""
    if rule == "truncated":
        return truncated & ~terminated
    return torch.full_like(truncated, rule == "always")


UPDATE_METRICS = ("policy_loss", "value_loss", "entropy", "approx_kl", "clipfrac", "grad_norm")
KL = UPDATE_METRICS.index("approx_kl")


def adapt_learning_rate(optimizer, kl: torch.Tensor, desired_kl: float) -> None:
    """Lower the policy's learning rate where the KL divergence is more than twice the desired one, raise it where it is
    less than half of it (Rudin et al. 2022, arXiv 2109.11978), within a hundredth and ten times of the first one."""
    factor = torch.where(kl > 2 * desired_kl, 1 / 1.5, torch.where(kl < desired_kl / 2, 1.5, 1.0))
    for group in optimizer.param_groups:
        if group["adapts"]:
            group["lr"].mul_(factor).clamp_(group["first_lr"] / 100, group["first_lr"] * 10)


def update_minibatch(agent, optimizer, args, obs, actions, logprobs, advantages, returns, values) -> torch.Tensor:
    """One gradient step of PPO (Schulman et al. 2017, arXiv 1707.06347, eq. 7 and 9) on tensors of `minibatch` rows, in
    each of the processes that train together: the step is that of all their rows.

    Returns the UPDATE_METRICS of the minibatch, one tensor on the device."""
    _, newlogprob, entropy, newvalue = agent.get_action_and_value(obs, actions)
    logratio = newlogprob - logprobs
    ratio = logratio.exp()
    if args.norm_adv:
        advantages = advantages - average(advantages.mean())
        advantages = advantages / (average((advantages**2).mean()).sqrt() + 1e-8)

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
    if WORLD_SIZE > 1:  # all gradients in one message
        grads = [p.grad for p in agent.parameters() if p.grad is not None]
        flat = average(torch.cat([grad.flatten() for grad in grads]))
        for grad, part in zip(grads, flat.split([grad.numel() for grad in grads])):
            grad.copy_(part.view(grad.shape))
    grad_norm = nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
    optimizer.step()

    with torch.no_grad():
        approx_kl = ((ratio - 1) - logratio).mean()  # estimator k3 of http://joschu.net/blog/kl-approx.html
        if args.desired_kl is not None:
            adapt_learning_rate(optimizer, average(approx_kl), args.desired_kl)
        clipfrac = ((ratio - 1).abs() > args.clip_coef).float().mean()
        return torch.stack([policy_loss, value_loss, entropy, approx_kl, clipfrac, grad_norm])


def call_and_look_for_waits(function) -> tuple:
    """What a function returns, and where in the code it made the host wait for the GPU, as far as torch notices."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = function()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return result, [f"{w.filename}:{w.lineno}" for w in caught if "called a synchronizing" in str(w.message)]


def as_cuda_graph(function, enabled: bool):
    """`function`, launched as one CUDA graph: a network so small computes faster than its kernels can be launched one
    by one.

    It takes nothing or an observation, never makes the host wait, and finds the tensors that it reads and writes always
    in the same place; what it returns is overwritten by the next call. The first calls run it as it is, on a stream of
    their own, as capturing wants it, and the third looks whether the host waits, in which case it is never captured;
    the next one captures it, and those after that replay.

    Raises:
        RunError: where the capture fails, after which CUDA's random numbers cannot be used any more."""
    if not enabled:
        return function
    graph, stream, num_calls, result, waits = torch.cuda.CUDAGraph(), torch.cuda.Stream(), 0, None, []
    name, run, held = function.__name__, function, None

    def launch(obs=None):
        nonlocal num_calls, result, waits, run, held
        num_calls += 1
        if obs is not None:
            if held is None:
                held = copy.deepcopy(obs)  # where the graph finds it
                run = partial(function, held)
            for k, v in as_dict(held).items():
                v.copy_(as_dict(obs)[k])
        if num_calls <= 3:
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                result, waits = call_and_look_for_waits(run) if num_calls == 3 else (run(), [])
            torch.cuda.current_stream().wait_stream(stream)
            if waits:
                tqdm.write(f"{name}: no CUDA graph, since {waits[0]} makes the host wait for the GPU")
            return result
        if waits:
            return run()
        if num_calls == 4:
            gc.collect()  # what is collected during the capture might free memory of the GPU, which ends the capture
            try:  # other threads, as those of NCCL, go on meanwhile
                with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                    result = run()
            except RuntimeError as error:
                while error.__context__:  # what stopped it, rather than that it was stopped
                    error = error.__context__
                raise RunError(f"{name}: no CUDA graph (try --no-cudagraphs): {error}") from None
        graph.replay()
        return result

    return launch


# ----- Evaluation -----------------------------------------------------------------------------------------------------


@torch.no_grad()
def evaluate(
    agent, envs, num_episodes: int, seed: int, num_steps: int, rebuild: int = 0, separately: bool = False,
    exploring: bool = False, write_frame=None,
) -> dict[str, torch.Tensor]:  # fmt: skip
    """Run whole episodes of at most `num_steps` steps with deterministic actions; episode k starts from seed + k.

    Args:
        rebuild: build new scenes, from the seeds too, in every so many rounds of all environments; 0: never.
        separately: as `start_episodes` has it.
        exploring: take random actions, as training does.
        write_frame: called at the start of an episode and after each step.

    Returns return, episode_len, and where the task has them success_once, success_at_end, fail_once, fail_at_end: a
    float tensor (num_episodes,) each, on the CPU."""
    low, high = action_bounds(envs, envs.device)
    seed_all(seed)  # for tasks that draw during an episode
    rounds = []
    for first in range(seed, seed + num_episodes, envs.num_envs):
        seeds = list(range(first, first + envs.num_envs))
        if rebuild and len(rounds) % rebuild == 0:
            envs.reset(seed=seeds, options=dict(reconfigure=True))
        obs = start_episodes(envs, seeds, separately)
        if write_frame:
            write_frame()
        running = torch.ones(envs.num_envs, dtype=torch.bool, device=envs.device)
        episodes = {}
        for step in range(1, num_steps + 1):
            action = agent.sample_action(obs)[0] if exploring else agent.get_action(obs)
            obs, _, terminated, truncated, infos = envs.step(action.clamp(low, high).nan_to_num())
            if write_frame:
                write_frame()
            ended = running & (terminated | truncated | (step == num_steps))
            running &= ~ended
            at_end = {f"{k}_at_end": infos[k] for k in ("success", "fail") if k in infos}
            for k, v in (infos["episode"] | at_end).items():
                episodes[k] = torch.where(ended, v.float(), episodes.get(k, 0.0))
        if isinstance(envs._env, RecordEpisode):
            envs._env.flush_trajectory()
        rounds.append(episodes)
    names = [k for k in (rounds[0] if rounds else {}) if k != "reward"]
    return {k: torch.cat([episodes[k] for episodes in rounds])[:num_episodes].cpu() for k in names}


def join(parts: list[dict]) -> dict[str, torch.Tensor]:
    """Episodes of several actors or processes, in order."""
    parts = [part for part in parts if part]
    return {k: torch.cat([part[k] for part in parts]) for k in parts[0]}


def interval(values: torch.Tensor, rate: bool) -> tuple[float, float]:
    """95% confidence interval of the mean of `values`: Wilson's score interval for a rate, else the normal one."""
    n, mean, z = len(values), values.double().mean().item(), 1.96
    if rate:
        centre = (mean + z**2 / (2 * n)) / (1 + z**2 / n)
        half = z / (1 + z**2 / n) * math.sqrt(mean * (1 - mean) / n + z**2 / (4 * n**2))
    else:
        centre = mean
        half = z * values.double().std().item() / math.sqrt(n) if n > 1 else math.inf
    return centre - half, centre + half


# ----- Checkpoints and results ----------------------------------------------------------------------------------------


CHECKPOINT_KEYS = {
    "agent", "optimizer", "iteration", "global_step", "best_score", "metrics_size", "wandb_id", "args", "versions",
    "world_size",
}  # fmt: skip


def save_checkpoint(path: Path, contents: dict) -> None:
    """Write beside, then rename: at any instant the file is the old checkpoint or the new one, whole.

    Raises OSError where it cannot be written."""
    buffer = io.BytesIO()
    torch.save(contents, buffer)
    with open(path.with_suffix(".tmp"), "wb") as file:
        file.write(buffer.getbuffer())
        file.flush()
        os.fsync(file.fileno())
    os.replace(file.name, path)


def load_checkpoint(path: Optional[str | Path]) -> dict:
    if path is None:
        fail("--evaluate needs --checkpoint runs/NAME/best.pt")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        fail(f"there is no checkpoint {path}")
    except Exception as error:
        fail(f"{path} is not, or no longer, a readable checkpoint: {str(error).partition('. ')[0] or 'it is empty'}")
    lacking = CHECKPOINT_KEYS - checkpoint.keys() if isinstance(checkpoint, dict) else CHECKPOINT_KEYS
    if lacking:
        fail(f"{path} is no checkpoint of this version of the script: it lacks {', '.join(sorted(lacking))}")
    return checkpoint


def load_weights(agent: nn.Module, checkpoint: dict, path: str | Path, args: Args) -> None:
    """Give the agent the weights of a checkpoint, or refuse those of another task or network."""
    expected, found = [{k: tuple(v.shape) for k, v in x.items()} for x in (agent.state_dict(), checkpoint["agent"])]
    for k in {**expected, **found}:
        if expected.get(k) != found.get(k):
            task = checkpoint["args"]["env_id"]
            fail(f"{path} ({task}) does not fit {args.env_id}: {k}: expected {expected.get(k)}, found {found.get(k)}")
    agent.load_state_dict(checkpoint["agent"])


def open_metrics(run_dir: Path):
    """metrics.jsonl, for this process alone to write: two that resume one run would write every row twice."""
    file = open(run_dir / "metrics.jsonl", "ab")
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        fail(f"another process is writing to {run_dir}: stop it first, or choose another --exp_name")
    return file


def read_metrics(run_dir: Path) -> Iterator[dict]:
    with open(run_dir / "metrics.jsonl") as file:
        yield from (json.loads(line) for line in file if line.endswith("\n"))  # a full disk may have cut one off


def add_scalars(writer, row: dict) -> None:
    for key in row.keys() - {"kind", "global_step", "time"}:
        writer.add_scalar(f"{row['kind']}/{key}", row[key], row["global_step"], walltime=row["time"])


def open_tensorboard(run_dir: Path):
    """A writer of TensorBoard events that begins with what metrics.jsonl holds: of a resumed run no row is missing, and
    none is there twice."""
    from torch.utils.tensorboard import SummaryWriter  # slow to import, and the actors need none

    for old in run_dir.glob("events.out.tfevents.*"):
        old.unlink()
    writer = SummaryWriter(str(run_dir))
    for row in read_metrics(run_dir):
        add_scalars(writer, row)
    return writer


def plot_learning_curve(run_dir: Path) -> None:
    """Draw learning_curve.png from metrics.jsonl: success, where the task knows it, and return over steps."""
    from matplotlib.figure import Figure

    points = defaultdict(list)
    for row in read_metrics(run_dir):
        for key in row.keys() & {"success_once", "return"}:
            points[key, row["kind"]].append((row["global_step"], row[key]))
    keys = sorted({key for key, _ in points}, reverse=True)
    if not keys:
        return
    figure = Figure(figsize=(5 * len(keys), 3.5), layout="constrained")
    for axis, key in zip(np.atleast_1d(figure.subplots(1, len(keys))), keys):
        for kind, style in (("train", dict(alpha=0.4)), ("eval", dict(marker="o", markersize=3))):
            if (key, kind) in points:
                axis.plot(*zip(*points[key, kind]), label={"train": "training", "eval": "evaluation"}[kind], **style)
        axis.set(title=key, xlabel="environment steps", ylim=(-0.03, 1.03) if key == "success_once" else None)
        axis.grid(alpha=0.3)
        axis.legend()
    figure.savefig(run_dir / "learning_curve.png", dpi=120)
    del figure, axis
    gc.collect()  # figures refer to themselves: megabytes that would else stay for long


# ----- Main -----------------------------------------------------------------------------------------------------------


LIMITS = (  # of numbers that are given; none may be infinite or not a number
    (1, 1e18, "num_envs num_eval_envs num_actors num_steps num_minibatches update_epochs num_eval_episodes "
              "num_eval_steps total_timesteps checkpoint_freq save_freq save_train_video_freq"),
    (1e-12, 1e12, "learning_rate desired_kl clip_coef max_grad_norm reward_scale checkpoint_minutes"),
    (0, 1e18, "seed critic_learning_rate logstd_lr_factor ent_coef vf_coef target_kl eval_freq eval_seed "
              "reconfiguration_freq eval_reconfiguration_freq"),
    (0, 1, "gamma gae_lambda stop_at_success"),
    (-20, 5, "logstd_init"),
)  # fmt: skip


def check(args: Args) -> None:
    """Refuse what cannot work, before anything is built or written; warn of what hardly can."""
    for low, high, flags in LIMITS:
        for flag in flags.split():
            if getattr(args, flag) is not None and not low <= getattr(args, flag) <= high:
                fail(f"--{flag} {getattr(args, flag)}: must lie between {low:g} and {high:g}")
    if args.num_envs % WORLD_SIZE:
        fail(f"--num_envs {args.num_envs} cannot be shared out equally among {WORLD_SIZE} processes")
    if args.num_actors > args.num_envs:
        fail(f"--num_actors {args.num_actors}: there are {args.num_envs} environments (--num_envs) to share out")
    if args.num_actors > WORLD_SIZE and args.sim_backend.startswith("physx_cuda"):
        fail(f"--num_actors {args.num_actors}: on a GPU one process simulates all environments")
    if args.num_actors % WORLD_SIZE:
        fail(f"--num_actors {args.num_actors} cannot be shared out equally among {WORLD_SIZE} processes")
    if WORLD_SIZE > 1 and args.evaluate:
        fail("--evaluate is for one process: leave out torchrun")
    if args.batch_size < args.num_minibatches * WORLD_SIZE:
        fail(f"--num_minibatches {args.num_minibatches} is more than the {args.batch_size} steps of an iteration")
    if not args.evaluate and args.num_iterations < 1:
        fail(f"--total_timesteps {args.total_timesteps} is less than one iteration of {args.batch_size} steps")
    if not 0 <= args.eval_seed < 2**31 - args.num_eval_episodes - args.num_eval_envs:
        fail("--eval_seed must be at least 0, and the seeds of all evaluation episodes below 2^31")

    # --- the machine ---
    if not re.fullmatch(r"physx_cpu|physx_cuda(:\d+)?", args.sim_backend):
        fail(f"--sim_backend {args.sim_backend}: use auto, physx_cpu, physx_cuda or physx_cuda:N")
    on_gpu = args.sim_backend != "physx_cpu"
    if args.cuda and 0 < torch.cuda.device_count() < LOCAL_WORLD_SIZE:
        fail(f"torchrun started {LOCAL_WORLD_SIZE} processes, and there are {torch.cuda.device_count()} GPUs: one each")
    if WORLD_SIZE > 1 and args.sim_backend.startswith("physx_cuda:"):
        fail(f"--sim_backend {args.sim_backend}: with torchrun each process takes a GPU of its own: physx_cuda")
    if on_gpu and (args.shader or "").startswith("rt"):
        fail(f"--shader {args.shader}: ray tracing needs CPU simulation: --sim_backend physx_cpu")
    if on_gpu and not args.cuda:
        fail(f"--sim_backend {args.sim_backend} contradicts --no-cuda")
    if on_gpu or args.cuda and Path("/proc/driver/nvidia").exists():
        try:
            torch.zeros(1, device=choose_device(args.share()) if on_gpu else f"cuda:{LOCAL_RANK}")
            if on_gpu:
                enable_gpu_physics()
        except Exception as error:  # no driver, one too old for this torch, no such device, no library
            reason = str(error).splitlines()[0]
            if on_gpu or WORLD_SIZE > 1:
                remedy = "link libcuda.so.1 as libcuda.so" if "libcuda" in reason else "see examples/check_machine.py"
                fail(f"--sim_backend {args.sim_backend}: {reason}: {remedy}, or use --sim_backend physx_cpu")
            args.cuda = False
            print(f"the GPU is not used: {reason}")
    try:
        parse_backends(args.sim_backend, args.render_backend)
    except (KeyError, ValueError, RuntimeError) as error:
        fail(f"--render_backend {args.render_backend}: {error}; --help lists what there is")
    if args.compile:
        try:
            torch.compile(lambda x: x + 1)(torch.zeros(2, device=choose_device(args.share())))
        except Exception as error:
            args.compile = False
            print(f"not compiled: {str(error).splitlines()[0]}")
    if args.track and importlib.util.find_spec("wandb") is None:
        fail("--track needs Weights & Biases: pip install wandb")

    # --- the task ---
    name = args.env_id.rpartition(":")[2]
    try:
        spec = find_task(args.env_id)
    except KeyError:
        nearest = ", ".join(difflib.get_close_matches(name, REGISTERED_ENVS)) or "none"
        fail(f"--env_id {args.env_id}: no such task; names like it: {nearest}")
    except Exception as error:  # the user's module
        fail(f"--env_id {args.env_id}: {type(error).__name__}: {error}")
    known = {"max_episode_steps"}.union(*(inspect.signature(cls.__init__).parameters for cls in spec.cls.__mro__))
    try:
        env_kwargs = dict(**json.loads(args.env_kwargs))
    except (ValueError, TypeError):
        fail(f"--env_kwargs must be a JSON object like '{{\"enhanced_determinism\": true}}', not {args.env_kwargs}")
    for k in env_kwargs:
        if hasattr(args, k):
            fail(f"--env_kwargs: {k} has a flag of its own: --{k}")
        if k not in known:
            fail(f"--env_kwargs: {name} takes no {k}, but {', '.join(sorted(known - {'self', 'args', 'kwargs'}))}")
    horizon = env_kwargs.get("max_episode_steps", spec.max_episode_steps)
    if not (horizon is None or isinstance(horizon, int) and horizon > 0):
        fail(f"--env_kwargs: max_episode_steps {horizon}: must be an integer of at least 1")
    if args.reward_mode not in (None, *spec.cls.SUPPORTED_REWARD_MODES):
        fail(f"--reward_mode {args.reward_mode}: {name} has {', '.join(spec.cls.SUPPORTED_REWARD_MODES)}")
    # not the parameters that it inherits: it may fix them
    own = inspect.signature(spec.cls.__init__).parameters.get("robot_uids")
    robots = args.robot_uids or spec.default_kwargs.get("robot_uids", own and own.default)
    assets = [name]
    robots = robots.split(",") if isinstance(robots, str) else robots
    robots = robots if isinstance(robots, (tuple, list)) else [robots]
    check_observations(args, spec, robots)
    for robot in robots:
        if not isinstance(robot, str) or robot == "none" and not args.robot_uids:
            continue  # tasks may bring a class of their own
        if robot not in REGISTERED_AGENTS:
            fail(f"--robot_uids {robot}: no such robot, but {spec.cls.SUPPORTED_ROBOTS or [*REGISTERED_AGENTS]}")
        assets.append(robot)
        with contextlib.suppress(Exception):  # some robots know their controllers only once they are built
            agent_cls = REGISTERED_AGENTS[robot].agent_cls
            modes = agent_cls.__new__(agent_cls)._controller_configs
            if args.control_mode not in (None, *modes):
                fail(f"--control_mode {args.control_mode}: {robot} has {', '.join(modes)}")
    for asset in assets:
        if not all(map(is_data_source_downloaded, expand_data_group_into_individual_data_source_ids(asset))):
            fail(f"--env_id {args.env_id} needs assets: python -m mani_skill.utils.download_asset {asset}")
    if args.reconfiguration_freq and args.partial_reset and args.num_envs > args.num_actors and not args.evaluate:
        fail("--reconfiguration_freq rebuilds all environments of a batch at once: it needs --no-partial_reset")

    # --- the folder ---
    run_dir = find_run_dir(args)
    try:
        if args.resume and RANK == 0:
            open_metrics(run_dir).close()
        if not (args.resume or args.evaluate):
            metrics = run_dir / "metrics.jsonl"
            if (run_dir / "last.pt").exists() or metrics.exists() and metrics.stat().st_size > 0:
                fail(f"{run_dir} holds a run: continue it with --resume {run_dir}, or choose another --exp_name")
        absolute = Path(os.path.abspath(run_dir))
        existing = next(path for path in (absolute, *absolute.parents) if path.exists())
        if not (existing.is_dir() and os.access(existing, os.W_OK)):
            fail(f"{run_dir} cannot be written: {existing} is no folder, or not yours to write")
    except OSError as error:
        fail(f"{run_dir} cannot be written: {error}")

    # --- what may be meant otherwise ---
    if horizon and args.num_eval_steps and args.num_eval_steps < horizon:
        print(f"note: --num_eval_steps {args.num_eval_steps} ends before an episode does: all {horizon} steps are run")
    if not args.evaluate:
        if (args.reward_mode or default_reward_mode(spec.cls)) in ("sparse", "none"):
            print(f"note: the reward of {name} is not dense: PPO may never meet a success to learn from")
        if horizon and args.gamma < 1 and not horizon / 25 <= 1 / (1 - args.gamma) <= 10 * horizon:
            print(f"note: --gamma {args.gamma} looks {1 / (1 - args.gamma):.0f} steps ahead, and episodes of {name} "
                  f"have {horizon}: about {1 - 10 / max(horizon, 20):.3g} may suit it better")  # fmt: skip


def enable_gpu_physics() -> None:
    """SAPIEN downloads PhysX's GPU library when it is first needed. The processes of torchrun do this one by one."""
    with contextlib.ExitStack() as closing:
        if fcntl is not None:
            lock = closing.enter_context(open(Path(tempfile.gettempdir()) / f"physx-{os.getuid()}.lock", "w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        sapien.physx.enable_gpu()


def check_observations(args: Args, spec, robots: list) -> None:
    if args.obs_mode not in spec.cls.SUPPORTED_OBS_MODES:
        fail(f"--env_id {args.env_id} has no observations of the state, only {', '.join(spec.cls.SUPPORTED_OBS_MODES)}")


def choose_device(args: Args) -> torch.device:
    """Where the agent learns: with the simulation on its GPU, else on any GPU there is, else on the CPU."""
    backend, _, index = args.sim_backend.partition(":")
    if backend == "physx_cuda" or args.cuda and torch.cuda.is_available():
        return torch.device(f"cuda:{index or LOCAL_RANK}")
    return torch.device("cpu")


def summary(metrics: dict) -> list[str]:
    """The metrics that a person follows, in a few words."""
    names = {"success_once": "success", "return": "return", "episode_len": "length"}
    return [f"{name} {metrics[key]:.3g}" for key, name in names.items() if key in metrics]


def action_bounds(envs, device) -> tuple[torch.Tensor, torch.Tensor]:
    space = envs.single_action_space
    return torch.as_tensor(space.low, device=device), torch.as_tensor(space.high, device=device)


def how_to_render(on_gpu: bool) -> str:
    if on_gpu:
        return "NVIDIA_DRIVER_CAPABILITIES=all in a container"
    return "apt install mesa-vulkan-drivers, 23.1 or newer, which Debian 12 has in its backports"


def prepare_rendering(args: Args) -> None:
    """Render on the GPU that simulates; switch videos off, with one line, where nothing can render them."""
    on_gpu = args.sim_backend != "physx_cpu"
    if on_gpu and args.render_backend == "gpu":
        args.render_backend = args.sim_backend.replace("physx_cuda", "gpu")
    if args.render_backend == "none":
        args.capture_video, args.save_train_video_freq = False, None
    elif RENDER_DEVICE is None or (on_gpu and not RENDER_DEVICE.is_cuda()):
        if args.capture_video or args.save_train_video_freq:
            print(f"no videos: there is no Vulkan device to render them (to get one: {how_to_render(on_gpu)})")
        args.capture_video, args.save_train_video_freq = False, None


def evaluate_checkpoint(args: Args, closing: contextlib.ExitStack) -> int:
    """--evaluate: build the evaluation environments and the agent, nothing else; print, film and write the results."""
    run_dir = find_run_dir(args)
    prepare_rendering(args)
    torch.set_num_threads(1)
    if args.sim_backend != "physx_cpu":
        torch.cuda.set_device(choose_device(args))
    actors = Actors(args, run_dir / "test_videos")
    closing.callback(actors.close)
    envs = actors.local.eval_envs
    agent = Agent(envs.single_observation_space, envs.single_action_space, args).to(envs.device)
    load_weights(agent, load_checkpoint(args.checkpoint), args.checkpoint, args)
    actors.connect(agent)
    num_episodes, num_steps = evaluation_size(envs, args)
    episodes = join(actors.call("evaluate", num_episodes, args.eval_seed, num_steps, rebuilding(args)))
    film = Film(args, run_dir / "test_videos")
    closing.callback(film.close)
    for seed in range(args.eval_seed, args.eval_seed + 4, film.num_envs) if args.capture_video else ():
        film.record(agent, f"seed_{seed}", num_steps, seed)
    actors.close()  # which completes the trajectories
    videos = sorted((run_dir / "test_videos").glob("seed_*.mp4"))

    results = {"env_id": args.env_id, "num_episodes": num_episodes, "eval_seed": args.eval_seed}
    print(f"{args.env_id} on {args.sim_backend}, {num_episodes} episodes from seed {args.eval_seed} on, 95% intervals:")
    for key, values in episodes.items():
        low, high = interval(values, rate=key.startswith(("success", "fail")))
        results |= {key: values.mean().item(), f"{key}_interval": [low, high]}
        print(f"  {key:<16}{results[key]:8.3f}  [{low:.3f}, {high:.3f}]")
    (run_dir / "eval.json").write_text(json.dumps(results, indent=2) + "\n")
    print(f"written: {', '.join(map(str, [run_dir / 'eval.json', *videos]))}")
    return 0


@torch.no_grad()
def rollout(agent, envs, storage: dict, obs, args: Args, sample_action):
    """Act for num_steps in every environment of one actor, and write what happens into its columns of the storage.

    Args:
        storage: obs, actions, logprobs, rewards, dones, values and next_values, (num_steps, num_envs, ...) each;
            next_values[t] is the value of the true next observation of step t (of the final one where the episode
            ended, or zero where its end is not bootstrapped).
        obs: (num_envs, obs_dim), the first observation.
        sample_action: agent.sample_action, or a CUDA graph of it.

    Returns:
        the next observation, and the sums over the episodes that ended of what is known of each: a dict of scalars."""
    low, high = action_bounds(envs, envs.device)
    final_values = torch.zeros_like(storage["next_values"])
    sums = {"num_episodes": torch.zeros((), device=envs.device)}
    for step in range(args.num_steps):
        action, logprob = sample_action(obs)
        storage["obs"][step], storage["actions"][step], storage["logprobs"][step] = obs, action, logprob
        # the simulator takes no NaN; the observations keep it, and a check finds it there
        obs, reward, terminated, truncated, infos = envs.step(action.clamp(low, high).nan_to_num())
        done = terminated | truncated
        storage["rewards"][step] = reward * args.reward_scale
        storage["dones"][step] = done
        if "final_observation" in infos:  # some episodes ended, and obs is the first of the next ones there
            counts = bootstraps(args.bootstrap_at_done, terminated, truncated)
            final_values[step] = torch.where(counts, agent.get_value(infos["final_observation"]), 0.0)
            final_infos = {"num_episodes": torch.ones_like(reward), **infos["final_info"]["episode"]}
            for key, value in infos["final_info"].items():  # a task's own numbers, such as is_grasped
                if isinstance(value, torch.Tensor) and value.shape == done.shape:
                    final_infos[f"final_{key}"] = value
            for key, value in final_infos.items():
                sums[key] = sums.get(key, 0.0) + torch.where(done, value.float(), 0.0).sum()
    storage["values"].copy_(agent.get_value(storage["obs"].flatten(0, 1)).view_as(storage["values"]))
    following = torch.cat([storage["values"][1:], agent.get_value(obs)[None]])
    storage["next_values"].copy_(torch.where(storage["dones"].bool(), final_values, following))
    return obs, sums


def train(args: Args, closing: contextlib.ExitStack) -> int:
    """The training run, from the folder to the last checkpoint; the loop stands here in one piece.

    However it ends from there on, `closing` keeps what was learned and ends the actors. Returns the exit code."""
    # --- environments, agent ---
    for s in STOP_SIGNALS:
        closing.callback(signal.signal, s, signal.getsignal(s))
    run_dir = find_run_dir(args)
    given = asdict(args)  # before it is fitted to this machine: a resumed run may be on another
    device = choose_device(args.share())
    if device.type == "cuda":
        torch.cuda.set_device(device)  # where CUDA graphs are captured
    if WORLD_SIZE > 1:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
        closing.callback(dist.destroy_process_group)
        args = gather(args)[0]  # the machines may differ in what is left to them
        if RANK > 0:  # the first alone leaves something behind
            run_dir = Path(closing.enter_context(tempfile.TemporaryDirectory()))
    share = args.share()
    prepare_rendering(share)
    resumed = load_checkpoint(args.resume) if args.resume else {}
    size = resumed.get("world_size", WORLD_SIZE)
    if size != WORLD_SIZE:
        fail(f"--resume: the run has {size} processes, not {WORLD_SIZE}: torchrun --nproc_per_node={size} ...")
    first_iteration, global_step = resumed.get("iteration", 0), resumed.get("global_step", 0)
    if first_iteration > args.num_iterations:
        fail(f"--total_timesteps {args.total_timesteps} is less than the {global_step} steps of {args.resume}")
    best_score = resumed.get("best_score", [-math.inf])
    if resumed and (run_dir / "best.pt").exists():  # which may be newer than the checkpoint
        best_score = max(best_score, load_checkpoint(run_dir / "best.pt")["best_score"])
    torch.backends.cudnn.deterministic = args.torch_deterministic
    torch.set_num_threads(1)  # in rollouts idle threads would spin on cores that the simulation needs
    seed_all(args.seed)  # for tasks that draw while they are built

    actors = Actors(share, run_dir / "videos")
    closing.callback(actors.close)
    envs = actors.local.envs
    obs_space, action_space = envs.single_observation_space, envs.single_action_space
    ends_early = share.partial_reset and {"success", "fail"} & envs.reset()[1].keys()
    if ends_early and not actors.local.resets_some:
        fail(f"{args.env_id} cannot reset some of several environments: --num_actors {args.num_envs} gives each a "
             "process of its own; or reset all together: --no-partial_reset")  # fmt: skip

    seed_all(args.seed)  # the same weights however many environments drew something
    agent = Agent(obs_space, action_space, args).to(device)
    lr = args.learning_rate
    critic_lr = lr if args.critic_learning_rate is None else args.critic_learning_rate
    named, adapts = [*agent.named_parameters()], args.desired_kl is not None
    actor = [p for name, p in named if not name.startswith(("critic", "actor_logstd"))]  # with features they share
    critic = [p for name, p in named if name.startswith("critic")]
    groups = [
        {"params": actor, "lr": lr, "adapts": adapts},
        {"params": [agent.actor_logstd], "lr": lr * args.logstd_lr_factor, "adapts": adapts},
        {"params": critic, "lr": critic_lr, "adapts": False},
    ]
    for group in groups:
        group["first_lr"] = group["lr"]
    optimizer = torch.optim.Adam(groups, eps=1e-5, fused=True)

    def load_optimizer(state: dict) -> None:
        optimizer.load_state_dict(copy.deepcopy(state))
        for group in optimizer.param_groups:  # the learning rate is where a CUDA graph finds it
            group |= {"lr": torch.tensor(float(group["lr"]), device=device), "capturable": device.type == "cuda"}

    load_optimizer(resumed.get("optimizer", optimizer.state_dict()))
    if resumed:
        load_weights(agent, resumed, args.resume, args)
    elif args.checkpoint:
        load_weights(agent, load_checkpoint(args.checkpoint), args.checkpoint, args)

    if WORLD_SIZE > 1:  # the same weights, whatever each machine made of the seed
        agent.load_state_dict(gather({k: v.cpu() for k, v in agent.state_dict().items()})[0])
    num_eval_episodes, max_eval_steps = evaluation_size(actors.local.eval_envs, share)

    # --- storage: where the environments are; on another device the learner has a copy of it, and of the agent ---
    shape = (args.num_steps, share.num_envs)
    names = ("logprobs", "rewards", "dones", "values", "next_values")
    storage = {name: torch.zeros(shape, device=envs.device) for name in names}
    storage["obs"] = torch.zeros(*shape, *obs_space.shape, device=envs.device)
    storage["actions"] = torch.zeros(*shape, *action_space.shape, device=envs.device)
    one_device = envs.device.type == device.type
    on_device = storage if one_device else {k: v.to(device) for k, v in storage.items()}
    acting_agent = agent if one_device else copy.deepcopy(agent).to(envs.device)
    cuda_graph = partial(as_cuda_graph, enabled=args.cudagraphs and device.type == "cuda")
    sample_action = acting_agent.sample_action
    if args.compile:
        sample_action = torch.compile(sample_action, dynamic=False)
    if one_device:
        sample_action = cuda_graph(sample_action)
    actors.connect(acting_agent, storage, sample_action)
    if args.compile:
        agent.get_action_and_value = torch.compile(agent.get_action_and_value, dynamic=False)
    film, train_film = Film(share, run_dir / "videos"), Film(share, run_dir / "train_videos")
    closing.callback(film.close)
    closing.callback(train_film.close)

    # --- logging ---
    run_dir.mkdir(parents=True, exist_ok=True)
    metrics_file, writer = open_metrics(run_dir), None
    packages = ("mani-skill", "sapien", "torch", "gymnasium", "numpy")
    about = {
        "args": asdict(args),
        "versions": {"python": platform.python_version()} | {p: importlib.metadata.version(p) for p in packages},
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else f"{num_cores()} CPU core(s)",
        "command": shlex.join(sys.argv),
    }
    wandb, wandb_id = None, resumed.get("wandb_id")
    if share.track:
        import wandb

        wandb_id = wandb.init(
            project=args.wandb_project_name, entity=args.wandb_entity, group=args.wandb_group, name=run_dir.name,
            config=about, save_code=True, id=wandb_id, resume="allow",
        ).id  # fmt: skip
        closing.push(lambda error, *_: wandb.finish(exit_code=int(error is not None)))
    (run_dir / "args.json").write_text(json.dumps(about, indent=2) + "\n")
    kept = (run_dir / "metrics.jsonl").read_bytes()[: resumed.get("metrics_size", 0)]  # later steps are done again
    metrics_file.truncate(kept.rfind(b"\n") + 1)
    metrics_file.seek(0, os.SEEK_END)

    @closing.callback
    def close_files():
        for file in (metrics_file, writer):
            with contextlib.suppress(OSError, AttributeError):  # a full disk, of which was told; no writer yet
                file.close()

    bar_format = "{percentage:3.0f}%|{bar:20}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]{postfix}"
    total = args.num_iterations * args.batch_size
    hidden = None if RANK == 0 else True  # None: where there is no terminal
    bar = tqdm(total=total, initial=global_step, dynamic_ncols=True, disable=hidden, bar_format=bar_format)
    closing.callback(bar.close)
    processes = f" in {WORLD_SIZE} processes" * (WORLD_SIZE > 1)
    where = f"on {args.sim_backend}{processes}, learning on {about['device']}"
    bar.write(f"{args.env_id}: {args.num_envs} environments {where}")
    bar.write(f"resuming {run_dir} at step {global_step:,}" if resumed else f"writing to {run_dir}")

    def log(kind: str, metrics: dict) -> None:
        nonlocal writer
        finite = {k: v for k, v in metrics.items() if math.isfinite(v)}
        row = {"kind": kind, "global_step": global_step, "time": time.time(), **finite}
        try:
            metrics_file.write(json.dumps(row).encode() + b"\n")
            metrics_file.flush()
            if writer is None:
                writer = open_tensorboard(run_dir)
            else:
                add_scalars(writer, row)
        except OSError:  # the file keeps the row for the next flush; the writer is made anew from the file
            writer = None
            raise
        finally:
            if wandb:
                wandb.log({f"{kind}/{k}": v for k, v in finite.items()}, step=global_step)

    def attempt(what: str, function, *arguments) -> bool:
        """Write something; where that fails, as on a full disk, say so and go on, unless it fails again and again."""
        try:
            function(*arguments)
            failures[what] = 0
            return True
        except OSError as error:
            failures[what] += 1
            bar.write(f"{what} could not be written, training goes on: {error}")
            if failures[what] == MAX_FAILURES:
                raise RunError(f"{what} could not be written {MAX_FAILURES} times in a row: {error}") from None
        return False

    def save(name: str, contents: dict) -> bool:
        return not share.save_model or attempt(name, save_checkpoint, run_dir / name, contents)

    # --- what the learner makes of it ---
    advantages, returns = torch.zeros(2, *shape, device=device)
    permutation = torch.zeros(share.batch_size, dtype=torch.long, device=device)
    flat = {name: x.flatten(0, 1) for name, x in on_device.items()}  # the same memory
    b_obs = flat["obs"]
    b_actions, b_logprobs, b_values = [flat[name] for name in ("actions", "logprobs", "values")]
    batch = [b_actions, b_logprobs, advantages.flatten(), returns.flatten(), b_values]

    # --- what needs no look from the host, and is launched as a whole where that is faster ---
    @cuda_graph
    @torch.no_grad()
    def estimate_advantages():
        rewards, values, next_values, dones = [on_device[k] for k in ("rewards", "values", "next_values", "dones")]
        gae = compute_gae(rewards, values, next_values, dones, args.gamma, args.gae_lambda, args.finite_horizon_gae)
        advantages.copy_(gae[0])
        returns.copy_(gae[1])

    def update_epoch():
        """Every minibatch of a permutation of the batch; returns the UPDATE_METRICS of each, a row a minibatch."""
        mb_metrics = []
        for mb_inds in permutation.split(share.minibatch_size)[: args.num_minibatches]:
            minibatch = [x[mb_inds] for x in batch]
            mb_metrics.append(update_minibatch(agent, optimizer, args, b_obs[mb_inds], *minibatch))
        return average(torch.stack(mb_metrics))

    launch_update_epoch = cuda_graph(update_epoch)

    @closing.callback
    def drop_graph():  # the process group waits for those that hold its operations
        nonlocal launch_update_epoch
        launch_update_epoch = None

    # PhysX remembers contacts of earlier episodes: what is to be repeatable to the last bit starts in new scenes, and a
    # batch builds the objects of its task once: to meet others it is rebuilt where that is cheap
    rebuild = args.sim_backend == "physx_cpu" and (args.exact_resume or varies_objects(find_task(args.env_id)))

    # --- how it may end ---
    finished, signalled, stopped_by, failures = False, 0, 0, Counter()
    last_line = last_saved = time.monotonic()

    def stop(signum, frame):
        nonlocal signalled
        signalled = signum
        for s in STOP_SIGNALS:
            signal.signal(s, signal.SIG_DFL)  # a second one ends the process at once
        os.write(2, f"\n{signal.Signals(signum).name}: stopping after this iteration; again: at once\n".encode())

    for s in STOP_SIGNALS:
        signal.signal(s, stop)

    @closing.callback
    def save_last():
        if finished or not args.exact_resume:  # with it, a run goes on from a boundary only
            save("last.pt", snapshot)

    for iteration in range(first_iteration, args.num_iterations + 1):  # the number of finished updates
        stopped_by = max(gather(signalled))  # for all processes to stop at the same iteration
        # --- checkpoint: here a resumed run goes on, and to here an update that goes wrong is taken back ---
        snapshot = {
            "agent": copy.deepcopy(agent.state_dict()), "optimizer": copy.deepcopy(optimizer.state_dict()),
            "iteration": iteration, "global_step": global_step, "best_score": best_score,
            "metrics_size": metrics_file.tell(), "wandb_id": wandb_id, "args": given, "versions": about["versions"],
            "world_size": WORLD_SIZE,
        }  # fmt: skip
        minutes = (time.monotonic() - last_saved) / 60
        if iteration % args.checkpoint_freq == 0 or (minutes > args.checkpoint_minutes and not args.exact_resume):
            save("last.pt", snapshot)
            last_saved = time.monotonic()
        if args.save_freq and iteration > 0 and iteration % args.save_freq == 0:
            save(f"iteration_{iteration}.pt", snapshot)

        # --- evaluate: the untrained policy, every eval_freq iterations, and the final policy ---
        finished = iteration == args.num_iterations and not stopped_by
        if finished or not stopped_by and (iteration == 0 or args.eval_freq and iteration % args.eval_freq == 0):
            if acting_agent is not agent:
                acting_agent.load_state_dict(agent.state_dict())
            first = args.eval_seed + RANK * num_eval_episodes
            episodes = actors.call("evaluate", num_eval_episodes, first, max_eval_steps, rebuilding(args))
            episodes = join(gather(join(episodes)))
            metrics = {key: value.mean().item() for key, value in episodes.items()}
            attempt("metrics.jsonl", log, "eval", metrics | {"num_episodes": len(episodes["return"])})
            if share.capture_video:
                film.record(acting_agent, f"step_{global_step:09d}", max_eval_steps, args.eval_seed)
            score = [metrics[key] for key in ("success_once", "return") if key in metrics]
            best = score > best_score and all(map(math.isfinite, score))
            bar.write(f"step {global_step:>9,}  evaluation: {', '.join(summary(metrics))}" + "  (best)" * best)
            if best and save("best.pt", snapshot | {"best_score": score}):
                best_score = score
            if iteration > 0:
                attempt("learning_curve.png", plot_learning_curve, run_dir)
            if args.stop_at_success is not None and metrics.get("success_once", 0) >= args.stop_at_success:
                finished = True
        if finished or stopped_by:
            break

        # --- rollout: num_steps in every environment, of all actors at once ---
        start = time.perf_counter()
        boundary = (args.exact_resume or rebuild) and iteration % args.checkpoint_freq == 0
        restart = iteration == first_iteration or boundary
        if acting_agent is not agent:
            acting_agent.load_state_dict(agent.state_dict())
        results = actors.call("rollout", iteration, restart, restart and rebuild)
        if on_device is not storage:
            for k, v in storage.items():
                on_device[k].copy_(v)
        estimate_advantages()
        # numbers that are not finite must not reach the weights; those of any process are those of all
        problem = next(filter(None, gather(next(filter(None, [p for _, p in results]), None))), None)
        rollout_time = time.perf_counter() - start

        # --- update: update_epochs times over the batch, in shuffled minibatches ---
        torch.set_num_threads(num_update_threads())
        if args.anneal_lr:
            for group in optimizer.param_groups:
                if not group["adapts"]:
                    group["lr"].fill_(group["first_lr"] * (1 - iteration / args.num_iterations))
        update_metrics = []
        for _ in range(0 if problem else args.update_epochs):
            torch.randperm(share.batch_size, out=permutation)
            update_metrics.append(launch_update_epoch().clone())
            last_kl = update_metrics[-1][-1, KL]
            if args.target_kl is not None and last_kl > args.target_kl:  # the host waits, once an epoch
                break
        if args.norm_obs and not problem:  # after the update, for which the rollout's log-probabilities must stay valid
            agent.update_normalization(b_obs)
        torch.set_num_threads(1)
        explained_variance = average(1 - (returns.flatten() - b_values).var() / returns.var().clamp(min=1e-8))
        global_step += args.batch_size

        # --- log: here the host waits for the device ---
        metrics = {}
        if update_metrics:
            metrics = dict(zip(UPDATE_METRICS, torch.cat(update_metrics).mean(0).tolist()))
            healthy = torch.stack([x.isfinite().all() for x in agent.state_dict().values()]).all()
            if not (healthy and all(map(math.isfinite, metrics.values()))):
                problem = "non-finite loss, gradient or normalisation"
                agent.load_state_dict(snapshot["agent"])
                load_optimizer(snapshot["optimizer"])
                launch_update_epoch = cuda_graph(update_epoch)  # the one before knows the optimizer's former tensors
        sums = Counter()
        of_actors = [dict(zip(x, torch.stack([*x.values()]).tolist())) for x, _ in results]
        for of_actor in itertools.chain(*gather(of_actors)):
            sums.update(of_actor)
        num_episodes = sums.pop("num_episodes")
        if num_episodes:
            metrics = {key: total / num_episodes for key, total in sums.items()} | metrics
        elapsed = time.perf_counter() - start
        metrics |= {
            "iteration": iteration + 1,
            "num_episodes": int(num_episodes),
            "explained_variance": explained_variance.item(),
            "learning_rate": optimizer.param_groups[0]["lr"].item(),
            "update_skipped": int(problem is not None),
            "sps": args.batch_size / elapsed,
            "rollout_time": rollout_time,
            "update_time": elapsed - rollout_time,
            "memory_mb": psutil.Process().memory_info().rss / 2**20,
            "actors_memory_mb": actors.memory(),
        }
        if device.type == "cuda":
            free, total = torch.cuda.mem_get_info(device)
            metrics["gpu_memory_mb"] = (total - free) / 2**20
        attempt("metrics.jsonl", log, "train", metrics)
        failures["update"] = failures["update"] + 1 if problem else 0
        if problem:
            bar.write(f"iteration {iteration + 1}: {problem}: no update")
            if failures["update"] == MAX_FAILURES:
                raise RunError(f"no update in {MAX_FAILURES} iterations in a row: {problem}")
        status = ", ".join([f"{metrics['sps']:,.0f} steps/s", *summary(metrics)])
        bar.set_postfix_str(status, refresh=False)
        bar.update(args.batch_size)
        if bar.disable and time.monotonic() - last_line > 10:  # no terminal
            print(f"step {global_step:>9,}  training: {status}", flush=True)
            last_line = time.monotonic()

        if share.save_train_video_freq and iteration % share.save_train_video_freq == 0:
            train_film.record(acting_agent, f"step_{global_step:09d}", max_eval_steps, args.eval_seed, exploring=True)

    if not finished:
        return 128 + stopped_by
    closing.close()
    print(f"learning curve, videos and metrics are in {run_dir}")
    if args.save_model:
        print("to evaluate the best policy on other episodes:")
        print(f"    python {sys.argv[0]} --evaluate --checkpoint {run_dir / 'best.pt'} --eval_seed 1000")
    return 0


def main(argv: list[str]) -> int:
    if RANK > 0:  # the first speaks for all, but for what goes wrong
        sys.stdout = open(os.devnull, "w")
    args = parse_args(argv)
    check(args)
    try:
        with contextlib.ExitStack() as closing:
            code = (evaluate_checkpoint if args.evaluate else train)(args, closing)
    except RunError as error:
        print(f"{SCRIPT.name}: {error}", file=sys.stderr)
        code = 1
    except KeyboardInterrupt:  # before the loop, which has a better way to stop
        code = 130
    except Exception:
        traceback.print_exc()
        code = 1
    last = find_run_dir(args) / "last.pt"
    if code and last.exists() and not args.evaluate and RANK == 0:
        print(f"{last} is safe; to go on: python {sys.argv[0]} --resume {last.parent}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
