import os

# several processes share the cores: threads that wait by spinning would take them from each other
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import contextlib
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import batched_env
import gymnasium as gym
import numpy as np
import pytest
import torch

import ppo

ROOT = Path(__file__).parent.parent
NO_VULKAN = {"VK_DRIVER_FILES": "/nonexistent", "VK_ICD_FILENAMES": "/nonexistent"}


def run_script(*arguments, cwd, env=None, script=ROOT / "ppo.py", timeout=600):
    """Run ppo.py as a user would; returns the finished process with its output as text."""
    return subprocess.run(
        [sys.executable, str(script), *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **(env or {})},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout,
    )


def pytest_runtest_setup(item):
    if item.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    if item.get_closest_marker("render"):
        if ppo.RENDER_DEVICE is None:
            # CI installs software Vulkan: a renderer that is missing there is a defect, not a circumstance
            (pytest.fail if os.environ.get("CI") else pytest.skip)("needs a Vulkan device")


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request):
    return torch.device(request.param)


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


# the values for a GPU, small
SMALL = ppo.Args(
    env_id="Reach", sim_backend="physx_cpu", num_envs=32, num_eval_envs=16, num_eval_episodes=24, num_steps=10,
    total_timesteps=32 * 10 * 4, num_minibatches=4, eval_freq=2, capture_video=False, cuda=False,
)  # fmt: skip


def box(size):
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def read_metrics(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture
def train(in_tmp, monkeypatch, device):
    """Train in this process on the torch-native environments, with the flags given; the runs are called run1, run2, …
    Returns the metrics, the last checkpoint and the exit code."""
    monkeypatch.setattr(ppo, "make_envs", partial(batched_env.make_envs, device=device))
    count = 0

    def run(**flags):
        nonlocal count
        count += "resume" not in flags
        if "resume" in flags:
            flags["resume"] = str(ppo.find_checkpoint(flags["resume"]))
        args = replace(SMALL, exp_name=f"run{count}", cuda=device.type == "cuda", **flags)
        with contextlib.ExitStack() as closing:
            code = ppo.train(args, closing)
        folder = ppo.find_run_dir(args)
        return read_metrics(folder), ppo.load_checkpoint(folder / "last.pt"), code

    return run


def same_weights(a, b):
    return all(torch.equal(a["agent"][k], b["agent"][k]) for k in a["agent"])


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A short run on the CPU pool, made once: its folder."""
    folder = tmp_path_factory.mktemp("trained")
    shutil.copy(ROOT / "ppo.py", folder)  # a copied script must work on its own
    process = run_script(
        "--exp-name", "small", "--num_envs", "2", "--num-eval-envs", "2", "--num_eval_episodes", "3",
        "--num-steps", "40", "--total_timesteps", "400", "--eval_freq", "2", "--save_freq", "2",
        "--no-capture_video", "--no-cuda",
        cwd=folder, script=folder / "ppo.py",
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    return folder / "runs/small", process
