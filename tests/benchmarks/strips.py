"""Draw a film strip of each run: one unseen episode of its best.pt, from the first frame to the last.

python tests/benchmarks/strips.py OUT.png runs/A runs/B ...
"""

import argparse
import contextlib
import sys
from pathlib import Path

from matplotlib.figure import Figure
from picture import draw_frames

sys.path.insert(0, str(Path(__file__).parents[2]))
import ppo


class Frames(list):
    """Takes pictures as a writer of videos does."""

    append_data = list.append


def film(run: Path, seed: int) -> tuple[str, list]:
    """The name of the task, and the frames of an episode."""
    agent, args = ppo.load_agent(run / "best.pt")
    args.render_backend, args.sim_backend = "gpu", "physx_cpu"
    with contextlib.ExitStack() as closing:
        ppo.Film(args, run, closing)  # makes the renderer
        envs = ppo.make_envs(args, 1, seed, evaluation=True, film=True)
        closing.callback(envs.close)
        frames = Frames()
        ppo.evaluate(agent, envs, args, 1, seed, video=frames)
    return args.env_id.rpartition(":")[2], frames


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out")
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--seed", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=6)
    options = parser.parse_args()

    figure = Figure(figsize=(1.5 * options.frames, 1.65 * len(options.runs)), layout="constrained")
    axes = figure.subplots(len(options.runs), options.frames, squeeze=False)
    for row, run in zip(axes, options.runs):
        task, frames = film(run, options.seed)
        draw_frames(row, frames)
        row[0].set_title(task, fontsize=8)
    figure.savefig(options.out, dpi=80)


if __name__ == "__main__":
    main()
