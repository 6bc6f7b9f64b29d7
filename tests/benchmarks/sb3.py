"""Stable-Baselines3's PPO on a task of ManiSkill, to compare with: as its zoo sets up MuJoCo's robots, with the default
hyperparameters and VecNormalize. It trains in 8 environments of ppo.py's batch, and each episode goes on to its limit.

    uv run --group benchmark tests/benchmarks/sb3.py --env_id PushCube-v1 --total_timesteps 120000 --seed 4 --exp_name x

Writes runs/<exp_name>/: metrics.jsonl and args.json like ppo.py, and best.json and last.json, the results of --episodes
unseen episodes of the best policy and of the last one. Success rates of one evaluation choose the best; ppo.py checks
them with as many other episodes.
"""

import argparse
import copy
import importlib.metadata
import json
import sys
import time
from pathlib import Path

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

sys.path.insert(0, str(Path(__file__).parents[2]))
import ppo

NUM_ENVS, NUM_STEPS = 8, 256  # together as many steps an iteration as SB3's default for one environment
PACKAGES = ("stable-baselines3", "torch", "mani-skill", "sapien")


class BatchedVecEnv(VecEnv):
    """SB3's interface for a ManiSkillVectorEnv whose episodes end at the time limit alone."""

    def __init__(self, envs):
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        self.envs = envs

    def reset(self):
        return self.envs.reset()[0].numpy()

    def step_async(self, actions):
        self.actions = torch.from_numpy(actions)

    def step_wait(self):
        obs, reward, _, truncated, infos = self.envs.step(self.actions)
        new_infos = [{} for _ in range(self.num_envs)]
        for i in truncated.nonzero().flatten().tolist():
            new_infos[i] = {
                "terminal_observation": infos["final_observation"][i].numpy(),
                "TimeLimit.truncated": True,
            }
        return obs.numpy(), reward.numpy(), truncated.numpy(), new_infos

    def close(self):
        self.envs.close()

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.envs, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError


class Policy:
    """SB3's policy and its normalisation of observations, as ppo.evaluate asks for it."""

    def __init__(self, model):
        self.policy, self.envs = model.policy, model.get_vec_normalize_env()

    def get_action(self, obs):
        obs = self.envs.normalize_obs(obs.numpy())
        return torch.from_numpy(self.policy.predict(obs, deterministic=True)[0])

    def state(self):
        return copy.deepcopy((self.policy.state_dict(), self.envs.obs_rms))

    def load(self, state):
        weights, self.envs.obs_rms = state
        self.policy.load_state_dict(weights)


class Evaluation(BaseCallback):
    """Evaluates every `interval` steps, and keeps the best policy."""

    def __init__(self, args, eval_envs, interval, file):
        super().__init__()
        self.args, self.eval_envs, self.interval, self.file = args, eval_envs, interval, file
        self.best_score, self.next_step, self.start = [-1.0], 0, None

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        if self.start is not None:
            seconds = time.perf_counter() - self.start
            self.write(kind="train", rollout_time=seconds, update_time=0.0)  # together
        if self.num_timesteps >= min(self.next_step, self.args.total_timesteps):
            self.evaluate()
            self.next_step += self.interval
        self.start = time.perf_counter()

    def _on_training_end(self):
        self._on_rollout_start()

    def evaluate(self):
        policy = Policy(self.model)
        episodes = evaluate(policy, self.eval_envs, self.args, self.args.num_eval_episodes, 0)
        self.write(kind="eval", **{k: v.mean().item() for k, v in episodes.items()})
        if ppo.score(episodes) > self.best_score:
            self.best_score, self.best = ppo.score(episodes), policy.state()
        ppo.seed_all(self.args.seed, self.num_timesteps)  # else each evaluation would leave the same random numbers

    def write(self, **row):
        self.file.write(json.dumps(dict(global_step=self.num_timesteps) | row) + "\n")
        self.file.flush()


def evaluate(policy, envs, args, num_episodes, seed):
    return ppo.evaluate(policy, envs, args, num_episodes, seed, separately=ppo.find_reset_error(envs) is None)


def summarise(episodes):
    """Mean and 95% interval of each metric."""
    return {k: v.mean().item() for k, v in episodes.items()} | {
        f"{k}_interval": ppo.interval(v) for k, v in episodes.items()
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env_id", required=True)
    parser.add_argument("--total_timesteps", type=int, required=True)
    parser.add_argument("--eval_interval", type=int, default=16_000, help="steps from one evaluation to the next")
    parser.add_argument("--num_eval_episodes", type=int, default=64)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--exp_name", required=True)
    parser.add_argument("--episodes", type=int, default=256)
    parser.add_argument("--eval_seed", type=int, default=100_000)
    options = parser.parse_args()

    torch.set_num_threads(1)
    flags = (f"--env_id {options.env_id} --no-cuda --no-partial_reset --num_envs {NUM_ENVS} --num_steps {NUM_STEPS} "
             f"--total_timesteps {options.total_timesteps} --num_eval_episodes {options.num_eval_episodes} "
             f"--seed {options.seed} --exp_name {options.exp_name}")  # fmt: skip
    args = ppo.parse_args(flags.split())
    args.total_timesteps -= args.total_timesteps % args.batch_size  # SB3 would round up
    ppo.check(args)
    ppo.seed_all(args.seed)
    envs = VecNormalize(BatchedVecEnv(ppo.make_envs(args, NUM_ENVS, args.seed)))
    eval_envs = ppo.make_envs(args, min(64, args.num_eval_episodes), 0, evaluation=True)
    model = PPO("MlpPolicy", envs, n_steps=NUM_STEPS, seed=args.seed, device="cpu")

    run_dir = Path("runs") / args.exp_name
    run_dir.mkdir(parents=True, exist_ok=True)
    about = dict(args=vars(options), device="CPU", versions={p: importlib.metadata.version(p) for p in PACKAGES})
    (run_dir / "args.json").write_text(json.dumps(about, indent=2) + "\n")
    with open(run_dir / "metrics.jsonl", "w") as file:
        callback = Evaluation(args, eval_envs, options.eval_interval, file)
        model.learn(args.total_timesteps, callback=callback)
    policy = Policy(model)
    for name, state in (("last", policy.state()), ("best", callback.best)):
        policy.load(state)
        episodes = evaluate(policy, eval_envs, args, options.episodes, options.eval_seed)
        (run_dir / f"{name}.json").write_text(json.dumps(summarise(episodes), indent=2) + "\n")


if __name__ == "__main__":
    main()
