"""Stopping, resuming and failing. Most tests train on the torch-native environments in this process; the others run
the command with real tasks."""

import contextlib
import errno
import gc
import json
import math
import multiprocessing
import os
import re
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import batched_env
import gymnasium as gym
import psutil
import pytest
import torch
from conftest import (
    ACTIONS,
    NO_VULKAN,
    ROOT,
    SMALL,
    Stop,
    box,
    crash,
    on_cpu_and_cuda,
    read_metrics,
    refused,
    run_script,
    same_run,
    same_weights,
    scalars,
)
from torch.utils._pytree import tree_leaves

import ppo
import ppo_rgb


def signal_self():
    os.kill(os.getpid(), signal.SIGTERM)


# --- resuming ---

RUN = dict(
    total_timesteps=320 * 12, eval_freq=4, update_epochs=2, target_kl=None, anneal_lr=True, norm_obs=True,
    checkpoint_freq=3, save_freq=5,
)  # fmt: skip
# as a command, 8 minibatches an iteration
COMMAND = (
    "--num_envs 32 --num_actors 1 --num_steps 10 --total_timesteps 3840 --num_minibatches 4 --update_epochs 2 "
    "--no-cuda --no-capture_video --desired_kl None"
).split()


@on_cpu_and_cuda
def test_exact_resume_is_bit_identical(train, in_update, in_tmp, signals):
    """A run that stops anywhere, even in the middle of an update, and is resumed ends with the same bits as one that
    never stopped."""
    metrics, _ = train(**RUN, exact_resume=True)
    assert len(metrics) == 12 + 4
    for iteration, action in ((0, crash), (2, signal_self), (5, crash), (6, signal_self), (11, crash)):
        name = f"stopped{iteration}"
        in_update(iteration, action)
        with pytest.raises(Stop if action is crash else KeyboardInterrupt):
            train(**RUN, exact_resume=True, exp_name=name)
        stopped = ppo.load_checkpoint(f"runs/{name}/last.pt")
        assert stopped["iteration"] == iteration // 3 * 3, "last.pt must be from the last boundary"
        train(**RUN, exact_resume=True, resume=f"runs/{name}")
        assert same_run(in_tmp / "runs/run1", in_tmp / f"runs/{name}")
        assert len(scalars(f"runs/{name}")["train/value_loss"]) == 12


@on_cpu_and_cuda
def test_exact_resume_repeats_its_own_boundaries(train, in_tmp):
    """Resuming from any checkpoint of a finished run reaches the same end. The flag does change the run: episodes
    restart at each checkpoint."""
    train(**RUN | dict(save_freq=3), exact_resume=True)
    for iteration in (3, 6, 9):
        shutil.copytree("runs/run1", f"runs/again{iteration}")
        train(**RUN | dict(save_freq=3), exact_resume=True, resume=f"runs/again{iteration}/iteration_{iteration}.pt")
        assert same_run(in_tmp / "runs/run1", in_tmp / f"runs/again{iteration}")
    _, other = train(**RUN)
    assert not same_weights(other, ppo.load_checkpoint("runs/run1/last.pt")), "the flag must change the run"


@on_cpu_and_cuda
@pytest.mark.parametrize("action", [crash, signal_self])
def test_resume_twice_is_the_same_twice(train, in_update, in_tmp, signals, action):
    """Without --exact_resume, a resumed run keeps all finished iterations and repeats no row. Resuming twice gives the
    same result."""
    in_update(7, action)
    with pytest.raises(Stop if action is crash else KeyboardInterrupt):
        train(**RUN)
    stopped = ppo.load_checkpoint("runs/run1/last.pt")
    assert stopped["iteration"] == 7, "only a finished update may be kept"
    shutil.copytree("runs/run1", "runs/again")
    for name in ("run1", "again"):
        metrics, last = train(**RUN, resume=f"runs/{name}")
    assert same_run(in_tmp / "runs/run1", in_tmp / "runs/again")
    assert [row["iteration"] for row in metrics if row["kind"] == "train"] == [*range(1, 13)]
    assert [row["global_step"] // 320 for row in metrics if row["kind"] == "eval"] == [0, 4, 8, 12]
    assert last["iteration"] == 12 and last["global_step"] == 12 * 320


def test_resume_continues_normalisation_optimizer_and_schedule(train, in_update, in_tmp):
    in_update(9, crash)
    with pytest.raises(Stop):
        train(**RUN)
    at_stop = ppo.load_checkpoint("runs/run1/last.pt")
    metrics, last = train(**RUN, resume="runs/run1")
    rates = [row["learning_rate"] for row in metrics if row["kind"] == "train"]
    assert rates == pytest.approx([3e-4 * (1 - i / 12) for i in range(12)])
    count = at_stop["agent"]["obs_count"]
    assert count == pytest.approx(9 * 320, rel=1e-4)
    assert last["agent"]["obs_count"] == pytest.approx(12 * 320, rel=1e-4)
    assert {float(s["step"]) for s in last["optimizer"]["state"].values()} == {12 * 8}


@on_cpu_and_cuda
def test_a_solved_run_can_go_on(train):
    """A resumed run does not end at once because of the success that it had."""
    _, last = train(stop_at_success=0.0)
    assert last["iteration"] == 2 and not last["finished"]
    _, last = train(stop_at_success=0.0, resume="runs/run1")
    assert last["iteration"] == 4 and last["finished"]


@on_cpu_and_cuda
def test_actions_keep_the_bounds_of_the_task(train):
    """A policy that learned with one controller may go on with another one, which has other bounds."""
    _, checkpoint = train(total_timesteps=320)
    agent = ppo.make_agent(box(4), gym.spaces.Box(-3, 5, (2,)), SMALL, checkpoint)
    assert (agent.action_low == -3).all() and (agent.action_high == 5).all()
    assert all(torch.equal(x, checkpoint["agent"][k]) for k, x in agent.named_parameters())


@on_cpu_and_cuda
def test_a_run_of_a_gpu_goes_on_with_all_cores(train, monkeypatch):
    """There, one process simulated all environments."""
    train(total_timesteps=320)
    checkpoint = torch.load("runs/run1/last.pt")
    checkpoint["args"] |= dict(sim_backend="physx_cuda:0", num_actors=1)
    torch.save(checkpoint, "runs/run1/last.pt")
    monkeypatch.setattr(ppo, "num_cores", lambda: 16)
    flags = ["--resume", "runs/run1", "--sim_backend", "physx_cpu", "--total_timesteps", "640"]
    assert ppo.parse_args(flags).num_actors == 16
    assert ppo.parse_args([*flags, "--num_actors", "3"]).num_actors == 3


@on_cpu_and_cuda
def test_a_finished_run_can_go_on(train, in_tmp):
    train(total_timesteps=320 * 2)
    metrics, last = train(total_timesteps=320 * 5, resume="runs/run1")
    assert last["iteration"] == 5 and [r["global_step"] // 320 for r in metrics if r["kind"] == "eval"] == [0, 2, 4, 5]


@on_cpu_and_cuda
def test_signal_in_the_last_evaluation(train, in_tmp, monkeypatch, signals):
    """Resuming the run repeats that evaluation. Only then is the run finished."""
    evaluate, first_looks, flags = ppo.evaluate, [], dict(RUN, eval_freq=0)

    def stop_in_the_second(agent, envs, args, num_episodes, seed, *others):
        first_looks.append(seed == args.eval_seed)
        if sum(first_looks) == 2:
            signal_self()
        return evaluate(agent, envs, args, num_episodes, seed, *others)

    with monkeypatch.context() as patch:
        patch.setattr(ppo, "evaluate", stop_in_the_second)
        with pytest.raises(KeyboardInterrupt):
            train(**flags)
    last = ppo.load_checkpoint("runs/run1/last.pt")
    assert last["iteration"] == 12 and not last["finished"]
    metrics, last = train(**flags, resume="runs/run1")
    assert last["finished"] and [row["kind"] for row in metrics].count("eval") == 2
    assert metrics[-1]["kind"] == "eval" and metrics[-1]["global_step"] == 12 * 320


@on_cpu_and_cuda
def test_best_checkpoint_is_never_replaced_by_a_worse_one(train, in_tmp):
    """This holds even if the run resumes from a checkpoint that is older than best.pt."""
    train(**RUN)
    best = ppo.load_checkpoint("runs/run1/best.pt")
    torch.save(best | {"best_score": [2.0, 1e6]}, "runs/run1/best.pt")
    before = Path("runs/run1/best.pt").read_bytes()
    train(**RUN, resume="runs/run1/iteration_5.pt")
    assert Path("runs/run1/best.pt").read_bytes() == before


def test_a_best_policy_that_was_not_written_is_found_again(train, in_tmp, monkeypatch, signals):
    """A signal while best.pt is written: its score is not that of the file, and must not keep the next one out."""
    write, scores = ppo.Checkpoints.write, iter([1, 1, 2, 2, 2, 2, 0, 0])  # the best ones count twice: see train
    monkeypatch.setattr(ppo, "score", lambda episodes: [next(scores)])

    def stop_in_the_second(checkpoints, name):
        if name == "best.pt" and Path("runs/run1/best.pt").exists():
            signal_self()
        write(checkpoints, name)

    with monkeypatch.context() as patch:
        patch.setattr(ppo.Checkpoints, "write", stop_in_the_second)
        with pytest.raises(KeyboardInterrupt):
            train(**RUN)
    assert [ppo.load_checkpoint(f"runs/run1/{x}.pt")["best_score"] for x in ("best", "last")] == [[1], [2]]
    train(**RUN, resume="runs/run1")
    assert ppo.load_checkpoint("runs/run1/best.pt")["best_score"] == [2]


def test_processes_agree_on_the_best_score(train, in_tmp, monkeypatch):
    """Only the first process of torchrun has best.pt. All must agree when an evaluation is repeated."""
    train(**RUN)
    resumed = ppo.load_checkpoint("runs/run1/last.pt")
    agent, optimizer = SimpleNamespace(), SimpleNamespace()
    logger, space = SimpleNamespace(wandb_id=None), box(4)
    monkeypatch.setattr(ppo, "all_gather", lambda x: [[1.5, 30.0], x])
    other = ppo.Checkpoints(SMALL, in_tmp / "nothing", resumed, agent, optimizer, space, logger)
    assert other.best_score == [1.5, 30.0]


@on_cpu_and_cuda
def test_resume_to_fewer_or_as_many_steps(train, in_tmp, capsys):
    """Fewer steps and iterations of another size are refused. With as many steps, the script prints that the run is
    finished. None of these changes the run."""
    metrics, _ = train(total_timesteps=320 * 4)
    for flag in ("--num_envs=64", "--num_steps=0"):
        assert "the run has 320 steps an iteration" in refused(["--resume", "runs/run1", flag], capsys)
    for steps, code, words in ((320 * 3, 2, "the run already has 1280 steps"), (320 * 4, 0, "the run is finished")):
        with pytest.raises(SystemExit) as error:
            ppo.main(["--resume", "runs/run1", "--total_timesteps", str(steps)])
        output = capsys.readouterr()
        assert error.value.code == code and words in output.err + output.out
        assert "--total_timesteps" in output.err + output.out
    assert read_metrics(in_tmp / "runs/run1") == metrics


@pytest.mark.gpu
@pytest.mark.parametrize("first, second", [("cuda", "cpu"), ("cpu", "cuda")])
def test_checkpoints_move_between_devices(in_tmp, monkeypatch, first, second):
    for device, flags in ((first, dict(exp_name="x", total_timesteps=640)), (second, dict(resume="runs/x/last.pt"))):
        monkeypatch.setattr(ppo, "make_envs", partial(batched_env.make_envs, device=device))
        args = replace(SMALL, total_timesteps=1280, cuda=device == "cuda")
        with contextlib.ExitStack() as closing:
            ppo.train(replace(args, **flags), closing)
    last = ppo.load_checkpoint("runs/x/last.pt")
    assert last["iteration"] == 4 and all(x.device.type == "cpu" for x in last["agent"].values())


# --- numbers that are not finite ---


def poison(monkeypatch, quantity, at, value=float("nan"), env_idx=(3, 7)):
    """Make some training environments return `value` in the steps `at`."""
    step, calls = batched_env.BatchedReach.step, []

    def poisoned(self, actions):
        obs, reward, terminated, truncated, info = step(self, actions)
        if self.num_envs == 32:
            calls.append(1)
            if len(calls) in at:
                (obs if quantity == "observation" else reward)[list(env_idx)] = value
                if quantity == "observation":
                    self.state[list(env_idx)] = value  # it stays until a reset
        return obs, reward, terminated, truncated, info

    monkeypatch.setattr(batched_env.BatchedReach, "step", poisoned)


@pytest.mark.parametrize("quantity", ["observation", "reward"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_non_finite_steps_end_the_run(train, in_tmp, monkeypatch, quantity, value):
    """The third iteration ends the run before its update. The line names the environments, and the resumed run goes on
    from the second update with new episodes."""
    flags = RUN | dict(total_timesteps=320 * 4, save_freq=1)
    with monkeypatch.context() as patch:
        poison(patch, quantity, at=[25], value=value)
        with pytest.raises(ppo.RunError, match=r"NaN or infinity in environments \[3, 7\]"):
            train(**flags)
    last, before = [ppo.load_checkpoint(f"runs/run1/{name}.pt") for name in ("last", "iteration_2")]
    assert last["iteration"] == 2 and same_weights(last, before)
    metrics, last = train(**flags, resume="runs/run1")
    assert [row["iteration"] for row in metrics if row["kind"] == "train"] == [1, 2, 3, 4]
    assert all(torch.isfinite(x).all() for x in last["agent"].values())


def test_an_update_that_spoils_the_weights_ends_the_run(train, in_tmp, monkeypatch):
    """last.pt holds the weights from before the update, even though earlier minibatches had already changed them."""
    update, calls = ppo.update_minibatch, []

    def overflowing(agent, optimizer, args, *, returns, **others):
        calls.append(1)
        if len(calls) == 8 * 4 + 5:
            returns = returns * 1e38 * 1e38
        return update(agent, optimizer, args, returns=returns, **others)

    monkeypatch.setattr(ppo, "update_minibatch", overflowing)
    with pytest.raises(ppo.RunError, match="weights that are not finite"):
        train(**RUN | dict(save_freq=1))
    last, before = [ppo.load_checkpoint(f"runs/run1/{name}.pt") for name in ("last", "iteration_4")]
    assert last["iteration"] == 4 and same_weights(last, before)
    assert all(torch.isfinite(x).all() for x in last["agent"].values())
    assert {float(s["step"]) for s in last["optimizer"]["state"].values()} == {4 * 8}


def test_observations_too_large_to_be_squared_end_the_run(train, in_tmp, monkeypatch):
    poison(monkeypatch, "observation", at=[25], value=1e30)
    with pytest.raises(ppo.RunError, match="not finite"):
        train(**RUN)
    last = ppo.load_checkpoint("runs/run1/last.pt")
    assert last["iteration"] == 2 and all(torch.isfinite(x).all() for x in last["agent"].values())


# --- files ---


def test_a_full_disk_ends_the_run_and_keeps_the_checkpoint(in_update, in_tmp, monkeypatch, capsys):
    """The run ends with one line, and the old checkpoint stays whole. /dev/full stands in for the temporary file."""
    monkeypatch.setattr(ppo, "make_envs", partial(batched_env.make_envs, device="cpu"))
    in_update(1, lambda: Path("runs/x/last.tmp").symlink_to("/dev/full"))
    flags = ("--checkpoint_freq", "3", "--eval_freq", "4", "--exp_name", "x")
    assert ppo.main([*COMMAND, *flags]) == 1
    errors = capsys.readouterr().err
    assert os.strerror(errno.ENOSPC) in errors and "last.pt is safe" in errors and "Traceback" not in errors
    assert ppo.load_checkpoint("runs/x/last.pt")["iteration"] == 0
    Path("runs/x/last.tmp").unlink()
    assert ppo.main(["--resume", "runs/x"]) == 0
    assert ppo.load_checkpoint("runs/x/last.pt")["iteration"] == 12


@on_cpu_and_cuda
def test_a_full_disk_cuts_no_row_off(train, in_update, in_tmp):
    """If metrics.jsonl cannot grow, the run ends. When it is resumed, even on a disk that is still full, no row is
    missing or broken."""
    file, unlimited = Path("runs/run1/metrics.jsonl"), resource.getrlimit(resource.RLIMIT_FSIZE)

    def limit(size):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, unlimited[1]))

    in_update(3, lambda: limit(file.stat().st_size + 100))
    try:
        with pytest.raises(OSError):
            train(**RUN)
        gc.collect()  # the lock of the run's folder, which a user's process would release when it ends
        limit(100)
        with pytest.raises(OSError):
            train(**RUN, resume="runs/run1")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    gc.collect()
    assert ppo.load_checkpoint("runs/run1/last.pt")["iteration"] == 3
    metrics, last = train(**RUN, resume="runs/run1")
    assert last["iteration"] == 12
    assert [row["iteration"] for row in metrics if row["kind"] == "train"] == [*range(1, 13)]
    losses = {row["global_step"]: row["value_loss"] for row in metrics if row["kind"] == "train"}
    assert scalars("runs/run1")["train/value_loss"] == pytest.approx(losses)


class Foreign:
    pass


@pytest.mark.parametrize(
    "flag, how",
    [("--checkpoint", how) for how in ("truncated", "empty", "foreign", "code", "older", "directory", "network")]
    + [(flag, how) for flag in ("--resume", "--evaluate") for how in ("truncated", "task")],
)
def test_unfit_checkpoints_are_refused_in_one_line(trained, in_tmp, flag, how, capsys):
    """The line names the file and, for another task, the expected and the found shape. Nothing is written."""
    shutil.copytree(trained[0], "runs/x")
    path, content = Path("runs/x/bad.pt"), (trained[0] / "last.pt").read_bytes()
    checkpoint = ppo.load_checkpoint(trained[0] / "last.pt")
    message = "bad.pt"
    if how in ("truncated", "empty"):
        path.write_bytes(content[: len(content) // 2 if how == "truncated" else 0])
    elif how == "foreign":
        torch.save({"state_dict": {}}, path)
        message = "bad.pt.*another version"
    elif how == "code":
        torch.save(checkpoint | {"agent": Foreign()}, path)
    elif how == "older":
        torch.save({k: v for k, v in checkpoint.items() if k != "finished"}, path)
        message = "bad.pt.*another version"
    elif how == "directory":
        path.mkdir()
    elif how == "task":
        checkpoint["agent"]["actor_mean.0.0.weight"] = torch.zeros(256, 42)
        torch.save(checkpoint, path)
        message = r"bad.pt is of another network or task: .*actor_mean.0.0.weight.*256, 42.*256, 35"
    elif how == "network":
        checkpoint["agent"]["actor_extra.weight"] = torch.zeros(3)
        torch.save(checkpoint, path)
        message = r"bad.pt is of another network or task: .*actor_extra.weight"
    before = sorted(Path("runs").rglob("*"))
    arguments = {"--resume": ["--resume", path, "--total_timesteps", 800],
                 "--checkpoint": ["--checkpoint", path, "--num_envs", 1],
                 "--evaluate": ["--evaluate", "--checkpoint", path, "--num_eval_envs", 1]}[flag]  # fmt: skip
    arguments += ["--num_actors", 1]
    with pytest.raises(SystemExit) as error:
        ppo.main([*map(str, arguments), "--no-cuda", "--no-capture_video"])
    assert error.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(message, line), line
    assert sorted(Path("runs").rglob("*")) == before


def test_flags_of_a_resumed_run(trained, in_tmp, capsys):
    """Flags on the command line replace those of the run, except those that fix the task and the network. Changes are
    printed."""
    shutil.copytree(trained[0], "runs/x")
    for flags in ("--env_id PickCube-v1", "--no-norm_obs", "--control_mode pd_joint_pos", "--evaluate",
                  "--checkpoint runs/x/best.pt"):  # fmt: skip
        with pytest.raises(SystemExit) as error:
            ppo.parse_args(["--resume", "runs/x", *flags.split()])
        assert error.value.code == 2 and re.match("--(no-)?([a-z_]+)", flags)[2] in capsys.readouterr().err
    args = ppo.parse_args("--resume runs/x --total_timesteps 1000 --eval_freq 3 --gamma 0.7 --learning_rate 1".split())
    assert (args.total_timesteps, args.eval_freq, args.gamma, args.learning_rate) == (1000, 3, 0.7, 1)
    assert (args.num_envs, args.num_steps, args.num_minibatches, args.seed) == (4, 20, 4, 1)
    assert ppo.find_run_dir(args) == Path("runs/x")
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("changed: ") and "--gamma 0.7 (was 0.9)" in line and line.count("was") == 4


def test_learning_rates_of_a_resumed_run(device):
    """An adapted learning rate keeps its last value, unless its flag has changed; one that was annealed does not."""
    args = ppo.Args(learning_rate=1e-3, desired_kl=0.01, logstd_lr_factor=1.0)
    agent = ppo.Agent(box(4), ACTIONS, args).to(device)
    saved = ppo.make_optimizer(agent, args, device)
    ppo.adapt_learning_rate(saved, torch.tensor(1.0, device=device), 0.01)
    saved.param_groups[2]["lr"].fill_(1e-7)
    state = saved.state_dict()
    for flags, rates in ((dict(), [1e-3 / 1.5, 1e-3 / 1.5, 1e-3]), (dict(learning_rate=2e-3), [2e-3] * 3)):
        args = replace(args, **flags)
        optimizer = ppo.make_optimizer(agent, args, device)
        ppo.load_optimizer(optimizer, state)
        assert [group["lr"].item() for group in optimizer.param_groups] == pytest.approx(rates)


# --- processes ---

TINY = ("--num_envs", 4, "--num_actors", 2, "--num_eval_envs", 1, "--num_eval_episodes", 2, "--num_steps", 10,
        "--num_minibatches", 2, "--eval_freq", 0, "--no-cuda", "--no-capture_video", "--exp-name", "x",
        "--total_timesteps", 10**6)  # fmt: skip


@pytest.fixture
def start(tmp_path):
    """A function that starts the script in its own process group and waits until it trains. The test fails if the
    script leaves processes or shared memory behind."""
    started = []

    def run(*flags, wait_for_rows=2, **environment):
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "ppo.py"), *map(str, flags)],
            cwd=tmp_path, env={**os.environ, **NO_VULKAN, "PYTHONPATH": str(tmp_path), **environment},
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip
        metrics = tmp_path / "runs/x/metrics.jsonl"
        before = len(metrics.read_text().splitlines()) if metrics.exists() else 0
        deadline = time.monotonic() + 120
        while process.poll() is None and wait_for_rows:
            assert time.monotonic() < deadline, "the script does not train"
            if metrics.exists() and len(metrics.read_text().splitlines()) >= before + wait_for_rows:
                break
            time.sleep(0.05)
        children = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
        started.append((process, children))
        return process, [child for child in children if "spawn_main" in " ".join(child.cmdline())]

    yield run
    for process, children in started:
        process.kill()
        _, alive = psutil.wait_procs(children, timeout=10)
        for child in alive:
            child.kill()
        assert not alive, f"left behind: {alive}"
        for pid in (process.pid, *(child.pid for child in children)):
            assert not [*Path("/dev/shm").glob(f"torch_{pid}_*")]


def test_signals_keep_what_was_learned(in_update, in_tmp, monkeypatch, capsys):
    """The run ends as it was when its iteration began, and exits with 128 + the number of the signal."""
    monkeypatch.setattr(ppo, "make_envs", batched_env.make_envs)
    handlers = [signal.getsignal(s) for s in ppo.STOP_SIGNALS]
    for signum in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1):
        in_update(2, lambda signum=signum: os.kill(os.getpid(), signum))
        assert ppo.main([*COMMAND, "--eval_freq", "0", "--exp_name", signum.name]) == 128 + signum
        errors = capsys.readouterr().err
        assert f"stopped by {signum.name}" in errors and f"--resume runs/{signum.name}" in errors
        assert ppo.load_checkpoint(f"runs/{signum.name}/last.pt")["iteration"] == 2
    assert handlers == [signal.getsignal(s) for s in ppo.STOP_SIGNALS], "main restores them"


def test_a_second_signal_does_not_spoil_the_checkpoint(in_update, in_tmp, monkeypatch):
    """SLURM sends two, and so do impatient people: the second one comes while last.pt is written."""
    monkeypatch.setattr(ppo, "make_envs", batched_env.make_envs)
    close = ppo.Checkpoints.close
    monkeypatch.setattr(ppo.Checkpoints, "close", lambda self: (os.kill(os.getpid(), signal.SIGTERM), close(self)))
    in_update(2, lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert ppo.main([*COMMAND, "--eval_freq", "0", "--exp_name", "x"]) == 143
    assert ppo.load_checkpoint("runs/x/last.pt")["iteration"] == 2


def test_a_signal_while_a_checkpoint_is_written(tmp_path):
    """It ends the run as at any other moment. torch's writer would make another error of it."""
    checkpoints = object.__new__(ppo.Checkpoints)
    checkpoints.args, checkpoints.run_dir = SimpleNamespace(save_model=True), tmp_path
    checkpoints.contents = {"weights": [torch.rand(1000) for _ in range(3000)]}
    begun = time.perf_counter()
    checkpoints.write("last.pt")
    seconds = time.perf_counter() - begun
    handlers = ppo.set_handlers({signal.SIGALRM: ppo.stop})
    try:
        for moment in range(30):
            try:
                signal.setitimer(signal.ITIMER_REAL, seconds * (moment + 1) / 31)
                checkpoints.write("last.pt")
                time.sleep(1)
            except KeyboardInterrupt:
                assert len(torch.load(tmp_path / "last.pt")["weights"]) == 3000
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        ppo.set_handlers(handlers)


@pytest.mark.slow
def test_control_c_in_a_terminal(start, tmp_path, monkeypatch, capsys):
    """Ctrl-C reaches all processes. The run stops as with any other signal, and can be resumed."""
    process, _ = start(*TINY, "--num_steps", 200)
    time.sleep(0.5)  # into the next rollout: between a row and the next checkpoint, last.pt is an iteration behind
    os.killpg(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGINT, errors
    assert "SIGINT" in errors and "--resume runs/x" in errors and "Traceback" not in output + errors
    rows, last = read_metrics(tmp_path / "runs/x"), ppo.load_checkpoint(tmp_path / "runs/x/last.pt")
    assert rows[-1]["kind"] == "train" and rows[-1]["iteration"] == last["iteration"] >= 1
    assert not list((tmp_path / "runs/x").glob("*.tmp"))
    monkeypatch.chdir(tmp_path)
    steps = last["global_step"] + 1600
    assert ppo.main(["--resume", "runs/x", "--total_timesteps", str(steps)]) == 0
    assert f"resuming runs/x at step {last['global_step']:,}" in capsys.readouterr().out
    rows = read_metrics(tmp_path / "runs/x")
    assert [row["iteration"] for row in rows if row["kind"] == "train"] == [*range(1, last["iteration"] + 3)]


@pytest.mark.slow
def test_a_signal_does_not_wait(start, tmp_path):
    """It ends a run whose actors are in the middle of a long rollout."""
    process, _ = start(*TINY, "--num_steps", 50_000, "--total_timesteps", 10**7, wait_for_rows=1)
    time.sleep(2)
    process.send_signal(signal.SIGTERM)
    begun = time.monotonic()
    assert process.wait(timeout=20) == 143 and time.monotonic() - begun < 10


@pytest.mark.slow
def test_dead_actor_ends_the_run(start, tmp_path):
    process, actors = start(*TINY)
    assert len(actors) == 1
    actors[0].kill()
    begun = time.monotonic()
    output, errors = process.communicate(timeout=30)
    assert process.returncode == 1 and time.monotonic() - begun < 10
    assert "ppo.py: the process of an actor died (killed? out of memory?)" in errors
    assert "runs/x/last.pt is safe" in errors and "--resume runs/x" in errors and "Traceback" not in output + errors
    assert (
        ppo.load_checkpoint(tmp_path / "runs/x/last.pt")["iteration"]
        == read_metrics(tmp_path / "runs/x")[-1]["iteration"]
    )


@pytest.mark.slow
def test_dead_parent_ends_the_actors(start):
    process, actors = start(*TINY)
    assert len(actors) == 1
    process.kill()
    begun = time.monotonic()
    _, alive = psutil.wait_procs(actors, timeout=10)
    assert not alive and time.monotonic() - begun < 10


FRAGILE = """
import multiprocessing

from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env

@register_env("{name}-v1", max_episode_steps=50)
class Fragile(PushCubeEnv):
    steps = 0

    def compute_normalized_dense_reward(self, obs, action, info):
        is_training = self.num_envs == 2  # of the 4 environments of 2 actors
        Fragile.steps += is_training and (multiprocessing.parent_process() is None) == {in_main_process}
        if is_training and Fragile.steps == 15:
            {fault}
        return super().compute_normalized_dense_reward(obs, action, info)
"""


def write_task(monkeypatch, name, **parts):
    Path(f"{name.lower()}.py").write_text(FRAGILE.format(name=name, **parts))
    monkeypatch.syspath_prepend(Path.cwd())
    return "--env_id", f"{name.lower()}:{name}-v1"


def test_error_of_a_task(in_tmp, monkeypatch, capfd):
    """An error of the task in another actor ends the run with the task's traceback, and last.pt is safe."""
    task = write_task(monkeypatch, "Wrong", fault="raise ValueError('my own mistake')", in_main_process=False)
    assert ppo.main([*map(str, (*TINY, *task))]) == 1
    errors = capfd.readouterr().err
    assert re.search(r"(?s)wrong.py.*ValueError: my own mistake", errors), errors
    assert "last.pt is safe" in errors
    assert ppo.load_checkpoint("runs/x/last.pt")["iteration"] == 1


@pytest.mark.slow
def test_physics_that_explode_end_the_run(in_tmp, monkeypatch, capfd):
    """When the position of a cube becomes NaN in one environment of another actor, the line names the environment. The
    resumed run starts new episodes and goes on."""
    fault = """
            from mani_skill.utils.structs import Pose
            poses = self.obj.pose.raw_pose.clone()
            poses[1] = float("nan")
            self.obj.set_pose(Pose.create(poses))
            self.scene._gpu_apply_all()
"""
    task = write_task(monkeypatch, "Exploding", fault=fault, in_main_process=False)
    assert ppo.main([*map(str, (*TINY, *task))]) == 1
    errors = capfd.readouterr().err
    assert "ppo.py: the rollout has NaN or infinity in environments [3]" in errors and "last.pt is safe" in errors
    steps = ppo.load_checkpoint("runs/x/last.pt")["global_step"] + 40
    Path("exploding.py").write_text(FRAGILE.format(name="Exploding", fault="pass", in_main_process=False))
    assert ppo.main(["--resume", "runs/x", "--total_timesteps", str(steps)]) == 0


@pytest.mark.parametrize("encoder, num_envs", [("nature", 8), ("impala", 8), (None, 512)])
def test_memory_that_is_too_small_is_refused(monkeypatch, capsys, encoder, num_envs):
    """It counts what a rollout stores, and what a minibatch and the acting policy compute: at least the outputs of all
    activation functions, added up by hooks."""
    script = ppo_rgb if encoder else ppo
    args = script.Args(num_envs=num_envs, num_steps=10, num_minibatches=2, num_actors=1)
    box, action_space = ppo.gym.spaces.Box, ppo.gym.spaces.Box(-1, 1, (8,))
    if encoder:
        args = replace(args, encoder=encoder)
        obs_space = ppo.gym.spaces.Dict(rgb=box(0, 255, (128, 128, 3), "uint8"), state=box(-1, 1, (30,)))
    else:
        obs_space = box(-1, 1, (30,))
    agent, sizes = script.Agent(obs_space, action_space, args), []
    for module in agent.modules():
        if isinstance(module, (torch.nn.ReLU, torch.nn.Tanh)):
            module.register_forward_hook(lambda module, inputs, output: sizes.append(4 * output[0].numel()))

    def make_storage(free):
        monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=free))
        return script.make_storage(agent, obs_space, action_space, args, torch.device("cpu"))

    stored = sum(x.nbytes for x in tree_leaves(make_storage(math.inf)))
    layers = sum(sizes) * (5 + 1) * num_envs  # rows of a minibatch and of a step
    weights = 4 * sum(x.numel() for x in agent.parameters())
    make_storage(free=2 * stored + 5 * layers + 4 * weights)
    with pytest.raises(SystemExit):
        make_storage(free=stored + layers + 3 * weights)
    line = capsys.readouterr().err
    assert re.search(r"training needs [\d,]+ MiB, and [\d,]+ MiB of memory are free: try --num_steps 5, more", line)


@on_cpu_and_cuda
def test_shared_memory_that_is_too_small_is_refused(train, in_tmp, monkeypatch, capsys):
    """The script refuses the run before it writes anything, and names remedies; otherwise the run would end in a
    "Bus error". One actor needs no shared memory."""
    usage, asked = shutil.disk_usage, []
    tiny = lambda path: asked.append(str(path)) or usage("/")._replace(free=2**10)
    monkeypatch.setattr(shutil, "disk_usage", tiny)
    line = refused(TINY, capsys)
    assert re.search(r"needs \d+ MiB, and 0 MiB of shared memory", line) and asked == ["/dev/shm"]
    assert all(remedy in line for remedy in ("--shm-size", "try --num_steps", "--num_actors 1"))
    assert not multiprocessing.active_children(), "the other actor must have ended"
    train()


@on_cpu_and_cuda
def test_a_run_folder_has_one_writer(train, in_update, in_tmp, capsys):
    """A run cannot be resumed while it is still running: two processes would write every row twice."""
    lines = []
    in_update(3, lambda: lines.append(refused(["--resume", "runs/run1", "--no-cuda"], capsys)))
    metrics, _ = train(**RUN)
    assert lines == ["ppo.py: another process is writing to runs/run1: stop it first, or choose another --exp_name\n"]
    assert [row["iteration"] for row in metrics if row["kind"] == "train"] == [*range(1, 13)]
    train(**RUN | dict(total_timesteps=320 * 13), resume="runs/run1")  # the lock is free again


def test_many_actors_may_open_many_files(train):
    """Each actor takes the agent and the storage as some thirty open files. The usual limit is 1,024."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit[1] // 2, limit[1]))
        train(total_timesteps=320)
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (limit[1], limit[1])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limit)


def test_a_learning_curve_that_begins_without_an_episode(tmp_path):
    """So it is in the other processes of torchrun after a resume, if no episode ended in the first iteration."""
    rows = [dict(kind="train", global_step=320), dict(kind="eval", global_step=640, success_once=0.5)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    ppo.plot_learning_curve(tmp_path)
    assert (tmp_path / "learning_curve.png").exists()


@pytest.mark.slow
def test_many_environments_start(tmp_path):
    """A CPU can simulate 512 environments, as many as commands written for a GPU ask for."""
    flags = ("--num_envs", 512, "--num_actors", 2, "--num_steps", 2, "--total_timesteps", 1024, "--exp-name", "x",
             "--num_eval_envs", 2, "--num_eval_episodes", 2, "--no-cuda", "--no-capture_video")  # fmt: skip
    process = run_script(*flags, cwd=tmp_path, env=NO_VULKAN)
    assert process.returncode == 0, process.stderr
    assert [row["kind"] for row in read_metrics(tmp_path / "runs/x")] == ["eval", "train", "eval"]


@pytest.mark.slow
def test_exact_resume_with_real_tasks(start, tmp_path, monkeypatch):
    """A run stopped by kill -9 and resumed ends with the same bits as one that never stopped. One of its two actors has
    a single environment."""
    monkeypatch.chdir(tmp_path)
    flags = [*TINY, "--exact_resume", "--checkpoint_freq", 3, "--num_envs", 3, "--num_actors", 2,
             "--num_steps", 20, "--total_timesteps", 10 * 20 * 3, "--eval_freq", 7, "--num_eval_episodes", 3,
             "--num_eval_envs", 3, "--env_kwargs", '{"max_episode_steps": 15}']  # fmt: skip
    assert ppo.main([*map(str, flags), "--exp-name", "whole"]) == 0
    process, _ = start(*flags, wait_for_rows=6)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL, "the run must be stopped before its end"
    assert ppo.main(["--resume", "runs/x"]) == 0
    assert same_run(tmp_path / "runs/whole", tmp_path / "runs/x")


@pytest.mark.slow
def test_kill_at_random_moments(tmp_path):
    """After each of twenty kills (kill -9) last.pt is readable or does not exist yet. In the end the run equals one
    that was never killed."""
    process = subprocess.run(
        [sys.executable, str(Path(__file__).parent / "killed_run.py")], cwd=tmp_path, capture_output=True, text=True,
        timeout=600,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    assert "20 kills" in process.stdout
    assert same_run(tmp_path / "runs/whole", tmp_path / "runs/killed")


@pytest.mark.slow
def test_memory_is_flat(tmp_path, num_iterations=1000):
    """The main process and the other actor do not grow over 1,000 iterations and 40 rebuilds of the scenes."""
    flags = ("--exact_resume", "--checkpoint_freq", 25, "--env_id", "MS-CartpoleBalance-v1", "--num_envs", 4,
             "--env_kwargs", '{"max_episode_steps": 50}', "--num_actors", 2, "--num_eval_envs", 4, "--num_steps", 2,
             "--num_eval_episodes", 4, "--num_minibatches", 1, "--update_epochs", 1, "--eval_freq", 200, "--no-cuda",
             "--no-capture_video", "--exp-name", "x", "--total_timesteps", 8 * num_iterations)  # fmt: skip
    process = subprocess.Popen(
        [sys.executable, str(ROOT / "ppo.py"), *map(str, flags)], cwd=tmp_path, env={**os.environ, **NO_VULKAN},
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    samples, file = [], tmp_path / "runs/x/metrics.jsonl"  # (finished share of the run, MiB of both processes)
    while process.poll() is None:
        with contextlib.suppress(psutil.NoSuchProcess):
            tree = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
            done = file.read_bytes().count(b"\n") / num_iterations if file.exists() else 0.0
            samples.append((done, sum(p.memory_info().rss for p in tree) / 2**20))
        time.sleep(0.05)
    assert process.returncode == 0
    early = [memory for done, memory in samples if 0.3 < done < 0.4]
    late = [memory for done, memory in samples if 0.85 < done < 0.95]
    assert len(early) > 5 and len(late) > 5
    assert statistics.median(late) - statistics.median(early) < 6, samples[:: len(samples) // 50]
