"""Training throughput of ppo.py with different numbers of processes of torchrun, one GPU each.

    uv run tests/benchmarks/ranks.py --ranks 1 2 4 8
    uv run tests/benchmarks/ranks.py --ranks 1 2 --num_envs 8 --num_steps 100 --flags=--no-cuda     # on a CPU

Each process has `--num_envs` environments, so the work grows with the number of processes. The numbers take turns, with
several repetitions each, because the speed of a shared machine drifts: compare ratios. On a machine without a GPU, the
actors of one process already use all cores: there the table shows what more processes cost, not what they gain.
"""

import argparse
import json
import shlex
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "ppo.py"


def steps_per_second(ranks, options):
    """Train; returns the median steps per second of whole iterations, of their rollouts and of their updates. The first
    two iterations warm up and do not count."""
    with tempfile.TemporaryDirectory() as folder:
        batch = options.num_envs * options.num_steps * ranks
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", ranks, SCRIPT,
                   "--num_envs", options.num_envs * ranks, "--num_steps", options.num_steps, "--exp_name", "x",
                   "--total_timesteps", batch * options.iterations, "--eval_freq", 0,
                   "--num_eval_envs", ranks, "--num_eval_episodes", ranks, "--no-capture_video",
                   *options.flags]  # fmt: skip
        subprocess.run([*map(str, command)], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        rows = [json.loads(line) for line in (Path(folder) / "runs/x/metrics.jsonl").read_text().splitlines()]
    rows = [row for row in rows if row["kind"] == "train"][2:]
    return [statistics.median(rate) for rate in (
        [row["sps"] for row in rows],
        [batch / row["rollout_time"] for row in rows],
        [batch / row["update_time"] for row in rows],
    )]  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--num_envs", type=int, default=512, help="environments of each process")
    parser.add_argument("--num_steps", type=int, default=50)
    parser.add_argument("--iterations", type=int, default=8)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--flags", type=shlex.split, default=[], help="further flags of ppo.py")
    options = parser.parse_args()
    rates = {ranks: [] for ranks in options.ranks}
    for _ in range(options.repetitions):
        for ranks in options.ranks:
            rates[ranks].append(steps_per_second(ranks, options))
    print(f"{options.num_envs} environments per process; steps/s, median (lowest to highest) of {options.repetitions}")
    print(f"{'processes':>10}{'all':>28}{'rollout':>28}{'update':>28}{'speedup over the first':>28}")
    for ranks in options.ranks:
        columns = [*zip(*rates[ranks]), [a[0] / b[0] for a, b in zip(rates[ranks], rates[options.ranks[0]])]]
        cells = [f"{statistics.median(x):,.{n}f} ({min(x):,.{n}f} to {max(x):,.{n}f})"
                 for x, n in zip(columns, (0, 0, 0, 2))]  # fmt: skip
        print(f"{ranks:>10}" + "".join(f"{cell:>28}" for cell in cells))


if __name__ == "__main__":
    main()
