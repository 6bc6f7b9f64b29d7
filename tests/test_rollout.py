"""The rollout equals a replay of the same episodes in plain Python and float64.

A spy between ManiSkillVectorEnv and the task records the inputs and outputs of the simulation. From these alone the
replay computes what the storage must hold: it shares no code with ppo.py."""

import contextlib
import copy
import math
import os
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import batched_env
import gymnasium as gym
import numpy as np
import pytest
import torch
from batched_env import BatchedReach
from conftest import SMALL, box

import ppo

# isort: split
from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env


class Reach(BatchedReach):
    """BatchedReach with short episodes that end in every way, its own numbers in infos, and uneven action bounds."""

    max_episode_steps = 5

    def __init__(self, num_envs, seed=0):
        super().__init__(num_envs, "cpu")
        self.single_action_space = gym.spaces.Box(np.float32([-0.9, -0.5]), np.float32([0.4, 0.8]))
        self.generator = np.random.default_rng(seed)  # only actions draw from torch's generator, not resets

    def info(self):
        distance = (self.state[:, :2] - self.state[:, 2:]).norm(dim=1)
        info = dict(success=distance < 0.6, fail=self.state[:, 0].abs() > 1, elapsed_steps=self.elapsed_steps)
        return info | dict(distance=distance, position=self.state[:, :2].clone(), kind="no number"), distance

    def reset(self, *, seed=None, options=None):
        env_idx = (options or {}).get("env_idx", torch.arange(self.num_envs))
        self.state[env_idx] = torch.from_numpy(self.generator.uniform(-1, 1, (len(env_idx), 4))).float()
        self.elapsed_steps[env_idx] = 0
        return self.observe(), self.info()[0]


class Spy(gym.Wrapper):
    """Keeps copies of what passes between ManiSkillVectorEnv and the task."""

    def __init__(self, env):
        super().__init__(env)
        self.steps, self.resets = [], []

    def reset(self, **kwargs):
        obs, info = self.env.reset(**kwargs)
        self.resets.append(kwargs)
        if self.steps:
            self.steps[-1]["reset_obs"] = obs.clone()
        return obs, info

    def step(self, action):
        action = action.clone()
        obs, reward, terminated, truncated, info = self.env.step(action)
        step = dict(action=action, obs=obs, reward=reward, terminated=terminated, truncated=truncated, info=info)
        self.steps.append(copy.deepcopy(step))
        return obs, reward, terminated, truncated, info


def make_agent(obs_space, action_space, args):
    """An agent far from the initial one: it acts beyond the bounds, and its values differ from state to state."""
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(3)
        agent = ppo.Agent(obs_space, action_space, args)
        agent.actor_mean[-1].weight *= 40
        agent.critic[-1].weight *= 3
        agent.critic[-1].bias += 2
        agent.actor_logstd += 0.3 * torch.randn_like(agent.actor_logstd)
        if args.norm_obs:
            size = len(agent.obs_mean)
            scale = torch.linspace(0.5, 2, size)
            scale[1] = 0.02  # so small that normalised observations reach the limit of 10
            agent.update_normalization(torch.randn(500, size) * scale + torch.linspace(-1, 1, size))
    return agent


class Network:
    """Computes the agent's outputs again, from its parameters and in float64."""

    def __init__(self, agent):
        self.parameters = {k: v.detach().double().numpy().copy() for k, v in agent.state_dict().items()}
        self.norm_obs, self.logstd = agent.norm_obs, self.parameters["actor_logstd"]

    def normalize(self, obs):
        mean, var = self.parameters["obs_mean"], self.parameters["obs_var"]
        return np.clip((obs - mean) / np.sqrt(var + 1e-5), -10, 10) if self.norm_obs else obs

    def forward(self, x, layers):
        for i, layer in enumerate(layers):
            x = x @ self.parameters[f"{layer}.weight"].T + self.parameters[f"{layer}.bias"]
            x = np.tanh(x) if i < len(layers) - 1 else x
        return x

    def layers(self, name):
        return [*(f"{name}.0.{i}" for i in (0, 3, 6)), f"{name}.1"]

    def mean(self, obs):
        return self.forward(self.normalize(obs), self.layers("actor_mean"))

    def value(self, obs):
        return self.forward(self.normalize(obs), self.layers("critic"))[..., 0]


def make_storage(args, obs_size, action_size, fill=math.nan):
    shape = (args.num_steps, args.num_envs)
    storage = {k: torch.full(shape, fill) for k in ("logprobs", "rewards", "dones", "values", "next_values")}
    return storage | dict(obs=torch.full((*shape, obs_size), fill), actions=torch.full((*shape, action_size), fill))


def fresh_episode():
    return Counter(steps=0, reward=0.0, success=False, fail=False)


def replay(network, args, first_obs, steps, episodes, draws=None):
    """Returns what a rollout must store, sum up and return. `episodes` holds the unfinished episodes and is updated.
    `draws` (num_steps, num_envs) decide, where success_steps is more than 1, which successes end an episode."""
    num_envs = len(first_obs)
    names = ("obs", "rewards", "dones", "values", "next_values", "sent")
    wanted = {name: [[None] * num_envs for _ in steps] for name in names}
    sums, ends, last_obs = Counter(), Counter(), [None] * num_envs
    for env in range(num_envs):
        obs = first_obs[env].double().numpy()
        for t, step in enumerate(steps):
            next_obs = step["obs"][env].double().numpy()
            info = {k: v[env].item() for k, v in step["info"].items() if getattr(v, "shape", 0) == (num_envs,)}
            success_ends = args.success_steps == 1 or draws[t, env] < 1 / args.success_steps
            terminated = args.partial_reset and (info.get("success", False) and success_ends or info.get("fail", False))
            truncated = step["truncated"][env].item()
            reward = step["reward"][env].item()
            done = terminated or truncated

            if not done:
                counts = True
            elif args.bootstrap_at_done == "always":
                counts = True
            elif args.bootstrap_at_done == "never":
                counts = False
            else:
                counts = not terminated
            wanted["obs"][t][env] = obs
            wanted["rewards"][t][env] = args.reward_scale * reward
            wanted["dones"][t][env] = float(done)
            wanted["values"][t][env] = network.value(obs)
            wanted["next_values"][t][env] = network.value(next_obs) if counts else 0.0
            wanted["sent"][t][env] = step["action"][env].numpy()

            episode = episodes[env]
            episode["steps"] += 1
            episode["reward"] += reward
            for kind in ("success", "fail"):
                episode[kind] = episode[kind] or info.get(kind, False)
            obs = next_obs
            if done:
                ends["both" if terminated and truncated else "early" if terminated else "late"] += 1
                sums["num_episodes"] += 1
                sums["return"] += episode["reward"]
                sums["episode_len"] += episode["steps"]
                sums["reward"] += episode["reward"] / episode["steps"]
                for kind in {"success", "fail"} & info.keys():
                    sums[f"{kind}_once"] += episode[kind]
                    sums[f"{kind}_at_end"] += info[kind]
                for key, value in info.items():
                    if key not in ("success", "fail", "elapsed_steps"):
                        sums[f"final_{key}"] += value
                episodes[env] = fresh_episode()
                obs = step["reset_obs"][env].double().numpy()
        last_obs[env] = obs
    return {k: np.array(v) for k, v in wanted.items()}, sums, ends, np.array(last_obs)


def compare(agent, args, spy, first_obs, storage, sums, last_obs, episodes, draws=None):
    """Compare a rollout with its replay; returns how many episodes ended in each way, and the replay."""
    network = Network(agent)
    wanted, wanted_sums, ends, wanted_last_obs = replay(network, args, first_obs, spy.steps, episodes, draws)
    got = {k: v.double().numpy() for k, v in storage.items()}
    close = dict(rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(got["obs"], wanted["obs"])
    np.testing.assert_array_equal(got["dones"], wanted["dones"])
    np.testing.assert_allclose(got["rewards"], wanted["rewards"], rtol=1e-6)
    np.testing.assert_allclose(got["values"], wanted["values"], **close)
    np.testing.assert_allclose(got["next_values"], wanted["next_values"], **close)
    np.testing.assert_array_equal(last_obs, wanted_last_obs)
    # the simulation gets the clipped action; the update learns from the sample itself and its density
    space = spy.get_wrapper_attr("single_action_space")
    np.testing.assert_array_equal(np.clip(got["actions"], space.low, space.high), wanted["sent"])
    assert (got["actions"] != wanted["sent"]).any(), "some samples must lie outside the bounds"
    mean, logstd = network.mean(wanted["obs"]), network.logstd
    density = np.exp(-(((got["actions"] - mean) / np.exp(logstd)) ** 2) / 2) / np.exp(logstd) / math.sqrt(2 * math.pi)
    np.testing.assert_allclose(got["logprobs"], np.log(density).sum(-1), rtol=1e-3, atol=1e-3)
    sums = {k: v.item() for k, v in sums.items()}
    assert sums == pytest.approx(dict(wanted_sums), rel=1e-4, abs=1e-4)
    return ends, wanted


ARGS = replace(SMALL, num_envs=12, num_steps=20, gamma=0.9, gae_lambda=0.8, reward_scale=0.3, logstd_init=-0.7)
ARGS.success_steps = 1.0


@pytest.mark.parametrize("norm_obs", [False, True])
@pytest.mark.parametrize("partial_reset", [True, False])
@pytest.mark.parametrize("rule", ["always", "truncated", "never"])
@pytest.mark.parametrize("success_steps", [1.0, 1.5])
def test_equals_replay(success_steps, rule, partial_reset, norm_obs):
    """Two rollouts in a row equal their replays. The second continues the episodes of the first."""
    args = replace(ARGS, bootstrap_at_done=rule, partial_reset=partial_reset, norm_obs=norm_obs)
    args.success_steps = success_steps
    spy = Spy(Reach(args.num_envs))
    task = ppo.GoOnAfterSuccess(spy, success_steps)
    envs = ppo.ManiSkillVectorEnv(task, ignore_terminations=not partial_reset, record_metrics=True)
    agent = make_agent(box(4), spy.get_wrapper_attr("single_action_space"), args)
    network, (obs, _) = Network(agent), envs.reset()
    episodes, all_ends, ended_by = [fresh_episode() for _ in range(args.num_envs)], Counter(), Counter()
    for number in range(2):
        spy.steps.clear()
        storage, first_obs = make_storage(args, 4, 2), obs.clone()
        torch.manual_seed(number)
        obs, sums = ppo.rollout(agent, envs, storage, obs, args, agent.get_action_and_value, agent.get_value)
        assert not any(x.requires_grad for x in [*storage.values(), *sums.values()])
        # what is drawn in each step: the noise of the actions, and which successes end an episode
        torch.manual_seed(number)
        drawn = [(torch.randn(args.num_envs, 2), torch.rand(args.num_envs)) for _ in range(args.num_steps)]
        noise, draws = (torch.stack(x).double().numpy() for x in zip(*drawn))
        ends, wanted = compare(agent, args, spy, first_obs, storage, sums, obs, episodes, draws)
        all_ends += ends
        ended_by += Counter({k: v.item() for k, v in sums.items() if k in ("success_at_end", "fail_at_end")})
        # each action is the policy's mean plus its standard deviation times fresh noise
        actions = network.mean(wanted["obs"]) + np.exp(network.logstd) * noise
        np.testing.assert_allclose(storage["actions"], actions, rtol=1e-4, atol=1e-4)
        if norm_obs:
            normalized = abs(network.normalize(wanted["obs"]))
            assert normalized.max() == 10 and normalized.min() < 1
    assert set(all_ends) == ({"early", "late", "both"} if partial_reset else {"late"}), "episodes must end in every way"
    assert all(ended_by[k] >= 2 for k in ("success_at_end", "fail_at_end"))


def test_rollout_without_an_end():
    """Each next value is the value of the following step, and there is nothing to sum up."""
    args = replace(ARGS, num_steps=3, partial_reset=False)
    spy = Spy(Reach(args.num_envs))
    envs = ppo.ManiSkillVectorEnv(spy, ignore_terminations=True, record_metrics=True)
    agent = make_agent(box(4), spy.get_wrapper_attr("single_action_space"), args)
    first_obs, storage = envs.reset()[0].clone(), make_storage(args, 4, 2)
    obs, sums = ppo.rollout(agent, envs, storage, first_obs, args, agent.get_action_and_value, agent.get_value)
    episodes = [fresh_episode() for _ in range(args.num_envs)]
    wanted = replay(Network(agent), args, first_obs, spy.steps, episodes)[0]
    np.testing.assert_allclose(storage["next_values"], wanted["next_values"], rtol=1e-4, atol=1e-4)
    assert {k: v.item() for k, v in sums.items()} == {"num_episodes": 0} and not storage["dones"].any()


PUSH = ppo.Args(
    env_id="PushCube-v1", sim_backend="physx_cpu", num_envs=3, num_eval_envs=2, num_actors=1, num_steps=7, seed=11,
    num_eval_episodes=4, cuda=False, capture_video=False, env_kwargs='{"max_episode_steps": 3}', reward_scale=2.5,
)  # fmt: skip


@register_env("Succeeds-v0", max_episode_steps=200)
class Succeeds(PushCubeEnv):
    """Success at each step, and failure in the last environment."""

    def evaluate(self):
        fail = torch.arange(self.num_envs) == self.num_envs - 1
        return dict(success=torch.ones(self.num_envs, dtype=torch.bool), fail=fail)


@pytest.mark.parametrize("success_steps", [1.0, 4.0])
def test_training_goes_on_after_success(success_steps):
    """On average for success_steps, but not after failure. Episodes of evaluation follow their own flag."""
    args = replace(PUSH, env_id="Succeeds-v0", success_steps=success_steps, env_kwargs="{}")
    envs = ppo.make_envs(args, 33, 0)
    envs.reset(seed=[*range(33)])
    torch.manual_seed(0)
    action, lengths = torch.zeros(33, 8), [[] for _ in range(33)]
    for _ in range(40):
        infos = envs.step(action)[4]
        for i in infos["_final_info"].nonzero() if "_final_info" in infos else ():
            lengths[i].append(infos["final_info"]["episode"]["episode_len"][i].item())
    assert lengths.pop() == [1] * 40
    lengths = sum(lengths, [])
    assert np.mean(lengths) == pytest.approx(success_steps, rel=0.2) and len(set(lengths)) > 3 * (success_steps - 1)
    envs.close()
    for ends_early in (True, False):
        envs = ppo.make_envs(replace(args, eval_partial_reset=ends_early), 2, 0, evaluation=True)
        envs.reset(seed=[0, 1])
        assert all(envs.step(action[:2])[2].tolist() == [ends_early] * 2 for _ in range(3))
        envs.close()


@pytest.mark.parametrize("rule, partial_reset", [("always", True), ("truncated", False), ("never", True)])
def test_equals_replay_of_a_simulated_batch(rule, partial_reset):
    args = replace(PUSH, bootstrap_at_done=rule, partial_reset=partial_reset, norm_obs=True, success_steps=1.0)
    spy = Spy(ppo.make_env(args, args.num_envs))
    envs = ppo.ManiSkillVectorEnv(spy, ignore_terminations=not partial_reset, record_metrics=True)
    agent = make_agent(envs.single_observation_space, envs.single_action_space, args)
    obs, _ = envs.reset(seed=[5, 6, 7])
    torch.manual_seed(0)
    episodes = [fresh_episode() for _ in range(args.num_envs)]
    for _ in range(2):
        spy.steps.clear()
        storage, first_obs = make_storage(args, obs.shape[1], 8), obs.clone()
        obs, sums = ppo.rollout(agent, envs, storage, obs, args, agent.get_action_and_value, agent.get_value)
        ends, _ = compare(agent, args, spy, first_obs, storage, sums, obs, episodes)
        assert ends["late"] >= args.num_envs
    ended = [step for step in spy.steps if "reset_obs" in step]
    assert all((step["obs"] != step["reset_obs"]).any(1).all() for step in ended)
    envs.close()


# --- the environments of several actors ---

TWO = replace(PUSH, num_envs=4, num_actors=2, num_eval_envs=4, env_kwargs="{}", staggered_resets=False)


def noise_alone(obs):
    """Stands in for the policy: the stored actions are the noise itself."""
    return torch.randn(len(obs), 8), torch.zeros(len(obs)), None, torch.zeros(len(obs))


@pytest.fixture(scope="module")
def actors():
    """Both actors of a run. Each records the seeds that it gives its environments."""
    actors = [ppo.Actor(TWO, index) for index in (0, 1)]
    for actor in actors:
        actor.seeds, reset = [], actor.envs.reset

        def spy_reset(seed=None, options=None, actor=actor, reset=reset):
            actor.seeds.append(seed)
            return reset(seed=seed, options=options)

        actor.envs.reset = spy_reset
    yield actors
    for actor in actors:
        actor.close()


def noise_of(actor, iteration, seed=TWO.seed, restart=False):
    obs_size = actor.envs.single_observation_space.shape[0]
    storage, actor.args = make_storage(TWO, obs_size, 8), replace(TWO, seed=seed)
    actor.receive(make_agent(box(obs_size), box(8), TWO), storage)
    actor.act = noise_alone
    actor.rollout(iteration, is_first=restart)
    actor.args = TWO
    return storage["actions"][:, actor.env_idx.start : actor.env_idx.stop]


def test_an_actor_writes_its_own_columns(actors):
    agent = make_agent(actors[0].envs.single_observation_space, actors[0].envs.single_action_space, TWO)
    storage = make_storage(TWO, len(agent.obs_mean), 8)
    empty = {k: v.clone() for k, v in storage.items()}
    for actor, own, others in zip(actors, (slice(0, 2), slice(2, 4)), (slice(2, 4), slice(0, 2))):
        for k, v in storage.items():
            v.copy_(empty[k])
        actor.receive(agent, storage)
        actor.rollout(0, is_first=True)
        for name, x in storage.items():
            assert x[:, own].isfinite().all() and x[:, others].isnan().all(), name


def test_noise_follows_from_seed_iteration_and_actor(actors):
    for actor in actors:
        noise_of(actor, 0, restart=True)
    usual = [noise_of(actor, 4) for actor in actors]
    again = [noise_of(actor, 4) for actor in actors]
    assert all(map(torch.equal, usual, again))
    others = [noise_of(actor, 4, seed=12) for actor in actors] + [noise_of(actor, 5) for actor in actors]
    numbers = torch.cat([x.flatten() for x in usual + others])
    assert len(numbers.unique()) == len(numbers), "no number may be drawn twice"


def test_restarted_episodes_have_their_own_seeds(actors):
    """Seeds of training differ from those of evaluation, and between environments, iterations and seeds of runs."""
    all_seeds = []
    for actor in actors:
        actor.seeds.clear()
        for iteration, seed in ((0, 11), (3, 11), (0, 12)):
            noise_of(actor, iteration, seed, restart=True)
        assert len(actor.seeds) == 3, "no episode has ended, so nothing else may be reset"
        all_seeds += sum(actor.seeds, [])
        noise_of(actor, 0, restart=True)
        assert actor.seeds.pop() == actor.seeds[0]
        noise_of(actor, 1)
        assert len(actor.seeds) == 3, "episodes must go on in the next iteration"
    assert len(set(all_seeds)) == len(all_seeds) == 12
    assert all(2**31 <= seed < 2**32 for seed in all_seeds)


def test_episodes_go_on_from_one_iteration_to_the_next(actors):
    actor = actors[1]
    noise_of(actor, 0, restart=True)
    first = actor.storage["obs"][0].clone()
    for number in range(1, 4):
        after = actor.obs.clone()
        noise_of(actor, number)
        assert torch.equal(actor.storage["obs"][0], after) and not torch.equal(after, first)
        assert actor.envs.base_env.elapsed_steps.tolist() == [TWO.num_steps * (number + 1)] * 2
    noise_of(actor, 0, restart=True)
    torch.testing.assert_close(actor.storage["obs"][0], first, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("partial_reset", [True, False])
def test_staggered_resets(partial_reset):
    """The first episodes end anywhere within the time limit, later ones at it. --no-partial_reset ends all at once."""
    limit = 8
    args = replace(PUSH, num_envs=33, num_steps=3 * limit, env_kwargs=f'{{"max_episode_steps": {limit}}}')
    ends = {}
    for staggered in (True, False):
        actor = ppo.Actor(replace(args, partial_reset=partial_reset, staggered_resets=staggered), 0)
        storage = make_storage(args, actor.envs.single_observation_space.shape[0], 8)
        actor.receive(make_agent(actor.envs.single_observation_space, actor.envs.single_action_space, args), storage)
        actor.rollout(0, is_first=True)
        actor.close()
        ends[staggered] = [env.nonzero().flatten().tolist() for env in storage["dones"].T]
    assert ends[False] == [[limit - 1, 2 * limit - 1, 3 * limit - 1]] * 33
    if not partial_reset:
        assert ends[True] == ends[False]
        return
    assert {first for first, *_ in ends[True]} == {*range(limit)}
    for steps in ends[True]:
        assert steps == [*range(steps[0], 3 * limit, limit)]


@register_env("OtherCubes-v0", max_episode_steps=6)
class OtherCubes(PushCubeEnv):
    """Each scene has a cube of another size. Many episodes end early."""

    def __init__(self, *args, reconfiguration_freq=0, **kwargs):
        super().__init__(*args, reconfiguration_freq=reconfiguration_freq, **kwargs)

    def _load_scene(self, options):
        self.cube_half_size = 0.01 + 0.02 * self._batched_episode_rng[0].uniform()
        super()._load_scene(options)

    def evaluate(self):
        return dict(success=torch.rand(self.num_envs) < 0.1)


@pytest.mark.parametrize("num_envs, num_actors", [(1, 1), (4, 1), (5, 2)])
def test_every_training_episode_ends_by_itself(num_envs, num_actors, monkeypatch):
    """New scenes cut no episode that a rollout has begun, and each of these is counted once."""
    args = replace(TWO, env_id="OtherCubes-v0", num_envs=num_envs, num_actors=num_actors, num_eval_envs=num_actors)
    args.num_steps, args.success_steps = 4, 1.0
    rollout, in_rollout = ppo.rollout, []

    def spy_rollout(*arguments):
        in_rollout.append(1)
        result = rollout(*arguments)
        in_rollout.clear()
        return result

    monkeypatch.setattr(ppo, "rollout", spy_rollout)
    for index in range(num_actors):
        actor = ppo.Actor(args, index)
        step, reset, size = actor.envs.step, actor.envs.reset, len(actor.env_idx)
        running, ended, cube_sizes = torch.zeros(size, dtype=torch.bool), [], []

        def spy_step(action, running=running, ended=ended, step=step):
            running |= bool(in_rollout)
            result = step(action)
            done = result[2] | result[3]
            if done.any():
                ended.extend(result[4]["final_info"]["episode"]["episode_len"][done & running].tolist())
            running &= ~done
            return result

        def spy_reset(seed=None, options=None, running=running, cubes=cube_sizes, reset=reset, envs=actor.envs):
            assert "env_idx" in (options or {}) or not running.any(), "an episode was cut"
            result = reset(seed=seed, options=options)
            cubes.append(envs.base_env.cube_half_size)
            return result

        actor.envs.step, actor.envs.reset = spy_step, spy_reset
        spaces, cpu = (actor.envs.single_observation_space, actor.envs.single_action_space), torch.device("cpu")
        agent = make_agent(*spaces, args)
        actor.receive(agent, ppo.make_storage(agent, *spaces, args, cpu))
        assert actor.rebuild_freq == 15, "ten episodes of six steps, in iterations of four"
        counts = [actor.rollout(i, i == 0)["num_episodes"].item() for i in range(45)]
        assert sum(counts) == len(ended) and not running.any()
        assert len(set(cube_sizes)) == 3, "at the beginning, and after 15 and 30 iterations"
        assert max(ended) == 6 and min(ended) < 6
        actor.close()


def test_a_copy_of_the_agent_acts_with_what_was_learned(tmp_path, monkeypatch):
    """A learner on a GPU has such a copy for its CPU simulation."""
    monkeypatch.setattr(ppo, "make_envs", batched_env.make_envs)
    with contextlib.ExitStack() as closing:
        actors = ppo.Actors(SMALL, tmp_path, closing)
        agent = ppo.make_agent(*actors.spaces, SMALL, {})
        actors.distribute(agent, torch.device("cpu"))
        for use in (lambda: actors.rollout(0, is_first=True), lambda: actors.evaluate(0)):
            actors.agent = copy.deepcopy(agent)
            with torch.no_grad():
                agent.critic[-1].bias += 1
            use()
            assert torch.equal(actors.agent.critic[-1].bias, agent.critic[-1].bias)


def test_actors_see_no_gpu(tmp_path, monkeypatch):
    """ManiSkill saves the random state of every GPU when it resets. An actor that simulates on the CPU would take
    memory of the GPU for that."""
    monkeypatch.setattr(ppo, "Actor", lambda *arguments: None)
    monkeypatch.setattr(ppo.threading, "Thread", lambda **kwargs: SimpleNamespace(start=lambda: None))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    num_threads = torch.get_num_threads()
    ppo.run_in_actor("build", SMALL, 1, tmp_path)
    torch.set_num_threads(num_threads)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == ""


class VariedByItsBase(ppo.REGISTERED_ENVS["PegInsertionSide-v1"].cls):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)


class TaskOfBaseEnv(ppo.sapien_env.BaseEnv):
    """It has no __init__ of its own."""


@pytest.mark.parametrize("cls, varies", [(VariedByItsBase, True), (TaskOfBaseEnv, False)])
def test_tasks_that_vary_their_objects(monkeypatch, cls, varies):
    monkeypatch.setattr(ppo, "find_task", lambda env_id: SimpleNamespace(cls=cls))
    assert ppo.varies_objects("x") == varies


PEG = replace(TWO, env_id="PegInsertionSide-v1")


def sizes(envs):
    return envs.base_env.peg_half_sizes[:, :2].flatten().tolist()


def sizes_of(args, index):
    actor = ppo.Actor(args, index)
    training, evaluation = sizes(actor.envs), sizes(actor.eval_envs)
    actor.close()
    return training, evaluation


def test_objects_follow_from_the_seed_and_the_actor():
    """A task that varies its objects builds others for each actor and each seed. The objects of evaluation follow from
    eval_seed instead."""
    (training, evaluation), (of_actor_1, evaluation_1) = sizes_of(PEG, 0), sizes_of(PEG, 1)
    of_seed_12, same_evaluation = sizes_of(replace(PEG, seed=12), 0)
    same, other_evaluation = sizes_of(replace(PEG, eval_seed=50), 0)
    assert same == training and same_evaluation == evaluation
    numbers = training + of_actor_1 + of_seed_12 + evaluation + evaluation_1 + other_evaluation
    assert len(set(numbers)) == len(numbers)


def test_evaluation_builds_the_objects_of_its_seeds():
    """Episode k has the objects of ManiSkill's single environment with seed eval_seed + k."""
    args = replace(PEG, eval_seed=7, num_actors=1, env_kwargs='{"max_episode_steps": 1}')
    envs = ppo.make_envs(args, 2, 1234, evaluation=True)
    agent = make_agent(envs.single_observation_space, envs.single_action_space, args)
    found, step = [], envs.step
    envs.step = lambda action: found.extend(envs.base_env.peg_half_sizes.tolist()) or step(action)
    ppo.evaluate(agent, envs, args, 4, 7, separately=True)
    single = gym.make(args.env_id, num_envs=1, sim_backend="physx_cpu", render_backend="none", obs_mode="state")
    wanted = []
    for seed in range(7, 11):
        single.reset(seed=seed, options=dict(reconfigure=True))
        wanted += single.unwrapped.peg_half_sizes.tolist()
    assert found == wanted
    envs.close()
    single.close()
