"""Evaluation episode k is a function of eval_seed + k alone, and its metrics are those of a plain loop."""

import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from batched_env import BatchedReach
from conftest import SMALL, box
from test_rollout import Network, Spy, make_agent

import ppo

SEED, EPISODES, STEPS = 40, 7, 25
TASKS = {
    "PushCube-v1": "pd_joint_delta_pos",
    "MS-CartpoleBalance-v1": "pd_joint_delta_pos",
    "PickCube-v1": "pd_ee_delta_pose",
    "StackCube-v1": "pd_joint_delta_pos",
}
ARGS = ppo.Args(
    sim_backend="physx_cpu", num_envs=2, num_actors=1, num_steps=5, cuda=False, capture_video=False, evaluate=True,
    norm_obs=True, env_kwargs=f'{{"max_episode_steps": {STEPS}}}',
)  # fmt: skip


def evaluate_with(args, agent, monkeypatch, again=False):
    """Evaluate with all actors of a run, here one after the other; returns the first observations and the metrics. With
    `again`, they are those of a second evaluation in the same scenes."""
    start_episodes, first_obs, parts = ppo.start_episodes, [], []
    for index in range(args.num_actors):
        of_actor = []

        def spy(*arguments, of_actor=of_actor):
            of_actor.append(start_episodes(*arguments))
            return of_actor[-1]

        actor = ppo.Actor(args, index)
        actor.receive(agent, {})
        if again:
            actor.evaluate(EPISODES, SEED)
        monkeypatch.setattr(ppo, "start_episodes", spy)
        parts.append(actor.evaluate(EPISODES, SEED))
        monkeypatch.undo()
        actor.close()
        first_obs.append(torch.cat(of_actor)[: len(parts[-1]["return"])])
    return torch.cat(first_obs), ppo.concatenate(parts)


def plain_loop(args, agent):
    """Play one episode after the other in ManiSkill's single environment. Only the network is ours."""
    kwargs = dict(num_envs=1, sim_backend="physx_cpu", render_backend="none", max_episode_steps=STEPS)
    kwargs |= dict(obs_mode="state", reward_mode="normalized_dense", control_mode=args.control_mode)
    env = gym.make(args.env_id, **kwargs)
    first_obs, episodes = [], []
    for seed in range(SEED, SEED + EPISODES):
        obs, info = env.reset(seed=seed)
        first_obs.append(obs[0])
        rewards, success, fail, ended = [], [], [], False
        while not ended:
            with torch.no_grad():
                action = agent.get_action(obs).numpy()
            obs, reward, _, ended, info = env.step(np.clip(action, env.action_space.low, env.action_space.high))
            rewards.append(reward.item())
            success += [float(info["success"])] if "success" in info else []
            fail += [float(info["fail"])] if "fail" in info else []
        episode = {"return": sum(rewards), "episode_len": float(len(rewards))}
        for kind, flags in (("success", success), ("fail", fail)):
            episode |= {f"{kind}_once": max(flags), f"{kind}_at_end": flags[-1]} if flags else {}
        episodes.append(episode)
    env.close()
    return torch.stack(first_obs), {k: torch.tensor([e[k] for e in episodes]) for k in episodes[0]}


def by_row(function):
    """Compute each row alone, so that rounding does not depend on the number of rows. With contacts, a difference in
    the last bit leads to another episode."""
    return lambda obs: torch.cat([function(row[None]) for row in obs])


@pytest.mark.parametrize(
    "env_id",
    [k if k in ("PushCube-v1", "MS-CartpoleBalance-v1") else pytest.param(k, marks=pytest.mark.slow) for k in TASKS],
)
def test_independent_of_environments_and_actors(env_id, monkeypatch):
    """Episodes do not depend on earlier episodes in the same scenes either, or on whether the last round is full."""
    args = replace(ARGS, env_id=env_id, control_mode=TASKS[env_id])
    env = ppo.make_env(args, 1)
    action_space = env.get_wrapper_attr("single_action_space")
    agent = make_agent(box(env.observation_space.shape[-1]), action_space, replace(args, norm_obs=False))
    env.close()
    agent.actor_mean[-1].weight.data *= 3
    agent.get_action = by_row(agent.get_action)
    first_obs, metrics = plain_loop(args, agent)
    assert len(metrics["return"].unique()) == EPISODES
    for num_envs, num_actors, again in ((1, 1, False), (3, 1, False), (5, 1, True), (4, 2, False), (2, 2, False)):
        of_run = replace(args, num_eval_envs=num_envs, num_actors=num_actors)
        ours = evaluate_with(of_run, agent, monkeypatch, again)
        torch.testing.assert_close(ours[0], first_obs, rtol=0, atol=1e-6)
        assert {k for k in ours[1] if not k.startswith("final_")} == metrics.keys()
        for key, values in metrics.items():
            torch.testing.assert_close(ours[1][key], values, rtol=1e-5, atol=1e-5)


class Reach(BatchedReach):
    """BatchedReach where success and failure may be temporary, with uneven action bounds."""

    def __init__(self, num_envs):
        super().__init__(num_envs, "cpu")
        self.single_action_space = gym.spaces.Box(np.float32([-0.9, -0.5]), np.float32([0.4, 0.8]))

    def info(self):
        distance = (self.state[:, :2] - self.state[:, 2:]).norm(dim=1)
        info = dict(success=distance < 0.5, fail=self.state[:, 1].abs() < 0.1, elapsed_steps=self.elapsed_steps)
        return info, distance


@pytest.mark.parametrize("num_steps", [6, 20])
@pytest.mark.parametrize("ends_early", [False, True])
def test_metrics_equal_those_of_a_plain_loop(ends_early, num_steps, monkeypatch):
    """An episode counts up to its end: the time limit or, with eval_partial_reset, success or failure."""
    args = replace(SMALL, eval_partial_reset=ends_early, norm_obs=True)
    monkeypatch.setattr(Reach, "max_episode_steps", num_steps)
    agent = make_agent(box(4), Reach(1).single_action_space, args)
    agent.actor_mean[-1].weight.data *= 4
    network, low, high = Network(agent), np.float32([-0.9, -0.5]), np.float32([0.4, 0.8])
    wanted = {k: [] for k in ("return", "episode_len", "success_once", "success_at_end", "fail_once", "fail_at_end")}
    clipped = 0
    for seed in range(SEED, SEED + 40):
        alone = Reach(1)
        obs, rewards, success, fail = alone.reset(seed=[seed])[0], [], [], []
        for _ in range(num_steps):
            mean = network.mean(obs[0].double().numpy())
            clipped += (mean != mean.clip(low, high)).any()
            obs, reward, terminated, truncated, info = alone.step(torch.from_numpy(mean.clip(low, high)).float()[None])
            rewards.append(reward.item())
            success.append(info["success"].item())
            fail.append(info["fail"].item())
            if truncated or ends_early and terminated:
                break
        for key, value in zip(wanted, (sum(rewards), len(rewards), any(success), success[-1], any(fail), fail[-1])):
            wanted[key].append(float(value))
    assert clipped and len(set(wanted["episode_len"])) > (2 if ends_early else 0)
    if num_steps == 20 and not ends_early:
        assert wanted["success_once"] != wanted["success_at_end"] and wanted["fail_once"] != wanted["fail_at_end"]
    for num_envs in (1, 7, 64):
        spy = Spy(Reach(num_envs))
        envs = ppo.ManiSkillVectorEnv(spy, auto_reset=False, ignore_terminations=not ends_early, record_metrics=True)
        metrics = ppo.evaluate(agent, envs, args, 40, SEED)
        rounds = [wanted["episode_len"][i : i + num_envs] for i in range(0, 40, num_envs)]
        if 40 % num_envs == 0:  # else, further episodes fill the last round
            assert len(spy.steps) == sum(map(max, rounds)), "no steps after the last episode has ended"
        assert len(spy.steps) <= len(rounds) * num_steps
        assert metrics.keys() == wanted.keys()
        for key, values in wanted.items():
            assert metrics[key].tolist() == pytest.approx(values, rel=1e-3), key


def test_exploring_takes_random_actions_and_all_else_does_not():
    agent = make_agent(box(4), Reach(1).single_action_space, SMALL)
    envs = ppo.ManiSkillVectorEnv(Reach(3), auto_reset=False, ignore_terminations=True, record_metrics=True)
    plain, again, exploring = [
        ppo.evaluate(agent, envs, SMALL, 3, 5, exploring=e)["return"] for e in (False, False, True)
    ]
    assert torch.equal(plain, again) and not torch.isclose(plain, exploring).any()


@pytest.mark.parametrize("num_episodes", [1, 2, 5])
def test_each_actor_has_its_part_of_the_episodes(num_episodes, monkeypatch):
    """The parts make up all episodes, even with fewer episodes than actors or environments."""
    seeds = []

    def spy(envs, episode_seeds, separately):
        seeds.extend(episode_seeds[: wanted - len(seeds)])
        return envs.reset(seed=episode_seeds)[0]

    monkeypatch.setattr(ppo, "start_episodes", spy)
    monkeypatch.setattr(
        ppo,
        "make_envs",
        lambda args, num_envs, *_, **__: ppo.ManiSkillVectorEnv(
            Spy(Reach(num_envs)), auto_reset=False, record_metrics=True
        ),
    )
    args = replace(SMALL, num_actors=3, num_envs=3, num_eval_envs=6, sim_backend="physx_cpu", evaluate=True)
    parts, wanted = [], 0
    for index in range(3):
        actor = ppo.Actor(args, index)
        actor.receive(make_agent(box(4), Reach(1).single_action_space, SMALL), {})
        wanted += len(ppo.even_share(num_episodes, index, 3))
        parts.append(actor.evaluate(num_episodes, 100))
    assert seeds == [*range(100, 100 + num_episodes)]
    assert len(ppo.concatenate(parts)["return"]) == num_episodes
    assert all(math.isfinite(x) for x in ppo.concatenate(parts)["return"])
