"""The training loop on a torch-native batched environment inside the real ManiSkillVectorEnv. GPU simulation takes the
same path. These tests run on the CPU and, if there is one, on a GPU."""

import contextlib
import json
import math
from dataclasses import replace
from functools import partial

import batched_env
import pytest
import torch
from conftest import ACTIONS, SMALL, box, read_metrics, same_weights

import ppo

TEXTBOOK = dict(bootstrap_at_done="truncated", partial_reset=False, norm_obs=True, anneal_lr=True)
FINITE_HORIZON = dict(finite_horizon_gae=True, shared_features=True, clip_vloss=True, target_kl=None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "flags, seed",
    [({}, 1), (TEXTBOOK, 2), (FINITE_HORIZON, 3)],
    ids=["default", "textbook", "finite-horizon"],
)
def test_learns(train, flags, seed):
    size = dict(num_envs=128, total_timesteps=40_000, eval_freq=0)
    metrics, *_ = train(seed=seed, learning_rate=1e-3, update_epochs=8, **size, **flags)
    first, last = [row for row in metrics if row["kind"] == "eval"]
    assert first["success_once"] < 0.2
    assert last["success_once"] >= 0.95 and last["num_episodes"] == 24


def test_evaluation_schedule_and_no_effect_on_training(train):
    """Evaluations run before training, every eval_freq iterations, and after the last one. The weights do not depend on
    them."""
    runs = {freq: train(eval_freq=freq, num_eval_episodes=16 + freq) for freq in (0, 1, 3)}
    steps = {f: [row["global_step"] // 320 for row in m if row["kind"] == "eval"] for f, (m, *_) in runs.items()}
    assert steps == {0: [0, 4], 1: [0, 1, 2, 3, 4], 3: [0, 3, 4]}
    checkpoints = [checkpoint for _, checkpoint, _ in runs.values()]
    assert all(same_weights(checkpoints[0], other) for other in checkpoints[1:])
    assert checkpoints[0]["iteration"] == 4 and checkpoints[0]["global_step"] == 1280


def test_same_seed_same_weights_other_seed_others(train):
    (_, a, _), (_, b, _), (_, c, _) = train(seed=5), train(seed=5), train(seed=6)
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
            results.append(ppo.evaluate(agent, envs, 11, seed=100, num_steps=20, separately=separately))
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
    result = ppo.evaluate(agent, envs, 16, seed=0, num_steps=20)
    start = envs.base_env.reset(seed=list(range(16)))[0]
    needed = ((start[:, 2:] - start[:, :2]).abs().amax(1) / 0.3 - 0.34).ceil().clamp(min=1).cpu()
    assert result["success_at_end"].all() and result["success_once"].all()
    assert (result["episode_len"] <= 7).all() and ((result["episode_len"] - needed).abs() <= 1).all()


def test_metrics_are_means_over_finished_episodes_and_the_whole_update(train, monkeypatch):
    """Logged metrics equal the means of what the environments and the updates returned."""
    finished, updates, counted = [], [], []
    step, update = ppo.ManiSkillVectorEnv.step, ppo.update_minibatch

    def spy_step(self, actions):
        result = step(self, actions)
        infos = result[4]
        if self.auto_reset and "final_info" in infos:
            finished.extend(infos["final_info"]["episode"]["return"][infos["_final_info"]].tolist())
        return result

    def spy_update(*args, **kwargs):
        updates.append(update(*args, **kwargs))
        counted.append(len(kwargs["obs"]))
        return updates[-1]

    monkeypatch.setattr(batched_env.ManiSkillVectorEnv, "step", spy_step)
    monkeypatch.setattr(ppo, "update_minibatch", spy_update)
    # 960 / 7 leaves a remainder, but all minibatches have the same size
    metrics, *_ = train(total_timesteps=960, num_steps=30, num_minibatches=7, update_epochs=2, reward_scale=0.1)
    (row,) = [row for row in metrics if row["kind"] == "train"]
    assert row["return"] == pytest.approx(sum(finished) / len(finished), rel=1e-4)
    assert row["num_episodes"] == len(finished) > 32
    means = torch.stack(updates).mean(0).tolist()
    assert [row[k] for k in ppo.UPDATE_METRICS] == pytest.approx(means, rel=1e-4)
    assert counted == [960 // 7] * 14


def test_target_kl_ends_the_update_and_can_be_off(train):
    def updates(**flags):
        calls = []
        original = ppo.update_minibatch
        ppo.update_minibatch = lambda *a, **k: calls.append(1) or original(*a, **k)
        try:
            train(total_timesteps=320, num_minibatches=2, update_epochs=6, learning_rate=1e-2, **flags)
        finally:
            ppo.update_minibatch = original
        return len(calls)

    assert updates(target_kl=None) == 12
    assert updates(target_kl=1e-6) == 2


def test_stop_at_success_and_best_checkpoint(train, in_tmp):
    metrics, last, _ = train(
        total_timesteps=200_000, stop_at_success=0.5, eval_freq=5, learning_rate=1e-3, update_epochs=8
    )
    evaluations = [row for row in metrics if row["kind"] == "eval"]
    assert evaluations[-1]["success_once"] >= 0.5 > evaluations[-2]["success_once"]
    best = ppo.load_checkpoint(in_tmp / "runs/run1/best.pt")
    assert best["global_step"] == last["global_step"] < 200_000 and same_weights(best, last)
    assert last["optimizer"]["state"] and best["best_score"][0] == evaluations[-1]["success_once"]


def test_separate_learning_rates(train):
    _, a, _ = train(critic_learning_rate=0.0, total_timesteps=320)
    _, b, _ = train(total_timesteps=320)
    ppo.seed_all(SMALL.seed)
    fresh = ppo.Agent(box(4), ACTIONS, SMALL).state_dict()
    for key in fresh:
        critic = key.startswith("critic")
        fixed = key.startswith(("obs_", "action_"))
        assert torch.equal(a["agent"][key].cpu(), fresh[key]) == (critic or fixed), key
        assert torch.equal(b["agent"][key].cpu(), fresh[key]) == fixed, key


def test_failure_in_the_middle_keeps_what_was_learned(train, in_tmp, monkeypatch):
    update, calls = ppo.update_minibatch, []

    def failing(*args, **kwargs):
        calls.append(1)
        if len(calls) > 20:
            raise KeyboardInterrupt
        return update(*args, **kwargs)

    monkeypatch.setattr(ppo, "update_minibatch", failing)
    with pytest.raises(KeyboardInterrupt):
        train(update_epochs=4)
    last = ppo.load_checkpoint(in_tmp / "runs/run1/last.pt")
    assert last["iteration"] == 1 and last["global_step"] == 320


def test_anneal_lr_reaches_zero(train):
    metrics, *_ = train(anneal_lr=True, learning_rate=4e-4)
    rates = [row["learning_rate"] for row in metrics if row["kind"] == "train"]
    assert rates == pytest.approx([4e-4, 3e-4, 2e-4, 1e-4])


def test_a_real_task(in_tmp):
    """A run on a task of ManiSkill, in a batch in this process, counts finished episodes and writes trajectories of its
    evaluations."""
    args = ppo.Args(
        sim_backend="physx_cpu", num_envs=4, num_actors=1, num_steps=15, total_timesteps=120, num_minibatches=4,
        num_eval_envs=3, num_eval_episodes=5, exp_name="x", capture_video=False, save_trajectory=True, cuda=False,
        env_kwargs='{"max_episode_steps": 10}',
    )  # fmt: skip
    with contextlib.ExitStack() as closing:
        assert ppo.train(args, closing) == 0
    rows = read_metrics(in_tmp / "runs/x")
    assert [row["num_episodes"] for row in rows] == [5, 4, 8, 5] and rows[-1]["kind"] == "eval"
    assert all(row["episode_len"] == 10 and math.isfinite(row["return"]) for row in rows)
    episodes = json.loads((in_tmp / "runs/x/videos/trajectory_0.json").read_text())["episodes"]
    assert len(episodes) == 12 and all(e["elapsed_steps"] == 10 for e in episodes), (
        "two evaluations, each of two rounds of three episodes"
    )


@pytest.mark.gpu
def test_cpu_simulation_feeds_a_gpu_learner(in_tmp, monkeypatch):
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
            assert ppo.train(args, closing) == 0
        rows.append([row for row in read_metrics(in_tmp / f"runs/cuda{cuda}") if row["kind"] == "train"])
    on_cpu, on_gpu = rows
    for key in ("return", "num_episodes", "explained_variance"):
        assert on_gpu[0][key] == pytest.approx(on_cpu[0][key], rel=1e-3), key
    learned = ppo.load_checkpoint("runs/cudaTrue/iteration_1.pt")
    assert all(x.device.type == "cpu" for x in copies[-1].values())
    assert same_weights(learned, {"agent": copies[-1]})
