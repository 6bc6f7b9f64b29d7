"""Train on the torch-native environments, once undisturbed and once killed twenty times at random moments.

Each attempt runs in a forked child, so the imports happen only once. Forking is safe because this process itself
computes nothing."""

import contextlib
import os
import random
import signal
import sys
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
import batched_env
import matplotlib.figure  # noqa: F401
import torch._dynamo  # noqa: F401
import torch.utils.tensorboard  # noqa: F401

import ppo

ARGS = dict(
    sim_backend="physx_cpu", num_envs=16, num_eval_envs=8, num_actors=1, num_eval_episodes=8, num_steps=10,
    total_timesteps=16 * 10 * 150, num_minibatches=2, update_epochs=1, eval_freq=25, capture_video=False, cuda=False,
    norm_obs=True, anneal_lr=True, checkpoint_freq=3, exact_resume=True,
)  # fmt: skip


def attempt(**flags):
    """Train in a forked child; returns its process id."""
    pid = os.fork()
    if pid == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        ppo.make_envs = batched_env.make_envs
        code = 1
        with contextlib.suppress(SystemExit), contextlib.ExitStack() as closing:
            ppo.train(ppo.Args(**ARGS, **flags), closing)
            code = 0
        os._exit(code)
    return pid


def resume_or_start():
    last = Path("runs/killed/last.pt")
    return attempt(resume=str(last)) if last.exists() else attempt(exp_name="killed")


if __name__ == "__main__":
    random.seed(0)
    assert os.waitpid(attempt(exp_name="whole"), 0)[1] == 0
    metrics, progress = Path("runs/killed/metrics.jsonl"), []
    for _ in range(20):
        rows = metrics.read_bytes().count(b"\n") if metrics.exists() else 0
        pid, goal = resume_or_start(), rows + random.randrange(10)
        deadline = time.monotonic() + 20
        time.sleep(random.uniform(0.0, 0.2))  # often the run is still starting
        while metrics.exists() and metrics.read_bytes().count(b"\n") < goal and time.monotonic() < deadline:
            time.sleep(0.002)
        time.sleep(random.uniform(0.0, 0.05))  # an iteration takes about this long
        os.kill(pid, signal.SIGKILL)
        assert os.waitpid(pid, 0)[1] == signal.SIGKILL, "the run ended before the twentieth kill"
        if Path("runs/killed/last.pt").exists():
            progress.append(ppo.load_checkpoint("runs/killed/last.pt")["iteration"])  # readable at any instant
    assert os.waitpid(resume_or_start(), 0)[1] == 0
    assert progress == sorted(progress) and len(set(progress)) > 8
    print(f"20 kills, the last at iteration {progress[-1]}")
