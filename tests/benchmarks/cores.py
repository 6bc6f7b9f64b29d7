"""What the default flags become on machines with other numbers of CPU cores, and how long they would train there.

    uv run tests/benchmarks/cores.py [--env_id PickCube-v1]

The number of cores is pretended. Measured here are a step of one actor with its share of the environments, and a
minibatch of the update on one thread and on two: the faster counts. Not counted are evaluations, and what actors cost
each other: shared caches, memory bandwidth, a lower clock. Machines with many cores would be slower than the table.
"""

import argparse
import statistics
import sys
import timeit
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parents[2]))
import ppo

# isort: split
import torch


def median_time(function, repetitions: int) -> float:
    """Seconds."""
    return statistics.median(timeit.repeat(function, number=1, repeat=repetitions))


def step_time(args: ppo.Args, num_envs: int) -> float:
    """Seconds of a step of one actor with these environments, its policy included."""
    torch.set_num_threads(1)
    envs = ppo.make_envs(args, num_envs, seed=0)
    agent = ppo.make_agent(envs.single_observation_space, envs.single_action_space, args, {})
    obs, _ = envs.reset(seed=list(range(num_envs)))

    with torch.no_grad():
        seconds = median_time(lambda: envs.step(agent.clip_action(agent.get_action_and_value(obs)[0])), 100)
    envs.close()
    return seconds


def minibatch_time(args: ppo.Args, size: int) -> float:
    """Seconds of a gradient step, on one thread or two."""
    obs_space, action_space = (ppo.gym.spaces.Box(-1, 1, (n,)) for n in (35, 8))
    agent = ppo.make_agent(obs_space, action_space, args, {})
    optimizer = ppo.make_optimizer(agent, args, torch.device("cpu"))
    vectors = [torch.zeros(size) for _ in range(4)]
    tensors = torch.randn(size, 35), torch.randn(size, 8), *vectors
    seconds = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        seconds.append(median_time(lambda: ppo.update_minibatch(agent, optimizer, args, *tensors), 50))
    return min(seconds)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env_id", default="PushCube-v1")
    env_id = parser.parse_args().env_id
    print(
        "| cores | environments x steps | all steps | gradient steps | rollout of an iteration | its update | run |\n"
        "| --- | --- | --- | --- | --- | --- | --- |"
    )
    for cores in (1, 2, 4, 8, 16, 32, 64):
        with mock.patch.object(ppo, "num_cores", lambda cores=cores: cores):
            args = ppo.parse_args(["--no-cuda", "--env_id", env_id])
        gradient_steps = args.update_epochs * args.num_minibatches
        rollout = args.num_steps * step_time(args, len(ppo.even_share(args.num_envs, 0, args.num_actors)))
        update = gradient_steps * minibatch_time(args, args.batch_size // args.num_minibatches)
        seconds = args.num_iterations * (rollout + update)
        print(
            f"| {cores} | {args.num_envs} x {args.num_steps} | {args.num_iterations * args.batch_size:,} "
            f"| {args.num_iterations * gradient_steps:,} | {rollout:.2f} s | {update:.2f} s | {seconds:.0f} s |"
        )


if __name__ == "__main__":
    main()
