"""`train` on torch-native batched environments inside the real ManiSkillVectorEnv, which GPU simulation uses as well.

Each step follows its definition, checked on records of short runs; and the policy learns."""

import contextlib
import copy
import json
import math
from dataclasses import replace
from functools import partial
from unittest.mock import Mock

import batched_env
import numpy as np
import pytest
import torch
from batched_env import BatchedReach
from conftest import ACTIONS, SMALL, box, on_cpu_and_cuda, on_gpus, read_metrics, same_weights
from test_gae import brute_force

import ppo

NUM_ENVS, NUM_STEPS, ITERATIONS = 8, 6, 4
# env_id can be that of any task: the tests replace `make_envs`
ARGS = replace(
    SMALL, env_id="PushCube-v1", num_actors=1, num_envs=NUM_ENVS, num_steps=NUM_STEPS, num_eval_envs=2,
    num_eval_episodes=3, total_timesteps=NUM_ENVS * NUM_STEPS * ITERATIONS, num_minibatches=4, update_epochs=3,
    eval_freq=1, exp_name="x", target_kl=None, gamma=0.9, gae_lambda=0.7, learning_rate=1e-3,
)  # fmt: skip


class Reach(BatchedReach):
    """BatchedReach with short episodes."""

    max_episode_steps = 5

    def __init__(self, num_envs):
        super().__init__(num_envs, "cpu")


def copied(x):
    return {k: v.detach().clone() for k, v in x.items()}


class Run:
    """Runs `train` and records what happens in each iteration."""

    def __init__(self, monkeypatch, args, evaluations=None):
        self.args, self.iterations, self.evaluations, self.second_looks = args, [], [], []
        rollout, update, evaluate = ppo.rollout, ppo.update_minibatch, ppo.evaluate

        def make_envs(args, num_envs, seed, evaluation=False, record=None):
            return ppo.ManiSkillVectorEnv(
                Reach(num_envs), auto_reset=not evaluation, ignore_terminations=evaluation, record_metrics=True
            )

        def spy_rollout(agent, envs, storage, obs, args, *functions):
            before, obs = copied(agent.state_dict()), obs.clone()
            result = rollout(agent, envs, storage, obs, args, *functions)
            sums = {k: v.item() for k, v in result[1].items()}
            records = dict(first_obs=obs, next_obs=result[0].clone(), storage=copied(storage), before=before)
            self.iterations.append(dict(**records, sums=sums, updates=[]))
            return result

        def spy_update(agent, optimizer, args, **minibatch):
            rates = [float(group["lr"]) for group in optimizer.param_groups]
            names = ("obs", "actions", "logprobs", "advantages", "returns", "values")
            rows = [minibatch[name].detach().clone() for name in names]
            statistics = copied({k: v for k, v in agent.state_dict().items() if k.startswith("obs_")})
            metrics = update(agent, optimizer, args, **minibatch)
            self.iterations[-1]["updates"].append(
                dict(rates=rates, rows=rows, statistics=statistics, metrics=metrics.clone())
            )
            self.iterations[-1]["after_updates"] = copied(agent.state_dict())
            return metrics

        def spy_evaluate(agent, envs, *arguments, **flags):
            result = evaluate(agent, envs, *arguments, **flags)
            seed = arguments[2]
            if seed == args.eval_seed:
                self.evaluations.append(copied(agent.state_dict()))
                self.second_looks.append(False)
            else:  # at a policy that may be the best
                assert seed == args.eval_seed + self.num_first
                self.second_looks[-1] = True
            if evaluations:
                result = evaluations[len(self.evaluations) - 1]
                half = len(result["return"]) // 2
                half = slice(half, None) if self.second_looks[-1] else slice(half)
                result = {k: torch.tensor(v[half]).float() for k, v in result.items()}
            self.num_first = len(result["return"])
            return result

        monkeypatch.setattr(ppo, "make_envs", make_envs)
        monkeypatch.setattr(ppo, "rollout", spy_rollout)
        monkeypatch.setattr(ppo, "update_minibatch", spy_update)
        monkeypatch.setattr(ppo, "evaluate", spy_evaluate)
        monkeypatch.setattr(ppo, "plot_learning_curve", lambda run_dir: None)
        monkeypatch.setattr("torch.utils.tensorboard.SummaryWriter", Mock())
        with contextlib.ExitStack() as closing:
            ppo.train(copy.copy(args), closing)
        self.folder = ppo.find_run_dir(args)
        rows = read_metrics(self.folder)
        self.train_rows = [row for row in rows if row["kind"] == "train"]
        self.eval_rows = [row for row in rows if row["kind"] == "eval"]

    def checkpoint(self, name):
        return ppo.load_checkpoint(self.folder / name)


@pytest.fixture
def run(in_tmp, monkeypatch):
    return lambda evaluations=None, **flags: Run(monkeypatch, replace(ARGS, **flags), evaluations)


def flat_batch(args, storage):
    """Returns the arrays to learn from, with one row for each (step, environment), in this order. Advantages follow
    their definition."""
    columns = {k: v.double() for k, v in storage.items()}
    rollout = [columns[k] for k in ("rewards", "values", "next_values", "dones")]
    advantages = brute_force(*rollout, args.gamma, args.gae_lambda, args.finite_horizon_gae)
    columns |= dict(advantages=advantages, returns=advantages + columns["values"])
    names = ("obs", "actions", "logprobs", "advantages", "returns", "values")
    return [columns[k].reshape(NUM_ENVS * NUM_STEPS, -1).numpy() for k in names]


@pytest.mark.parametrize("finite_horizon", [False, True])
def test_each_epoch_learns_from_each_sample_once(run, finite_horizon):
    """The minibatches of an epoch are a permutation of the rollout's rows. Each epoch has another permutation."""
    record = run(finite_horizon_gae=finite_horizon, norm_obs=True)
    orders = []
    assert len(record.iterations) == ITERATIONS
    for iteration in record.iterations:
        truth = flat_batch(record.args, iteration["storage"])
        assert len(iteration["updates"]) == 3 * 4
        place = {x: i for i, x in enumerate(truth[2][:, 0].tolist())}  # log-probabilities identify the rows
        assert len(place) == NUM_ENVS * NUM_STEPS
        for epoch in range(3):
            updates = iteration["updates"][4 * epoch : 4 * epoch + 4]
            got = [torch.cat(x).double().numpy() for x in zip(*(update["rows"] for update in updates))]
            order = [place[x] for x in got[2].tolist()]
            assert sorted(order) == [*range(NUM_ENVS * NUM_STEPS)]
            orders.append(tuple(order))
            for ours, theirs in zip(got, truth, strict=True):
                np.testing.assert_allclose(ours.reshape(len(order), -1), theirs[order], rtol=1e-4, atol=1e-5)
    assert len(set(orders)) == len(orders) and tuple(range(NUM_ENVS * NUM_STEPS)) not in orders


def test_a_remainder_sits_out_at_random(run):
    record = run(num_minibatches=5, update_epochs=4, total_timesteps=NUM_ENVS * NUM_STEPS)
    (iteration,) = record.iterations
    left_out = []
    for epoch in range(4):
        rows = [update["rows"][2] for update in iteration["updates"][5 * epoch : 5 * epoch + 5]]
        assert [len(x) for x in rows] == [9] * 5 and len(torch.cat(rows).unique()) == 45
        left_out.append(set(iteration["storage"]["logprobs"].flatten().tolist()) - set(torch.cat(rows).tolist()))
    assert len({frozenset(x) for x in left_out}) > 1


def test_gradients_of_earlier_minibatches_are_gone():
    torch.manual_seed(0)
    agent = ppo.Agent(box(4), box(2), ARGS)
    used = copy.deepcopy(agent)
    obs, actions = torch.randn(8, 4), torch.randn(8, 2)
    with torch.no_grad():
        logprobs = agent.get_action_and_value(obs, actions)[1]
    batch = [obs, actions, logprobs, torch.randn(8), torch.randn(8), torch.randn(8)]
    for parameter in used.parameters():
        parameter.grad = torch.ones_like(parameter)
    for x in (agent, used):
        ppo.update_minibatch(x, torch.optim.SGD(x.parameters(), lr=0.1), ARGS, *batch)
    assert all(torch.equal(*pair) for pair in zip(agent.parameters(), used.parameters()))


def test_learning_rates(run):
    """With anneal_lr, learning rates fall linearly: to 1/n of the first rate in the last of n iterations. Otherwise
    they are constant."""
    for anneal_lr in (True, False):
        record = run(
            anneal_lr=anneal_lr, critic_learning_rate=5e-3, logstd_lr_factor=3.0, exp_name=f"anneal_{anneal_lr}"
        )
        for number, iteration in enumerate(record.iterations):
            factor = 1 - number / ITERATIONS if anneal_lr else 1
            for update in iteration["updates"]:
                assert update["rates"] == pytest.approx([1e-3 * factor, 3e-3 * factor, 5e-3 * factor])
            assert record.train_rows[number]["learning_rate"] == pytest.approx(1e-3 * factor)


@pytest.mark.parametrize("desired_kl, reached", [(0.003, {2 / 3, 1, 1.5}), (1e-9, {2 / 3, 1.5}), (1e6, {1.5})])
@pytest.mark.parametrize("anneal_lr", [False, True])
def test_learning_rate_follows_the_divergence(run, desired_kl, reached, anneal_lr):
    """The KL divergence of each minibatch changes the policy's rate for the next one, within bounds. The critic's rate
    does not follow it: anneal_lr lowers that rate alone."""
    record = run(
        desired_kl=desired_kl, logstd_lr_factor=3.0, anneal_lr=anneal_lr, exp_name=f"desired_{desired_kl}_{anneal_lr}"
    )
    rate, factors = 1e-3, set()
    for number, iteration in enumerate(record.iterations):
        remaining = 1 - number / ITERATIONS if anneal_lr else 1
        for update in iteration["updates"]:
            assert update["rates"] == pytest.approx([rate, 3 * rate, 1e-3 * remaining], rel=1e-4)
            kl = update["metrics"][ppo.UPDATE_METRICS.index("approx_kl")]
            factor = 2 / 3 if kl > 2 * desired_kl else 1.5 if kl < desired_kl / 2 else 1
            rate = min(max(rate * factor, 1e-5), 1e-2)
            factors.add(factor)
    assert factors == reached


def test_limit_of_the_standard_deviation(run):
    """It falls in the second half of the run, after an update: the next one knows the policy that acted. Here the
    standard deviation does not learn (logstd_lr_factor 0), so that the limit alone changes it."""
    for logstd_final, expected in ((-2.0, [-0.5, -0.5, -0.5, -1.25, -2.0]), (0.0, [-0.5] * 5), (None, [-0.5] * 5)):
        record = run(logstd_final=logstd_final, logstd_lr_factor=0.0, exp_name=f"final_{logstd_final}")
        policies = [*(iteration["before"] for iteration in record.iterations), record.evaluations[-1]]
        for policy, logstd in zip(policies, expected, strict=True):
            assert policy["actor_logstd"].tolist() == [pytest.approx([logstd] * policy["actor_logstd"].numel())]
        for iteration in record.iterations:
            assert iteration["updates"][0]["metrics"][ppo.UPDATE_METRICS.index("approx_kl")] < 1e-6


def test_training_from_a_checkpoint(run):
    """It goes on with the weights, Adam's moments and the adapted learning rates, and counts steps from zero: with the
    initial learning rate, the first updates would wreck a policy whose standard deviation has shrunk."""
    first = run(desired_kl=1e-9, exp_name="first")
    saved = first.checkpoint("last.pt")
    second = run(desired_kl=1e-9, exp_name="second", checkpoint=str(first.folder / "last.pt"))
    begins = second.iterations[0]
    assert all(torch.equal(value, saved["agent"][name]) for name, value in begins["before"].items())
    rates = [float(group["lr"]) for group in saved["optimizer"]["param_groups"]]
    assert begins["updates"][0]["rates"] == rates and rates[0] < ARGS.learning_rate / 10
    ended = second.checkpoint("last.pt")
    for name, moments in saved["optimizer"]["state"].items():
        assert ended["optimizer"]["state"][name]["step"] == 2 * moments["step"] > 0
    assert ended["global_step"] == saved["global_step"] == ARGS.total_timesteps


def test_normalization_follows_the_update(run):
    """An update uses the same statistics as its rollout. After it, the statistics cover all data so far."""
    record = run(norm_obs=True)
    seen = []
    for number, iteration in enumerate(record.iterations):
        statistics = {k: v for k, v in iteration["before"].items() if k.startswith("obs_")}
        for update in iteration["updates"]:
            assert all(torch.equal(update["statistics"][k], statistics[k]) for k in statistics)
        seen.append(iteration["storage"]["obs"].flatten(0, 1).double())
        later = record.iterations[number + 1]["before"] if number + 1 < ITERATIONS else record.evaluations[-1]
        data = torch.cat(seen)
        torch.testing.assert_close(later["obs_mean"].double(), data.mean(0), rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(later["obs_var"].double(), data.var(0, correction=0), rtol=1e-4, atol=1e-4)
        assert later["obs_count"].item() == pytest.approx(len(data), rel=1e-4)
    off = run(exp_name="off").checkpoint("last.pt")["agent"]
    assert not off["obs_mean"].any() and (off["obs_var"] == 1).all()


def test_the_first_epoch_beyond_target_kl_is_the_last(run):
    """The last minibatch of an epoch decides, as in CleanRL. The threshold is the largest divergence in the first two
    epochs of a run without target_kl."""

    def divergences(record):
        kl = [
            [update["metrics"][ppo.UPDATE_METRICS.index("approx_kl")].item() for update in i["updates"]]
            for i in record.iterations
        ]
        return [np.reshape(x, (-1, 4))[:, -1].tolist() for x in kl]

    flags = dict(update_epochs=6, learning_rate=5e-4)
    free = divergences(run(**flags, exp_name="free"))
    assert all(len(x) == 6 for x in free)
    target = max(free[0][:2])
    stopped = divergences(run(**flags, target_kl=target, exp_name="stopped"))
    first = next(i for i, x in enumerate(free[0]) if x > target)
    assert 0 < first < 5 and stopped[0] == pytest.approx(free[0][: first + 1])
    for epochs in stopped:
        assert all(x <= target for x in epochs[:-1]) and (len(epochs) == 6 or epochs[-1] > target)


def test_each_rollout_acts_with_what_was_learned_before_it(run):
    record = run()
    weights = lambda state: torch.cat([v.flatten() for k, v in state.items() if not k.startswith("obs_")])
    for number, iteration in enumerate(record.iterations):
        after = weights(iteration["after_updates"])
        assert not torch.equal(weights(iteration["before"]), after)
        assert torch.equal(weights(record.evaluations[number]), weights(iteration["before"]))
        if number + 1 < ITERATIONS:
            following = record.iterations[number + 1]
            assert torch.equal(weights(following["before"]), after)
            assert torch.equal(following["first_obs"], iteration["next_obs"]), "episodes must go on"
    last = record.checkpoint("last.pt")
    assert torch.equal(weights(last["agent"]), after) and torch.equal(weights(record.evaluations[-1]), after)
    assert last["iteration"] == ITERATIONS and last["global_step"] == ARGS.total_timesteps


def test_training_rows(run):
    """Rows contain means over the finished episodes, means over all minibatches, and the explained variance."""
    record = run(reward_scale=0.1)
    for row, iteration in zip(record.train_rows, record.iterations, strict=True):
        sums = dict(iteration["sums"])
        count = sums.pop("num_episodes")
        assert row["num_episodes"] == count > 0
        assert {k: row[k] for k in sums} == pytest.approx({k: v / count for k, v in sums.items()})
        means = torch.stack([update["metrics"] for update in iteration["updates"]]).mean(0).tolist()
        assert [row[k] for k in ppo.UPDATE_METRICS] == pytest.approx(means, rel=1e-3, abs=1e-7)
        *_, returns, values = flat_batch(record.args, iteration["storage"])
        explained = 1 - np.var(returns - values, ddof=1) / np.var(returns, ddof=1)
        assert row["explained_variance"] == pytest.approx(explained, rel=1e-3)
    assert [row["global_step"] for row in record.train_rows] == [48, 96, 144, 192]


def scripted(*evaluations):
    """Evaluations of two episodes, and two more if there is a second look: success at some step and at the end, and
    return."""
    return [dict(zip(("success_once", "success_at_end", "return"), x)) for x in evaluations]


NONE, HALF, ALL = [0, 0, 0, 0], [0, 1, 0, 1], [1, 1, 1, 1]


@pytest.mark.parametrize(
    "evaluations, best, looks_twice",
    [
        # success counts first, whatever the return
        ([(NONE, NONE, [5] * 4), (HALF, HALF, [0] * 4), (NONE, NONE, [9] * 4), (HALF, HALF, [2] * 4)], 3, [1, 1, 0, 1]),
        # to stay counts as much as to arrive
        ([(HALF, HALF, [0] * 4), (ALL, NONE, [5] * 4), (ALL, HALF, [1] * 4), (ALL, NONE, [9] * 4)], 2, [1, 1, 1, 0]),
        # of equal scores the first one is kept
        ([(ALL, ALL, [3] * 4), (ALL, ALL, [3] * 4), (ALL, ALL, [2, 3, 3, 3]), (HALF, HALF, [9] * 4)], 0, [1, 0, 0, 0]),
        # the second look decides: here the first episodes were luck
        ([(HALF, HALF, [1] * 4), ([1, 1, 0, 0], [1, 1, 0, 0], [1, 1, 0, 0]), (NONE, NONE, [9] * 4)], 0, [1, 1, 0]),
        # a score that is not finite is never the best
        ([(NONE, NONE, [1] * 4), (ALL, ALL, [math.nan, 3, 3, 3]), (HALF, HALF, [1] * 4)], 2, [1, 1, 1]),
    ],
)  # fmt: skip
def test_the_best_checkpoint(run, evaluations, best, looks_twice):
    evaluations += [(NONE, NONE, [0] * 4)] * (ITERATIONS + 1 - len(evaluations))
    looks_twice += [0] * (ITERATIONS + 1 - len(looks_twice))
    record = run(scripted(*evaluations))
    checkpoint = record.checkpoint("best.pt")
    assert checkpoint["iteration"] == best and checkpoint["global_step"] == best * NUM_ENVS * NUM_STEPS
    assert all(torch.equal(v, checkpoint["agent"][k]) for k, v in record.evaluations[best].items())
    once, at_end, returns = evaluations[best]
    assert checkpoint["best_score"] == [pytest.approx(np.mean(once) + np.mean(at_end)), pytest.approx(np.mean(returns))]
    assert record.second_looks == looks_twice
    assert [row["num_episodes"] for row in record.eval_rows] == [2] * (ITERATIONS + 1), "curves show the first look"
    assert [row["success_once"] for row in record.eval_rows] == [np.mean(x[0][:2]) for x in evaluations]
    assert record.checkpoint("last.pt")["iteration"] == ITERATIONS


def test_without_success_the_return_decides(run):
    record = run([{"return": [x] * 4} for x in (-5.0, -2.0, -3.0, -1.0, -4.0)])
    assert record.checkpoint("best.pt")["iteration"] == 3


@pytest.mark.parametrize("rate, last", [(0.5, 2), (1.0, 3), (None, 4)])
def test_stop_at_success(run, rate, last):
    record = run(scripted(*[(x, NONE, NONE) for x in (NONE, NONE, HALF, ALL, NONE)]), stop_at_success=rate)
    checkpoint = record.checkpoint("last.pt")
    assert checkpoint["iteration"] == last and len(record.iterations) == last
    assert checkpoint["finished"] == (last == ITERATIONS), "a run that stopped earlier can go on"
    assert len(record.eval_rows) == last + 1


# ----- on the CPU and, if there is one, on a GPU ----------------------------------------------------------------------


TEXTBOOK = dict(bootstrap_at_done="truncated", partial_reset=False, norm_obs=True, anneal_lr=True)
FINITE_HORIZON = dict(finite_horizon_gae=True, clip_vloss=True, target_kl=None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "flags, seed",
    [({}, 1), (TEXTBOOK, 2), (FINITE_HORIZON, 3)],
    ids=["default", "textbook", "finite-horizon"],
)
@on_cpu_and_cuda
def test_learns(train, device, flags, seed):
    size = dict(num_envs=128, total_timesteps=20_480, eval_freq=0)
    metrics, _ = train(seed=seed, learning_rate=1e-3, update_epochs=8, cudagraphs=True, **size, **flags)
    first, last = [row for row in metrics if row["kind"] == "eval"]
    assert first["success_once"] < 0.2
    assert last["success_once"] >= 0.95 and last["num_episodes"] == 24


@on_cpu_and_cuda
def test_evaluation_schedule_and_no_effect_on_training(train):
    """Evaluations run before training, every eval_freq iterations, and after the last one. The weights do not depend on
    them."""
    runs = {freq: train(eval_freq=freq, num_eval_episodes=16 + freq) for freq in (0, 1, 3)}
    steps = {f: [row["global_step"] // 320 for row in m if row["kind"] == "eval"] for f, (m, _) in runs.items()}
    assert steps == {0: [0, 4], 1: [0, 1, 2, 3, 4], 3: [0, 3, 4]}
    checkpoints = [checkpoint for _, checkpoint in runs.values()]
    assert all(same_weights(checkpoints[0], other) for other in checkpoints[1:])
    assert checkpoints[0]["iteration"] == 4 and checkpoints[0]["global_step"] == 1280


@on_cpu_and_cuda
def test_same_seed_same_weights_other_seed_others(train):
    (_, a), (_, b), (_, c) = train(seed=5), train(seed=5), train(seed=6)
    assert same_weights(a, b) and not same_weights(a, c)


def test_evaluation_seeds_are_episodes_and_not_environments(train, device):
    """Any number of environments plays the same episodes, even if the last round is not full."""
    torch.manual_seed(0)
    agent = ppo.Agent(box(4), ACTIONS, SMALL).to(device)
    agent.actor_mean[-1].weight.data *= 100
    results = []
    for num_envs in (1, 5, 16):
        for separately in (False, True):
            envs = batched_env.make_envs(SMALL, num_envs, 0, evaluation=True, device=device)
            results.append(ppo.evaluate(agent, envs, SMALL, 11, seed=100, separately=separately))
    for result in results:
        assert set(result) == {"return", "episode_len", "success_once", "success_at_end", "fail_once", "fail_at_end"}
        for key, values in result.items():
            assert values.shape == (11,)
            torch.testing.assert_close(values, results[0][key])
    assert (results[0]["episode_len"] == 20).all()


def test_evaluation_with_early_ends(train, device):
    """With eval_partial_reset, an episode counts up to its first success."""
    agent = ppo.Agent(box(4), ACTIONS, SMALL).to(device)
    agent.get_action = lambda obs: ((obs[:, 2:] - obs[:, :2]) / 0.3).clamp(-1, 1)  # straight to the goal
    envs = batched_env.make_envs(replace(SMALL, eval_partial_reset=True), 16, 0, evaluation=True, device=device)
    result = ppo.evaluate(agent, envs, SMALL, 16, seed=0)
    start = envs.base_env.reset(seed=list(range(16)))[0]
    needed = ((start[:, 2:] - start[:, :2]).abs().amax(1) / 0.3 - 0.34).ceil().clamp(min=1).cpu()
    assert result["success_at_end"].all() and result["success_once"].all()
    assert (result["episode_len"] <= 7).all() and ((result["episode_len"] - needed).abs() <= 1).all()


def test_separate_learning_rates(train):
    _, a = train(critic_learning_rate=0.0, total_timesteps=320)
    _, b = train(total_timesteps=320)
    ppo.seed_all(SMALL.seed)
    fresh = ppo.Agent(box(4), ACTIONS, SMALL).state_dict()
    for key in fresh:
        critic = key.startswith("critic")
        fixed = key.startswith(("obs_", "action_"))
        assert torch.equal(a["agent"][key].cpu(), fresh[key]) == (critic or fixed), key
        assert torch.equal(b["agent"][key].cpu(), fresh[key]) == fixed, key


def test_a_real_task(in_tmp):
    """A run on a task of ManiSkill, in a batch in this process, counts finished episodes and writes trajectories of its
    evaluations."""
    args = ppo.Args(
        sim_backend="physx_cpu", num_envs=4, num_actors=1, num_steps=15, total_timesteps=120, num_minibatches=4,
        num_eval_envs=3, num_eval_episodes=5, exp_name="x", capture_video=False, save_trajectory=True, cuda=False,
        env_kwargs='{"max_episode_steps": 10}', staggered_resets=False,
    )  # fmt: skip
    with contextlib.ExitStack() as closing:
        ppo.train(args, closing)
    rows = read_metrics(in_tmp / "runs/x")
    assert [row["num_episodes"] for row in rows] == [5, 4, 8, 5] and rows[-1]["kind"] == "eval"
    assert all(row["episode_len"] == 10 and math.isfinite(row["return"]) for row in rows)
    episodes = json.loads((in_tmp / "runs/x/videos/trajectory_0.json").read_text())["episodes"]
    assert all(e["elapsed_steps"] == 10 for e in episodes)
    seeds, first_look, second_look = [e["episode_seed"] for e in episodes], [*range(6)], [*range(5, 11)]
    assert seeds[:18] == first_look + second_look + first_look, "two rounds of three episodes each"
    assert seeds[18:] in ([], second_look), "the last policy is looked at again if it may be the best"


@on_gpus
def test_cpu_simulation_feeds_a_gpu_learner(in_tmp, monkeypatch, device):
    """A copy of the agent on the CPU acts. The first rollout equals that of a CPU learner, and the second uses the
    weights that the GPU has learned."""
    monkeypatch.setattr(ppo, "make_envs", partial(batched_env.make_envs, device="cpu"))
    rollout, copies = ppo.rollout, []

    def spy(agent, *others):
        copies.append({k: v.clone() for k, v in agent.state_dict().items()})
        return rollout(agent, *others)

    monkeypatch.setattr(ppo, "rollout", spy)
    rows = []
    for cuda in (False, True):
        args = replace(SMALL, exp_name=f"cuda{cuda}", cuda=cuda, save_freq=1, num_steps=20, total_timesteps=32 * 20 * 2)
        with contextlib.ExitStack() as closing:
            ppo.train(args, closing)
        rows.append([row for row in read_metrics(in_tmp / f"runs/cuda{cuda}") if row["kind"] == "train"])
    on_cpu, on_gpu = rows
    for key in ("return", "num_episodes", "explained_variance"):
        assert on_gpu[0][key] == pytest.approx(on_cpu[0][key], rel=1e-3), key
    learned = ppo.load_checkpoint("runs/cudaTrue/iteration_1.pt")
    assert all(x.device.type == "cpu" for x in copies[-1].values())
    assert same_weights(learned, {"agent": copies[-1]})
