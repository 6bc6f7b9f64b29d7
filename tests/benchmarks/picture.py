"""Draw the README's picture from finished runs: learning curves over steps and minutes, and frames of a video.

python tests/benchmarks/picture.py OUT.png runs/A runs/B ... --video runs/A/test_videos/seed_1000.mp4
"""

import argparse
import json
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from matplotlib.figure import Figure
from results import learning_curve


def draw_frames(axes, images) -> None:
    """A frame on each axis, from the first to the last."""
    chosen = np.linspace(0, len(images) - 1, len(axes)).round().astype(int)
    for axis, index in zip(axes, chosen):
        axis.imshow(images[index])
        axis.set_title(f"step {index}", fontsize=8)
        axis.axis("off")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out")
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--metrics", nargs="+", default=["success_once", "success_at_end"], help="drawn - and --")
    parser.add_argument("--video", help="video whose frames are put below the curves")
    parser.add_argument("--frames", type=int, default=6)
    options = parser.parse_args()

    figure = Figure(figsize=(10, 5 if options.video else 3.2), layout="constrained")
    above, *below = figure.subfigures(2, 1, height_ratios=[3, 2]) if options.video else [figure]
    by_steps, by_minutes = above.subplots(1, 2, sharey=True)
    for i, run in enumerate(options.runs):
        args = json.loads((run / "args.json").read_text())["args"]
        for metric, style in zip(options.metrics, ("-", "--")):
            steps, seconds, values = zip(*learning_curve(run, metric))
            for axis, x in ((by_steps, steps), (by_minutes, [x / 60 for x in seconds])):
                axis.plot(x, values, f"C{i}{style}", marker="o", markersize=3, label=f"{run.name}: {metric}")
    by_steps.set(xlabel="environment steps", ylabel="evaluation")
    by_minutes.set(xlabel="minutes of training (rollout and update)")
    by_minutes.legend(loc="lower right", fontsize=7)
    for axis in (by_steps, by_minutes):
        axis.grid(alpha=0.3)
    above.suptitle(args["env_id"])
    for subfigure in below:
        draw_frames(subfigure.subplots(1, options.frames), iio.imread(options.video))
    figure.savefig(options.out, dpi=100)


if __name__ == "__main__":
    main()
