"""How a task's episodes start: 16 resets side by side, with seeds 0 to 15, in new scenes.

python tests/benchmarks/starts.py examples.push_to_goal:PushToGoal-v1 push_to_goal.png
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import ppo  # noqa: F401  # before mani_skill: that can then use a software renderer

# isort: split
import gymnasium as gym
import imageio.v3 as iio
import torch

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("env_id")
parser.add_argument("path", help="where the picture goes")
options = parser.parse_args()
env = gym.make(
    options.env_id, render_mode="rgb_array", render_backend="cpu", sim_backend="physx_cpu",
    human_render_camera_configs=dict(width=192, height=192),
)  # fmt: skip
frames = []
for seed in range(16):
    env.reset(seed=seed, options=dict(reconfigure=True))
    frames.append(env.render()[0].cpu())
rows = [torch.cat(frames[i : i + 8], dim=1) for i in (0, 8)]
iio.imwrite(options.path, torch.cat(rows).numpy())
