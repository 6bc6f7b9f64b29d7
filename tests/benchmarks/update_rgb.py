"""Speed (images per second) and memory of ppo_rgb.py's update, by precision and memory format, and compiled.

    uv run tests/benchmarks/update_rgb.py
    uv run tests/benchmarks/update_rgb.py --num_envs 8 --num_steps 16 --size 64 --num_minibatches 8      # on a CPU

The variants take turns, with several repetitions each, because the speed of a shared machine drifts. The table gives
medians, and the spread of the ratio to the first variant in the same turn. As in `train`, each minibatch is gathered
from the rollout's uint8 buffers.
"""

import argparse
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))
import ppo_rgb


class Variant:
    def __init__(self, name, args, spaces, compiled=False):
        torch.manual_seed(0)
        device = ppo_rgb.choose_device(args)
        self.name, self.args, self.seconds = name, args, []
        self.agent = ppo_rgb.Agent(*spaces, args).to(device)
        if compiled:
            self.agent.encoder = torch.compile(self.agent.encoder)
        self.optimizer = torch.optim.Adam(self.agent.parameters(), fused=True)

    def update(self, obs, others, num_minibatches):
        """Run `num_minibatches` minibatches; returns the mean seconds of one."""
        cuda = others[0].is_cuda
        if cuda:
            torch.cuda.reset_peak_memory_stats()
            torch.cuda.synchronize()
        start = time.perf_counter()
        permutation = torch.randperm(self.args.batch_size, device=others[0].device)
        for i in range(num_minibatches):
            mb_inds = permutation.chunk(self.args.num_minibatches)[i]
            minibatch = [{k: v[mb_inds] for k, v in obs.items()}, *(x[mb_inds] for x in others)]
            ppo_rgb.update_minibatch(self.agent, self.optimizer, self.args, *minibatch)
        if cuda:
            torch.cuda.synchronize()
        self.peak = torch.cuda.max_memory_allocated() if cuda else 0
        return (time.perf_counter() - start) / num_minibatches


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_envs", type=int, default=1024)
    parser.add_argument("--num_steps", type=int, default=16)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--num_minibatches", type=int, default=32)
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--encoder", default="nature")
    options = parser.parse_args()

    torch.set_num_threads(max(1, int(ppo_rgb.num_cores() * ppo_rgb.UPDATE_THREADS_PER_CORE)))
    size = (options.size, options.size, 3)
    spaces = (
        gym.spaces.Dict(rgb=gym.spaces.Box(0, 255, size, np.uint8), state=gym.spaces.Box(-9, 9, (32,), np.float32)),
        gym.spaces.Box(-1, 1, (8,), np.float32),
    )
    args = ppo_rgb.Args(
        num_envs=options.num_envs, num_steps=options.num_steps, num_minibatches=options.num_minibatches,
        encoder=options.encoder, channels_last=False, sim_backend="physx_cpu",
    )  # fmt: skip
    device, rows = ppo_rgb.choose_device(args), args.batch_size
    obs = {
        k: torch.zeros(rows, *v.shape, dtype=getattr(torch, v.dtype.name), device=device) for k, v in spaces[0].items()
    }
    obs["rgb"].random_(0, 255)
    others = [torch.randn(rows, 8, device=device), *torch.randn(4, rows, device=device)]
    last = replace(args, channels_last=True)
    variants = [
        Variant("float32", args, spaces),
        Variant("float32, channels-last", last, spaces),
        Variant("bfloat16", replace(args, amp=True), spaces),
        Variant("bfloat16, channels-last", replace(last, amp=True), spaces),
    ]
    if device.type == "cuda":
        variants.append(Variant("bfloat16, channels-last, compiled", replace(last, amp=True), spaces, compiled=True))
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"CPU, {ppo_rgb.num_cores()} cores"
    buffers = sum(v.numel() * v.element_size() for v in obs.values()) / 2**20
    print(f"{name}, torch {torch.__version__}: {options.encoder}, {options.size}x{options.size}, minibatches of "
          f"{rows // args.num_minibatches}, observations {buffers:,.0f} MiB")  # fmt: skip
    for repetition in range(options.repetitions + 1):
        for variant in variants if repetition % 2 else variants[::-1]:
            seconds = variant.update(obs, others, min(4, options.num_minibatches))
            if repetition:  # the first repetition warms up
                variant.seconds.append(seconds)
    print(f"{'':36}{'images/s':>10}{'speedup over the first (min, max)':>36}{'peak MiB':>10}")
    for variant in variants:
        ratios = sorted(a / b for a, b in zip(variants[0].seconds, variant.seconds))
        rate = rows // args.num_minibatches / statistics.median(variant.seconds)
        spread = f"{statistics.median(ratios):.2f} ({ratios[0]:.2f}, {ratios[-1]:.2f})"
        print(f"{variant.name:36}{rate:10,.0f}{spread:>36}{variant.peak / 2**20:10,.0f}")


if __name__ == "__main__":
    main()
