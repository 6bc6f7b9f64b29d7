import os

# several processes share the cores: threads must not spin while they wait
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import contextlib
import fcntl
import functools
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import batched_env
import gymnasium as gym
import numpy as np
import pytest
import torch
from pretended_gpu import pretended_gpu

import ppo
import ppo_rgb

ROOT = Path(__file__).parent.parent
for script in (ppo, ppo_rgb):  # in one process, each of them wraps functions that the other has wrapped
    script.PACKAGES += (ppo.__file__, ppo_rgb.__file__)
NO_VULKAN = {"VK_DRIVER_FILES": "/nonexistent", "VK_ICD_FILENAMES": "/nonexistent"}


def run_script(*arguments, cwd, env=None, script=ROOT / "ppo.py", timeout=600):
    """Run ppo.py, or another script, as a user would; returns the finished process with its output as text."""
    return subprocess.run(
        [sys.executable, str(script), *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **(env or {})},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout,
    )


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config):
    """Use two processes if pytest-xdist is installed. tests/test_task.py must also run without it."""
    is_worker = hasattr(config, "workerinput")
    if config.pluginmanager.hasplugin("xdist") and not is_worker and config.option.numprocesses is None:
        config.option.numprocesses, config.option.dist = 2, "worksteal"


def pytest_addoption(parser):
    parser.addoption("--env_id", action="append", help="task that tests/test_task.py looks at (may be repeated)")


def pytest_terminal_summary(terminalreporter):
    """Print which simulation the checks of tasks ran on."""
    for where, simulation in (("physx_cpu", "a batch on the CPU"), ("physx_cuda", "PhysX's GPU simulation")):
        reports = [
            sum(
                where in report.nodeid and "test_task.py" in report.nodeid
                for report in terminalreporter.stats.get(k, ())
            )
            for k in ("passed", "failed", "error", "skipped")
        ]
        if any(reports):
            counts = "{} checks of tasks passed, {} failed, {} had an error, {} did not run".format(*reports)
            terminalreporter.write_line(f"on {simulation}: {counts}")


@functools.cache
def keep_renderer():
    """SAPIEN's renderer ends with the last scene that renders, and takes ten seconds to start with software Vulkan.
    With one that stays, it starts once in a process, not in each test."""
    return ppo.sapien.render.RenderSystem(ppo.RENDER_DEVICE)


def pytest_runtest_setup(item):
    if item.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    if item.get_closest_marker("render"):
        if ppo.RENDER_DEVICE is None:
            # CI installs software Vulkan: if the renderer is missing there, the test fails
            (pytest.fail if os.environ.get("CI") else pytest.skip)("needs a Vulkan device")
        keep_renderer()


CUDA = pytest.param("cuda", marks=pytest.mark.gpu)
# for what the pretended GPU cannot show, or does as the CPU does
on_cpu_and_cuda = pytest.mark.parametrize("device", ["cpu", CUDA], indirect=True)
on_gpus = pytest.mark.parametrize("device", ["pretended", CUDA], indirect=True)


@pytest.fixture(params=["cpu", pytest.param("pretended", marks=pytest.mark.slow), CUDA])
def device(request, monkeypatch):
    if request.param == "pretended":
        with pretended_gpu(monkeypatch):
            yield torch.device("cuda")
    else:
        yield torch.device(request.param)


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


# ManiSkill's flags with small sizes. Each test adds what it is about; those that replace make_envs use only the
# registration of env_id.
SMALL = ppo.Args(
    sim_backend="physx_cpu", num_envs=32, num_eval_envs=16, num_eval_episodes=24, num_actors=1, num_steps=10,
    total_timesteps=32 * 10 * 4, num_minibatches=4, eval_freq=2, capture_video=False, cuda=False, learning_rate=3e-4,
    anneal_lr=False, gamma=0.8, gae_lambda=0.9, update_epochs=4, target_kl=0.1, desired_kl=None, norm_obs=False,
    logstd_lr_factor=1.0,
)  # fmt: skip


ACTIONS = gym.spaces.Box(-1, 1, (2,), np.float32)  # action space of the torch-native environments


def box(size):
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def read_metrics(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture
def script():
    """The script that `train` and `in_update` use. Tests of ppo_rgb.py override this fixture and `small`."""
    return ppo


@pytest.fixture
def small():
    return SMALL


@pytest.fixture
def train(in_tmp, monkeypatch, device, script, small):
    """A function that trains in this process on the torch-native environments, with the given flags. Its runs are named
    run1, run2, … It returns the metrics and the last checkpoint. There are no CUDA graphs unless the test asks for
    them, because a graph does not call what a test puts in place of a function."""
    monkeypatch.setattr(script, "make_envs", functools.partial(batched_env.make_envs, device=device))
    monkeypatch.setattr(script, "plot_learning_curve", lambda run_dir: None)  # plotting takes longer than these runs
    monkeypatch.setattr(script, "num_cores", lambda: 2)  # more threads would be slower than these minibatches
    count = 0

    def run(**flags):
        nonlocal count
        count += "resume" not in flags
        if "resume" in flags:
            flags["resume"] = script.load_checkpoint(flags["resume"])["path"]
        flags = dict(exp_name=f"run{count}", cuda=device.type == "cuda", cudagraphs=False) | flags
        args = replace(small, **flags)
        with contextlib.ExitStack() as closing:
            script.train(args, closing)
        folder = script.find_run_dir(args)
        return read_metrics(folder), script.load_checkpoint(folder / "last.pt")

    return run


def same_weights(a, b):
    return all(torch.equal(a["agent"][k], b["agent"][k]) for k in a["agent"])


WALL_CLOCK = {"time", "sps", "rollout_time", "update_time"}


def without_clock(rows):
    return [{k: v for k, v in row.items() if k not in WALL_CLOCK} for row in rows]


def scalars(folder):
    """What TensorBoard would show: {tag: {step: value}}"""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    tags = [tag for tag in events.Tags()["scalars"] if tag.split("/")[1] not in WALL_CLOCK]
    return {tag: {e.step: e.value for e in events.Scalars(tag)} for tag in tags}


def same_run(a, b):
    """Assert that two run folders have equal weights, optimizers, metrics and TensorBoard scalars, wall clock aside."""
    for name in ("last.pt", "best.pt"):
        x, y = ppo.load_checkpoint(a / name), ppo.load_checkpoint(b / name)
        assert same_weights(x, y) and x["global_step"] == y["global_step"]
        for s, t in zip(x["optimizer"]["state"].values(), y["optimizer"]["state"].values(), strict=True):
            assert all(torch.equal(s[k], t[k]) for k in s)
    assert without_clock(read_metrics(a)) == without_clock(read_metrics(b))
    assert scalars(a) == scalars(b)
    return True


@pytest.fixture
def in_update(monkeypatch, script):
    """A function that arranges for an action to run once, in the middle of the update of one iteration."""

    def arrange(iteration, action, per_iteration=8):
        update, calls = script.update_minibatch, []

        def counting(*args, **minibatch):
            calls.append(1)
            if len(calls) == per_iteration * iteration + 3:
                action()
            return update(*args, **minibatch)

        monkeypatch.setattr(script, "update_minibatch", counting)

    return arrange


class Stop(Exception):
    pass


def crash():
    raise Stop


@pytest.fixture
def signals(script):
    """Signals stop a run as they do in `main`."""
    handlers = script.set_handlers(dict.fromkeys(script.STOP_SIGNALS, script.stop))
    yield
    script.set_handlers(handlers)


def refused(arguments, capsys, script=ppo):
    """Run the script with bad arguments; returns what it prints as an error: one line, or tyro's box around the flag
    that it cannot parse. The script must exit with 2 and write nothing."""
    before = sorted(Path().rglob("*"))
    with pytest.raises(SystemExit) as exit:
        script.main([*map(str, arguments)])
    output = capsys.readouterr()
    assert exit.value.code == 2, arguments
    is_one_line = output.err.count("\n") == 1 and output.err.startswith(f"{script.SCRIPT.name}: ")
    assert is_one_line or f"{script.SCRIPT.name} --help" in output.err, output.err
    assert "Traceback" not in output.err
    assert sorted(Path().rglob("*")) == before, "nothing is written"
    return output.err


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A short run with two actors on the CPU, made once: its folder, its stdout and its stderr."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "trained"
    folder.mkdir(exist_ok=True)
    with open(folder / "lock", "w") as lock:  # only the first of pytest's processes makes the run
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "output.json").exists():
            shutil.copy(ROOT / "ppo.py", folder)  # a copied script must work on its own
            process = run_script(
                "--exp-name", "small", "--num_envs", "4", "--num_actors", "2", "--num-eval-envs", "4",
                "--num_eval_episodes", "6", "--num-steps", "20", "--total_timesteps", "400", "--eval_freq", "2",
                "--save_freq", "2", "--no-capture_video", "--no-cuda",
                cwd=folder, script=folder / "ppo.py",
            )  # fmt: skip
            assert process.returncode == 0, process.stderr
            (folder / "output.json").write_text(json.dumps([process.stdout, process.stderr]))
    return folder / "runs/small", *json.loads((folder / "output.json").read_text())
