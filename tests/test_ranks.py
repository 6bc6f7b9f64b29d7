"""Several processes, started by torchrun, train together as one process would with all their environments."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import ROOT, box, read_metrics, refused

import ppo
import ppo_rgb

FLAGS = ("--num_envs", 32, "--num_eval_envs", 4, "--num_actors", 2, "--num_eval_episodes", 5, "--num_steps", 10,
         "--num_minibatches", 4, "--no-cuda", "--no-capture_video", "--eval_freq", 2)  # fmt: skip


def launch(cwd, *arguments):
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2", __file__]
    return subprocess.Popen(
        [*torchrun, *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def one_step(script, rows, rank, world_size):
    """Take a gradient step and update the normalization on this rank's rows; returns the state and the metrics."""
    torch.set_num_threads(1)  # another number of threads changes the last bits
    torch.manual_seed(0)
    args = script.Args(num_minibatches=1, norm_obs=True, desired_kl=None)
    obs, space = torch.randn(rows, 3), box(3)
    if script is ppo_rgb:
        obs = {"state": obs, "rgb": torch.randint(256, (rows, 36, 36, 3), dtype=torch.uint8)}
        space = gym.spaces.Dict(state=space, rgb=gym.spaces.Box(0, 255, (36, 36, 3), np.uint8))
    agent = script.Agent(space, box(2), args)
    optimizer = torch.optim.SGD(agent.parameters(), lr=1.0)  # a step of this optimizer is the gradient itself
    actions, (logprobs, advantages, returns, values) = torch.randn(rows, 2), torch.randn(4, rows)
    advantages[: rows // 2] = 5 * advantages[: rows // 2] + 2  # the halves differ in mean and scale
    share = slice(rank * rows // world_size, (rank + 1) * rows // world_size)
    batch = [x[share] for x in (actions, logprobs, advantages, returns, values)]
    obs = {k: v[share] for k, v in obs.items()} if script is ppo_rgb else obs[share]
    metrics = script.all_reduce_mean(script.update_minibatch(agent, optimizer, args, obs, *batch))
    agent.update_normalization(obs)
    return {**agent.state_dict(), "metrics": metrics}


@pytest.mark.slow
def test_two_processes_train_together(tmp_path, monkeypatch, capsys):
    process = launch(tmp_path, "--total_timesteps", 960, "--exp-name", "x", *FLAGS)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output

    # the step equals that of one process on all rows
    for script in (ppo, ppo_rgb):
        expected = one_step(script, 40, 0, 1)
        for rank in (0, 1):
            step = torch.load(tmp_path / f"{script.__name__}{rank}.pt")
            for key, value in expected.items():
                torch.testing.assert_close(step[key], value, rtol=1e-4, atol=1e-5)

    # both processes end with the same weights, although their training episodes differ
    ranks = [torch.load(tmp_path / f"rank{rank}.pt") for rank in (0, 1)]
    assert all(torch.equal(ranks[0]["agent"][k], ranks[1]["agent"][k]) for k in ranks[0]["agent"])
    assert not torch.equal(ranks[0]["actions"], ranks[1]["actions"])
    assert len({*ranks[0]["seeds"], *ranks[1]["seeds"]}) == 32, "one for each environment of both"

    # only the first process writes the run folder
    assert sorted(path.name.split(".out")[0] for path in (tmp_path / "runs/x").iterdir()) == [
        ".lock", "args.json", "best.pt", "events", "last.pt", "learning_curve.png", "metrics.jsonl"
    ]  # fmt: skip
    rows = read_metrics(tmp_path / "runs/x")
    assert [row["global_step"] for row in rows if row["kind"] == "train"] == [320, 640, 960]
    assert [row["num_episodes"] for row in rows if row["kind"] == "eval"] == [6, 6, 6], "at least 5: 3 in each process"
    assert output.count("writing to") == 1

    # one process alone cannot resume this run
    monkeypatch.chdir(tmp_path)
    assert "torchrun --nproc_per_node=2" in refused(["--resume", "runs/x", "--total_timesteps", 2000], capsys)


def wait_for(condition, seconds=120):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def last_step(folder):
    rows = read_metrics(folder) if (folder / "metrics.jsonl").exists() else []
    return rows[-1]["global_step"] if rows else 0


@pytest.mark.slow
def test_stopped_resumed_and_killed(tmp_path):
    """Both processes stop an update at the same epoch (--target_kl): else they would wait for each other."""
    folder, target_kl = tmp_path / "runs/x", ("--desired_kl", "None", "--learning_rate", 1e-4, "--target_kl", 0.003)
    process = launch(tmp_path, "--total_timesteps", 10**7, "--exp-name", "x", *target_kl, *FLAGS)
    wait_for(lambda: last_step(folder) > 1000 or process.poll() is not None)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=60)
    assert "stopped by SIGTERM" in output and "last.pt is safe" in output, output
    stopped_at = ppo.load_checkpoint(folder / "last.pt")["global_step"]
    assert last_step(folder) - stopped_at in (0, 320), "the state at the beginning of the iteration"

    process = launch(tmp_path, "--resume", folder, "--checkpoint_freq", 1)
    wait_for(lambda: last_step(folder) > stopped_at + 1000 or process.poll() is not None)
    os.kill(int((tmp_path / "pid1").read_text()), signal.SIGKILL)
    start = time.monotonic()
    output, _ = process.communicate(timeout=60)
    assert time.monotonic() - start < 20
    # process 0 loses its connection; torchrun may end it before it has printed so
    assert process.returncode != 0 and "Signal 9 (SIGKILL)" in output, output
    steps = [row["global_step"] for row in read_metrics(folder) if row["kind"] == "train"]
    assert steps == list(range(320, steps[-1] + 1, 320)), "no row twice, none missing"
    assert ppo.load_checkpoint(folder / "last.pt")["global_step"] >= steps[-1] - 320


if __name__ == "__main__":  # torchrun runs this in each process
    import batched_env

    Path(f"pid{ppo.RANK}").write_text(str(os.getpid()))
    agents, make_agent, actions, seeds = [], ppo.Agent, [], []

    def kept_agent(*arguments):
        agents.append(make_agent(*arguments))
        return agents[-1]

    def envs_that_record(*arguments, evaluation=False, **kwargs):
        envs = batched_env.make_envs(*arguments, evaluation=evaluation, **kwargs)
        step, reset = envs.step, envs.reset
        if not evaluation:
            envs.step = lambda action: actions.append(action) or step(action)
            envs.reset = lambda seed=None, **options: seeds.extend(seed or []) or reset(seed=seed, **options)
        return envs

    ppo.Agent, ppo.make_envs = kept_agent, envs_that_record
    torch.distributed.destroy_process_group = lambda: None  # one_step needs the process group
    code = ppo.main(sys.argv[1:])
    if code:  # one_step needs the other process: where the run was stopped, that one may still wait within an update
        sys.exit(code)
    ppo.Agent = make_agent
    for script in (ppo, ppo_rgb):
        torch.save(one_step(script, 40, ppo.RANK, 2), f"{script.__name__}{ppo.RANK}.pt")
    torch.save({"agent": agents[0].state_dict(), "actions": actions[-1], "seeds": seeds}, f"rank{ppo.RANK}.pt")
