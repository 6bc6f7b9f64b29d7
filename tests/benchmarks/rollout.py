"""How fast the CPU simulates: a batch compared with ManiSkill's single environment, and the rollout phase of training
compared with physics alone and with another version of the scripts.

    uv run tests/benchmarks/rollout.py --checkpoint runs/NAME/best.pt
    uv run tests/benchmarks/rollout.py --checkpoint runs/NAME/best.pt --base ../other-worktree
    uv run tests/benchmarks/rollout.py --checkpoint runs/NAME/best.pt --physics_alone 1    # one process; a number

The candidates take turns, with several repetitions each, because the speed of a shared machine drifts: compare ratios.

  single, batch    one process with random actions in one environment, in 16 and in 32
  rollout phase    rollouts of ppo.py with the trained policy on all cores, as ppo.py itself logs them
  base             the same for the ppo.py in the folder --base
  physics alone    on all cores at once: repeats the calls of such a rollout to the physics systems, from the same
                   states; only their step() is timed
"""

import argparse
import contextlib
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
import ppo

# isort: split
import gymnasium as gym
import torch
import torch.multiprocessing as mp


def random_actions(env_id, num_envs, steps):
    """Returns the steps per second of one process."""
    torch.set_num_threads(1)
    env = gym.make(env_id, num_envs=num_envs, obs_mode="state", sim_backend="physx_cpu", render_backend="none")
    env.reset(seed=0)
    shape = (num_envs, *env.unwrapped.single_action_space.shape)
    actions = 2 * torch.rand(steps + 5, *shape) - 1
    for action in actions[:5]:
        env.step(action)
    start = time.perf_counter()
    for action in actions[5:]:
        env.step(action)
    rate = steps * num_envs / (time.perf_counter() - start)
    env.close()
    return rate


def rollout_phase(script, checkpoint, iterations):
    """Returns the median steps per second of the rollout phase. This training leaves the policy as it is."""
    with tempfile.TemporaryDirectory() as folder:
        batch_size = ppo.parse_args(["--no-cuda"]).batch_size
        flags = (f"--no-cuda --no-capture_video --exp_name x --eval_freq 0 --num_eval_episodes 2 --num_eval_envs 2 "
                 f"--total_timesteps {batch_size * iterations} --learning_rate 1e-12 --update_epochs 1")  # fmt: skip
        command = [sys.executable, str(script), *flags.split(), "--checkpoint", str(checkpoint)]
        subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL, stdin=subprocess.DEVNULL)
        rows = [json.loads(line) for line in (Path(folder) / "runs/x/metrics.jsonl").read_text().splitlines()]
    rows = [row for row in rows if row["kind"] == "train"]
    steps = rows[0]["global_step"]  # of an iteration of that script
    return statistics.median([steps / row["rollout_time"] for row in rows[2:]])


class Recorder:
    """Records the calls to a batch's physics systems, step by step, and repeats them."""

    def __init__(self, px):
        self.px, self.log, self.step, self.known = px, [], px.step, None
        px.step = self.note

    def note(self):
        states = [system.pack() for system in self.px.systems]
        known = self.known or [None] * len(states)
        started = [(i, state) for i, state in enumerate(states) if state != known[i]]  # episodes that were reset
        self.step()
        self.log.append((started, self.px.cuda_articulation_target_qpos.data.clone()))
        self.known = [system.pack() for system in self.px.systems]

    def replay(self):
        """Repeat the calls; returns the seconds in step() alone."""
        seconds, applied, systems = 0.0, None, self.px.systems
        for started, targets in self.log:
            for i, state in started:
                systems[i].unpack(state)
            if applied is None or not torch.equal(targets, applied):
                for joints, row in zip(self.px.joints, targets.tolist()):
                    for joint, target in zip(joints, row):
                        joint.set_drive_target(target)
                applied = targets
            start = time.perf_counter()
            for system in systems:
                system.step()
            seconds += time.perf_counter() - start
        return seconds


def physics_alone(index, num_actors, checkpoint, barrier, queue):
    torch.set_num_threads(1)
    flags = f"--no-cuda --no-capture_video --num_actors {num_actors} --checkpoint {checkpoint} --exp_name x"
    args = ppo.parse_args(flags.split())
    actor = ppo.Actor(args, index)
    agent = ppo.Agent(actor.envs.single_observation_space, actor.envs.single_action_space, args)
    agent.load_state_dict(ppo.load_checkpoint(checkpoint)["agent"])
    spaces, cpu = (actor.envs.single_observation_space, actor.envs.single_action_space), torch.device("cpu")
    actor.receive(agent, ppo.make_storage(agent, *spaces, args, cpu))
    actor.rollout(0, is_first=True)
    recorder = Recorder(actor.envs.base_env.scene.px)
    actor.rollout(1, is_first=False)
    recorder.px.step = recorder.step
    for _ in range(3):
        barrier.wait()
        seconds = recorder.replay()
        barrier.wait()
    queue.put(args.num_steps * len(actor.env_idx) / seconds)
    actor.close()


def physics_of_processes(num_actors, checkpoint):
    """Returns the steps per second of all processes together."""
    context = mp.get_context("spawn")
    barrier, queue = context.Barrier(num_actors), context.Queue()
    arguments = (num_actors, checkpoint, barrier, queue)
    processes = [context.Process(target=physics_alone, args=(i, *arguments)) for i in range(num_actors)]
    for process in processes:
        process.start()
    rate = sum(queue.get() for _ in processes)
    for process in processes:
        process.join()
    return rate


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=os.path.abspath, required=True)
    parser.add_argument("--base", type=os.path.abspath)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--iterations", type=int, default=12)
    parser.add_argument("--physics_alone", type=int, metavar="N", help="measure only this, with N processes")
    options = parser.parse_args()
    if options.physics_alone:
        with contextlib.redirect_stdout(sys.stderr):
            rate = physics_of_processes(options.physics_alone, options.checkpoint)
        print(round(rate))
        return

    env_id = ppo.load_checkpoint(options.checkpoint)["args"]["env_id"]
    script = Path(ppo.__file__)
    candidates = {
        "single": lambda: random_actions(env_id, 1, 300),
        "batch": lambda: random_actions(env_id, 16, 60),
        "batch of 32": lambda: random_actions(env_id, 32, 30),
        "rollout phase": lambda: rollout_phase(script, options.checkpoint, options.iterations),
        "physics alone": lambda: physics_of_processes(ppo.num_cores(), options.checkpoint),
    }
    if options.base:
        base = Path(options.base) / "ppo.py"
        candidates["base"] = lambda: rollout_phase(base, options.checkpoint, options.iterations)
    rates = {name: [] for name in candidates}
    for _ in range(options.repetitions):
        for name, candidate in candidates.items():
            with contextlib.redirect_stdout(sys.stderr):
                rates[name].append(candidate())

    print(f"\n{env_id}, {ppo.num_cores()} cores of {platform.processor() or platform.machine()}, torch "
          f"{torch.__version__}; steps/s, median (min to max) of {options.repetitions} repetitions")  # fmt: skip
    for name, values in rates.items():
        print(f"  {name:<32}{statistics.median(values):8,.0f}   ({min(values):,.0f} to {max(values):,.0f})")
    print("ratios, repetition by repetition")
    for a, b in (
        ("batch", "single"),
        ("batch of 32", "single"),
        ("rollout phase", "base"),
        ("rollout phase", "physics alone"),
    ):
        if b in rates:
            ratios = [x / y for x, y in zip(rates[a], rates[b])]
            print(f"  {a + ' / ' + b:<32}{statistics.median(ratios):8.2f}   ({min(ratios):.2f} to {max(ratios):.2f})")


if __name__ == "__main__":
    main()
