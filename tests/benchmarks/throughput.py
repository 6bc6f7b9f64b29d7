"""Training throughput on PushCube-v1 with CPU simulation, compared with Stable-Baselines3, and next to other work.

    uv run --group benchmark tests/benchmarks/throughput.py

One run alternates between the candidates, with several repetitions each, and prints medians and spread. The speed of a
shared machine drifts: compare ratios, not absolute figures. Both learners have the same networks (3 x 256, tanh, one
for policy and one for value), minibatch size, epochs and batch. Neither has a target KL, and both have a
fixed learning rate. The candidates:

  ppo.py            its defaults: one process for each core, a share of the batch of environments in each
  SB3               Stable-Baselines3's PPO, 8 environments in 8 subprocesses (SubprocVecEnv)
  ppo.py, loaded    ppo.py while two other processes run endless loops
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import gymnasium as gym
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))
import ppo

MINIBATCHES, EPOCHS = 4, 8
SCRIPT = Path(ppo.__file__)


def batch_size():
    """Steps of an iteration: the default of ppo.py with these cores."""
    return ppo.parse_args(["--no-cuda"]).batch_size


def ours(iterations):
    """Run ppo.py as a command; returns the steps per second of each iteration after the first."""
    flags = (f"--no-cuda --num_minibatches {MINIBATCHES} --target_kl None --desired_kl None --no-anneal_lr "
             f"--update_epochs {EPOCHS} --total_timesteps {batch_size() * iterations} --eval_freq 0 "
             "--num_eval_episodes 2 --num_eval_envs 2 --no-capture_video --exp_name x")  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(SCRIPT), *flags.split()]
        subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL, stdin=subprocess.DEVNULL)
        rows = [json.loads(line) for line in (Path(folder) / "runs/x/metrics.jsonl").read_text().splitlines()]
    return [row["sps"] for row in rows if row["kind"] == "train"][1:]


def ours_next_to_other_work(iterations):
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        return ours(iterations)
    finally:
        for process in others:
            process.kill()


def sb3_env():
    import mani_skill.envs  # noqa: F401
    from mani_skill.utils.wrappers import CPUGymWrapper

    torch.set_num_threads(1)
    env = gym.make("PushCube-v1", obs_mode="state", control_mode="pd_joint_delta_pos", sim_backend="physx_cpu",
                   render_backend="none")  # fmt: skip
    return CPUGymWrapper(env)


def stable_baselines3(iterations):
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import SubprocVecEnv

    class Timer(BaseCallback):
        def __init__(self):
            super().__init__()
            self.starts = []

        def _on_step(self):
            return True

        def _on_rollout_start(self):
            self.starts.append(time.perf_counter())

    torch.set_num_threads(ppo.num_cores())
    batch = batch_size()
    envs = SubprocVecEnv([sb3_env] * 8, start_method="spawn")
    network = dict(pi=[256] * 3, vf=[256] * 3)
    model = PPO("MlpPolicy", envs, n_steps=batch // 8, batch_size=batch // MINIBATCHES, n_epochs=EPOCHS, gamma=0.8,
                gae_lambda=0.9, learning_rate=3e-4, max_grad_norm=0.5, device="cpu", seed=1,
                policy_kwargs=dict(net_arch=network, activation_fn=torch.nn.Tanh))  # fmt: skip
    timer = Timer()
    model.learn(batch * (iterations + 1), callback=timer)
    envs.close()
    return [batch / (b - a) for a, b in zip(timer.starts, timer.starts[1:])][1:]


CANDIDATES = {"ppo.py": ours, "SB3": stable_baselines3, "ppo.py, loaded": ours_next_to_other_work}


def compare(options):
    rates = {name: [] for name in CANDIDATES}
    for _ in range(options.repetitions):
        for name, candidate in CANDIDATES.items():
            rates[name].append(statistics.median(candidate(options.iterations)))

    print(f"\nPushCube-v1, {ppo.num_cores()} cores of {platform.processor() or platform.machine()}, "
          f"torch {torch.__version__}; steps/s, median (min to max) of {options.repetitions} repetitions")  # fmt: skip
    for name, values in rates.items():
        print(f"  {name:<24}{statistics.median(values):8,.0f}   ({min(values):,.0f} to {max(values):,.0f})")
    print("ratios, repetition by repetition")
    for a, b in (("ppo.py", "SB3"), ("ppo.py, loaded", "ppo.py")):
        ratios = [x / y for x, y in zip(rates[a], rates[b])]
        print(f"  {a + ' / ' + b:<44}{statistics.median(ratios):6.2f}   ({min(ratios):.2f} to {max(ratios):.2f})")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=8, help="iterations in each repetition")
    parser.add_argument("--cores", type=int, nargs="+", default=sorted({1, ppo.num_cores()}), help="how many to use")
    options = parser.parse_args()

    all_cores = sorted(os.sched_getaffinity(0))
    for cores in options.cores:
        os.sched_setaffinity(0, all_cores[:cores])  # subprocesses inherit this
        compare(options)


if __name__ == "__main__":
    main()
