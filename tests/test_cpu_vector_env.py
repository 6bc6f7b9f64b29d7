"""The worker pool against the real ManiSkillVectorEnv with one environment: nothing may differ, to the last bit."""

import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

import ppo
import ppo_rgb

ARGS = ppo.Args(sim_backend="physx_cpu", num_envs=3, capture_video=False)
SEEDS = [7, 2**31 + 5, 123]


def flatten(tree, prefix=""):
    flat = {}
    for k, v in tree.items():
        if isinstance(v, dict):
            flat |= flatten(v, f"{prefix}{k}.")
        elif isinstance(v, torch.Tensor):
            flat[prefix + k] = v.clone()
    return flat


def play(envs, seeds, actions, before_reset=lambda seeds: None):
    """Everything that reset and step return, with a second seeded reset on the way: a list of flat dicts."""
    steps = []
    for t, action in enumerate(actions):
        if t in (0, 40):
            seeds = [seed + t for seed in seeds]
            before_reset(seeds)
            obs, info = envs.reset(seed=seeds)
            steps.append(flatten(dict(obs=obs, info=info)))
        obs, reward, terminated, truncated, info = envs.step(action)
        step = dict(obs=obs, reward=reward, terminated=terminated, truncated=truncated, info=info)
        steps.append(flatten(step))
    return steps


TASKS = [("PushCube-v1", "pd_joint_delta_pos"), ("StackCube-v1", "pd_ee_delta_pose"), ("RollBall-v1", "pd_joint_pos"),
         ("TwoRobotPickCube-v1", "pd_joint_delta_pos"), ("MS-AntWalk-v1", "pd_joint_delta_pos")]  # fmt: skip


@pytest.mark.parametrize("env_id, control_mode", TASKS)
def test_cheaper_step_equals_that_of_maniskill(env_id, control_mode, tmp_path, monkeypatch):
    """To the last bit, observations, rewards, infos and the whole state of the simulation."""
    results = []
    for original in (False, True):
        if original:
            monkeypatch.setattr(ppo.Pose, "create", ppo.create_pose)
            monkeypatch.setattr(ppo.Articulation, "set_joint_drive_targets", ppo.set_joint_drive_targets)
        args = replace(ARGS, env_id=env_id, control_mode=control_mode)
        with torch.inference_mode():
            env = ppo.make_env(args, tmp_path, False)
            shape = (60, 1, *env.action_space.shape[-1:])
            actions = 2 * torch.rand(shape, generator=torch.Generator().manual_seed(1)) - 1
            results.append(play(env, [7], actions) + [flatten(env.unwrapped.get_state_dict())])
        env.close()
    for ours, theirs in zip(*results, strict=True):
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(ours[k], theirs[k]) and ours[k].dtype == theirs[k].dtype for k in ours)


STATE = (ppo, ARGS)
IMAGES = ppo_rgb.Args(
    sim_backend="physx_cpu", num_envs=3, capture_video=False, obs_mode="rgb+segmentation", frame_stack=2,
    camera_width=40, camera_height=40, shader="minimal",
)  # fmt: skip


@pytest.mark.parametrize(
    "script, env_id, partial_reset",
    [
        (STATE, "PushCube-v1", False),
        (STATE, "RollBall-v1", True),
        pytest.param((ppo_rgb, IMAGES), "MS-CartpoleBalance-v1", True, marks=pytest.mark.render),
    ],
)
def test_equals_maniskill_vector_env(script, env_id, partial_reset, tmp_path):
    """Episodes end by success or failure at different times, and by the time limit; then the environments reset
    themselves from their own random streams."""
    script, args = script
    args = replace(args, env_id=env_id, partial_reset=partial_reset, env_kwargs='{"max_episode_steps": 15}')
    state = "obs" if script is ppo else "obs.state"
    envs = script.make_envs(args, tmp_path)
    try:
        actions = torch.rand(70, 3, *envs.single_action_space.shape, generator=torch.Generator().manual_seed(0)) * 2 - 1
        if env_id == "MS-CartpoleBalance-v1":
            actions = actions.sign()  # so that the pole falls
        pool = play(envs, SEEDS, actions)
    finally:
        envs.close()
    ended_at, first_observations = set(), []
    for i, seed in enumerate(SEEDS):
        single = script.make_envs(replace(args, num_envs=1), tmp_path)
        assert not isinstance(single.base_env, script.CPUVectorEnv)
        # the pool's environments continue from a random stream of their own, which their seed determines
        stream = lambda seeds: torch.manual_seed(ppo.stream_seed(seeds[0]))
        alone = play(single, [seed], actions[:, i : i + 1], before_reset=stream)
        single.close()
        for t, (theirs, ours) in enumerate(zip(alone, pool, strict=True)):
            ended = "info._final_info" in theirs and bool(theirs["info._final_info"])
            if ended:
                ended_at.add((i, t))
                assert theirs.keys() == ours.keys()
                assert not torch.equal(ours["info.final_" + state.replace("obs", "observation")][i], ours[state][i])
            if ended or t == 0:
                first_observations.append(ours[state][i])
            # where another environment of the pool ended, it also has final_... entries of this one
            for key in theirs.keys() if ended or "info._final_info" not in ours else theirs.keys() & ours.keys():
                assert torch.equal(theirs[key][0], ours[key][i]), (i, t, key)
                assert theirs[key].dtype == ours[key].dtype
    assert len(ended_at) >= 6, "several episodes must end"
    assert len(torch.stack(first_observations).unique(dim=0)) == len(first_observations), (
        "no episode starts like another"
    )


def test_independent_of_number_of_workers(tmp_path):
    """Environment i plays the same episodes whatever process it is in and whoever is beside it."""
    actions = 2 * torch.rand(60, 5, 8, generator=torch.Generator().manual_seed(0)) - 1
    runs = []
    for workers in (1, 2):
        make = ppo.partial(ppo.make_env, replace(ARGS, env_kwargs='{"max_episode_steps": 9}'), tmp_path, False)
        envs = ppo.ManiSkillVectorEnv(ppo.CPUVectorEnv(make, 5, workers), record_metrics=True)
        envs.reset(seed=3)
        runs.append([flatten(dict(zip("ortui", envs.step(a)))) for a in actions])
        envs.close()
    for a, b in zip(*runs):
        assert a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


@pytest.fixture(scope="module")
def pool(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pool")
    envs = ppo.CPUVectorEnv(ppo.partial(ppo.make_env, ARGS, folder, False), 5, 2, auto_reset=False)
    yield envs
    envs.close()
    assert not list(folder.iterdir()), "nothing is written without being asked"


def test_partial_reset_by_hand(pool):
    """reset(options={"env_idx": ...}) touches the named environments alone, seeds or not."""
    first, _ = pool.reset(seed=[1, 2, 3, 4, 5])
    again, _ = pool.reset(seed=[1, 2, 3, 4, 5])
    assert torch.equal(first, again)
    for _ in range(3):
        before, *_ = pool.step(torch.ones(5, 8))
    obs, info = pool.reset(seed=[1, 2, 3, 4, 5], options={"env_idx": torch.tensor([3, 1])})
    assert torch.equal(obs[[1, 3]], first[[1, 3]]) and torch.equal(obs[[0, 2, 4]], before[[0, 2, 4]])
    assert info["elapsed_steps"].tolist() == [3, 0, 3, 0, 3]
    assert torch.equal(pool.elapsed_steps, info["elapsed_steps"])
    obs, _ = pool.reset(options={"env_idx": torch.tensor([0])})
    assert not torch.equal(obs[0], before[0]) and torch.equal(obs[[1, 3]], first[[1, 3]])


def test_returned_tensors_are_not_overwritten(pool):
    results = [pool.reset(seed=0)[0]] + [pool.step(torch.ones(5, 8))[0] for _ in range(3)]
    kept = [r.clone() for r in results]
    pool.step(-torch.ones(5, 8))
    assert all(torch.equal(a, b) for a, b in zip(results, kept)) and not torch.equal(results[1], results[2])


def test_int_seed_follows_maniskills_rule(pool):
    by_int, _ = pool.reset(seed=11)
    by_list, _ = pool.reset(seed=[11, *np.random.RandomState(11).randint(2**31, size=4).tolist()])
    assert torch.equal(by_int, by_list)


def broken_env(index):
    raise ValueError("no such asset")


def test_error_in_worker_is_told(tmp_path):
    with pytest.raises(RuntimeError, match="(?s)worker 0 .*no such asset"):
        ppo.CPUVectorEnv(broken_env, 2, 2)


def test_killed_worker_is_noticed(tmp_path):
    envs = ppo.CPUVectorEnv(ppo.partial(ppo.make_env, ARGS, tmp_path, False), 2, 2)
    envs.reset(seed=0)
    os.kill(envs.workers[1].pid, signal.SIGKILL)
    start = time.monotonic()
    with pytest.raises(RuntimeError, match=r"worker 1 \(environments 1 to 1\).*-9"):
        for _ in range(3):
            envs.step(torch.zeros(2, 8))
    assert time.monotonic() - start < 10
    envs.close()
