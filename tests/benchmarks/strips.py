"""Draw a film strip of each run: one unseen episode of its best.pt, from the first frame to the last.

python tests/benchmarks/strips.py tests/benchmarks/films runs/A runs/B ...      # writes films/<task of A>.png, …
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
    args.render_backend, args.sim_backend, args.capture_video = "gpu", "physx_cpu", True
    with contextlib.ExitStack() as closing:
        ppo.Film(args, run, closing)  # makes the renderer
        envs = ppo.make_envs(args, 1, seed, evaluation=True, film=True)
        closing.callback(envs.close)
        frames = Frames()
        ppo.evaluate(agent, envs, args, 1, seed, video=frames)
    return args.env_id.rpartition(":")[2], frames


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--seed", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=8)
    options = parser.parse_args()

    options.folder.mkdir(exist_ok=True)
    for run in options.runs:
        task, frames = film(run, options.seed)
        figure = Figure(figsize=(1.5 * options.frames, 1.65), layout="constrained")
        draw_frames(figure.subplots(1, options.frames), frames)
        figure.savefig(options.folder / f"{task}.png", dpi=80)


if __name__ == "__main__":
    main()
