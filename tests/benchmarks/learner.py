"""How long ppo.py takes without the simulation: its update, and its rollout except for the environments' steps.

    uv run tests/benchmarks/learner.py                                  # on a GPU
    uv run tests/benchmarks/learner.py --no-cuda --shapes 16x100 --num_minibatches 8        # on a CPU

It trains on environments that consist only of tensors, with observations of 42 numbers and actions of 8, inside the
real ManiSkillVectorEnv. The variants (step by step, compiled, CUDA graphs) take turns, because the speed of a shared
machine drifts. The first iterations of each run warm up. The table also shows two lower limits: the time of the
networks' matrix products alone, at the same shapes, and, on a GPU, the time to launch 100 kernels per minibatch one by
one.
"""

import argparse
import contextlib
import io
import json
import statistics
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))
import ppo

OBS, ACT, LIMIT = 42, 8, 50
VARIANTS = {
    "step by step": "--no-cudagraphs",
    "compiled": "--no-cudagraphs --compile",
    "graphs": "--cudagraphs",
    "compiled, graphs": "--cudagraphs --compile",
}


class NoSimulation(gym.Env):
    """As cheap as an environment can be: constant random observations and rewards. Episodes end at different times."""

    reconfiguration_freq, max_episode_steps, metadata = 0, LIMIT, {}
    scene = SimpleNamespace(gpu_sim_enabled=False)

    def __init__(self, num_envs, device):
        self.num_envs, self.device = num_envs, device
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (OBS,), np.float32)
        self.single_action_space = gym.spaces.Box(-1, 1, (ACT,), np.float32)
        batch = partial(gym.vector.utils.batch_space, n=num_envs)
        self.observation_space, self.action_space = (
            batch(self.single_observation_space),
            batch(self.single_action_space),
        )
        self.obs = torch.randn(num_envs, OBS, device=device)
        self.reward = torch.rand(num_envs, device=device)
        self.elapsed_steps = torch.randint(LIMIT, (num_envs,), device=device, dtype=torch.int32)
        self.never = torch.zeros(num_envs, dtype=torch.bool, device=device)

    def info(self):
        return {"success": self.never, "elapsed_steps": self.elapsed_steps}

    def reset(self, *, seed=None, options=None):
        if "env_idx" in (options or {}):
            self.elapsed_steps[options["env_idx"]] = 0
        return self.obs.clone(), self.info()

    def step(self, action):
        self.elapsed_steps += 1
        return self.obs.clone(), self.reward.clone(), self.never.clone(), self.elapsed_steps >= LIMIT, self.info()


def make_envs(args, num_envs, seed, evaluation=False, record=None):
    env = NoSimulation(num_envs, ppo.choose_device(args))
    return ppo.ManiSkillVectorEnv(env, auto_reset=not evaluation, record_metrics=True)


def train(flags, warm_up):
    """Train in this process; returns the rows logged after the first `warm_up` iterations, a list of dicts."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        args = ppo.parse_args([*flags.split(), "--exp_name", f"{folder}/x", "--eval_freq", "0", "--num_eval_envs", "1",
                               "--num_eval_episodes", "1", "--num_actors", "1", "--target_kl", "None",
                               "--no-capture_video"])  # fmt: skip
        with contextlib.ExitStack() as closing:
            ppo.train(args, closing)
        rows = map(json.loads, (Path(folder) / "x/metrics.jsonl").read_text().splitlines())
        return [row for row in rows if row["kind"] == "train"][warm_up:]


def run(flags, warm_up):
    """Train; returns the median seconds that the rollout and the update of an iteration take."""
    rows = train(flags, warm_up)
    return [statistics.median(row[k] for row in rows) for k in ("rollout_time", "update_time")]


def timed(function, device, repetitions=5):
    """Returns the median seconds of a call."""
    seconds = []
    for _ in range(repetitions + 2):
        if device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        function()
        if device.type == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[2:])


def products(rows, device):
    """Returns a function that computes the matrix products of a forward and backward pass of both networks on `rows`
    observations."""
    sizes = [(OBS, 256), (256, 256), (256, 256), (256, ACT)] + [(OBS, 256), (256, 256), (256, 256), (256, 1)]
    operands = [[torch.randn(*shape, device=device) for shape in ((rows, i), (i, o), (rows, o))] for i, o in sizes]

    def compute():
        for x, weight, grad in operands:
            x @ weight, x.T @ grad, grad @ weight.T

    return compute


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", nargs="+", default=["4096x4", "1024x50", "512x50"], help="environments x steps")
    parser.add_argument("--num_minibatches", type=int, default=32)
    parser.add_argument("--update_epochs", type=int, default=8)
    parser.add_argument("--variants", nargs="+", default=None, choices=VARIANTS)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--iterations", type=int, default=8, help="iterations of each run; the first three warm up")
    parser.add_argument("--no-cuda", action="store_true")
    options = parser.parse_args()
    ppo.make_envs = make_envs
    cuda = torch.cuda.is_available() and not options.no_cuda
    device = torch.device("cuda:0" if cuda else "cpu")
    variants = options.variants or list(VARIANTS)[: None if cuda else 2]
    print(f"{torch.cuda.get_device_name() if cuda else f'CPU, {ppo.num_cores()} cores'}, torch {torch.__version__}; "
          f"{options.update_epochs} epochs of {options.num_minibatches} minibatches; milliseconds, median (lowest to "
          f"highest) of {options.repetitions} runs")  # fmt: skip
    for shape in options.shapes:
        num_envs, num_steps = map(int, shape.split("x"))
        flags = (f"--num_envs {num_envs} --num_steps {num_steps} --num_minibatches {options.num_minibatches} "
                 f"--update_epochs {options.update_epochs} --sim_backend physx_cpu --no-norm_obs "
                 f"--total_timesteps {num_envs * num_steps * options.iterations}")  # fmt: skip
        flags += "" if cuda else " --no-cuda"
        times = {name: [] for name in variants}
        steps_alone = []
        for repetition in range(options.repetitions):
            for name in variants if repetition % 2 else variants[::-1]:
                times[name].append(run(f"{flags} {VARIANTS[name]}", 3))
            torch.set_num_threads(1)
            envs = make_envs(ppo.parse_args(flags.split()), num_envs, 0)
            envs.reset()
            action = torch.zeros(num_envs, ACT, device=device)
            steps_alone.append(
                timed(lambda envs=envs, action=action: [envs.step(action) for _ in range(50)], device) / 50
            )
        torch.set_num_threads(max(1, int(ppo.num_cores() * ppo.UPDATE_THREADS_PER_CORE)))
        alone = statistics.median(steps_alone)
        minibatches = options.update_epochs * options.num_minibatches
        rows = num_envs * num_steps // options.num_minibatches
        floor = timed(products(rows, device), device) * minibatches
        print(f"\n{num_envs} environments, {num_steps} steps: minibatches of {rows}")
        print(f"  {'':20}{'update':>26}{'speedup over the first':>26}{'rollout minus env.step, per step':>36}")
        for name in variants:
            rollout, update = zip(*times[name])
            ratios = [first[1] / own[1] for first, own in zip(times[variants[0]], times[name])]
            beyond = [1000 * (seconds / num_steps - alone) for seconds in rollout]
            cells = [f"{statistics.median(x):.{n}f} ({min(x):.{n}f} to {max(x):.{n}f})"
                     for x, n in (([1000 * u for u in update], 1), (ratios, 2), (beyond, 3))]  # fmt: skip
            print(f"  {name:20}{cells[0]:>26}{cells[1]:>26}{cells[2]:>36}")
        print(f"  {'products alone':20}{1000 * floor:>14.1f}")
        print(f"  {'env.step alone':20}{'':52}{1000 * alone:>24.3f}")
        if cuda:
            x = torch.zeros(1, device=device)
            launches = timed(lambda x=x: [x.add_(1) for _ in range(1000)], device) / 1000
            print(f"  {'100 launches per minibatch, one by one':40}{1000 * launches * 100 * minibatches:>10.1f}")


if __name__ == "__main__":
    main()
