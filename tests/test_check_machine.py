"""examples/check_machine.py reports what works, and does not crash where nothing works."""

import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch
from conftest import NO_VULKAN, ROOT

import ppo_rgb
from examples import check_machine as check_machine_script


def check_machine(**environment):
    process = subprocess.run(
        [sys.executable, str(ROOT / "examples/check_machine.py")], env={**os.environ, **environment},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert process.returncode == 0 and process.stderr == "" and "Traceback" not in process.stdout
    return process.stdout


@pytest.mark.slow
def test_without_vulkan():
    table = check_machine(**NO_VULKAN)
    assert "ok       state, CPU simulation     PushCube-v1 was built and stepped" in table
    assert "missing  Vulkan" in table and "-> apt install mesa-vulkan-drivers" in table
    assert "images, CPU simulation    no: see above" in table
    assert all(f"ok       {package} " in table for package in ("mani-skill", "sapien", "torch", "psutil"))


@pytest.mark.slow
@pytest.mark.render
def test_with_vulkan():
    table = check_machine()
    assert "ok       Vulkan" in table
    assert "ok       images, CPU simulation    PushCube-v1 was built and stepped" in table


def test_shared_memory(monkeypatch, capsys):
    """The largest images that check_machine.py reports as possible are the largest that ppo_rgb.py accepts."""
    free = lambda mebibytes: monkeypatch.setattr(
        shutil, "disk_usage", lambda path: SimpleNamespace(free=mebibytes * 2**20)
    )
    for mebibytes, cores, expected in (
        (
            64,
            2,
            "missing  shared memory             64 MiB free: enough for states, and for colour images of up to 95x95",
        ),
        (8, 2, "missing  shared memory             8 MiB free: hardly enough for states"),
        (8, 1, "ok       shared memory             8 MiB free: one core needs none"),
        (1024, 2, "ok       shared memory             1,024 MiB free: enough for states, and for colour images"),
    ):
        free(mebibytes)
        check_machine_script.show_shared_memory(cores)
        output = capsys.readouterr().out
        assert output.startswith(expected) and ("-> --shm-size" in output) == expected.startswith("missing")
    free(64)
    obs_space = lambda size: ppo_rgb.gym.spaces.Dict(rgb=ppo_rgb.gym.spaces.Box(0, 255, (size, size, 3), "uint8"))
    action_space, cpu = ppo_rgb.gym.spaces.Box(-1, 1, (8,)), torch.device("cpu")
    args = ppo_rgb.Args(num_envs=64, num_steps=25, num_actors=2)
    make_storage = lambda *spaces: ppo_rgb.make_storage(ppo_rgb.Agent(*spaces, args), *spaces, args, cpu)
    assert make_storage(obs_space(95), action_space)["obs"]["rgb"].shape[:2] == (25, 64)
    with pytest.raises(SystemExit):
        make_storage(obs_space(120), action_space)


def test_where_all_is_broken(tmp_path):
    """The table reports modules that cannot be imported, that crash the process, or that are too old."""
    for name, version in (("gymnasium", "0.29.1"), ("mani_skill", "3.0.0b22")):
        (tmp_path / f"{name}-{version}.dist-info").mkdir()
        text = f"Name: {name.replace('_', '-')}\nVersion: {version}\n"
        (tmp_path / f"{name}-{version}.dist-info/METADATA").write_text(text)
    (tmp_path / "torch.py").write_text("raise OSError('libtorch.so: cannot open shared object file')")
    (tmp_path / "sapien.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    table = check_machine(PYTHONPATH=str(tmp_path))
    assert "libtorch.so: cannot open shared object file" in table
    assert "missing  gymnasium                 0.29.1" in table and '-> pip install "gymnasium>=1.0"' in table
    assert "missing  mani-skill                3.0.0b22" in table
    assert "missing  Vulkan                    ended with exit code -11" in table
    assert "missing  state, CPU simulation     ended with exit code -11" in table
