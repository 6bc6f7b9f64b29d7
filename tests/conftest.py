import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

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
        import ppo

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


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A short run on the CPU pool, made once: its folder."""
    folder = tmp_path_factory.mktemp("trained")
    shutil.copy(ROOT / "ppo.py", folder)  # a copied script must work on its own
    process = run_script(
        "--exp-name", "small", "--num_envs", "4", "--num-eval-envs", "2", "--num_eval_episodes", "3",
        "--num-steps", "20", "--total_timesteps", "400", "--eval_freq", "2", "--save_freq", "2",
        "--no-capture_video", "--no-cuda",
        cwd=folder, script=folder / "ppo.py",
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    return folder / "runs/small", process
