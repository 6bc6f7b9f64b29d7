"""Does a task start its episodes as ManiSkill's batches require? For the examples, tasks of ManiSkill, and yours:

    pytest PATH/TO/tests/test_task.py --env_id my_module:MyTask-v1

Run it from the folder of your module. It needs no plugin of pytest. It simulates a batch on the CPU and, if there is a
GPU, on `physx_cuda`. The summary reports where the checks ran.
"""

import os
import sys
from pathlib import Path

import gymnasium as gym
import pytest
import torch

import ppo

# isort: split
import mani_skill.envs  # noqa: F401
from mani_skill.utils import common
from mani_skill.utils.structs import Pose

sys.path.insert(0, os.getcwd())  # the folder of your module
NUM_ENVS = 5
EXAMPLES = [
    "examples.push_to_goal:PushToGoal-v1",
    "examples.push_from_clutter:PushFromClutter-v1",
    "examples.curriculum:PushFurther-v1",
]
MANISKILL = ["PushCube-v1", "PickCube-v1", "StackCube-v1", "MS-CartpoleBalance-v1"]


def pytest_generate_tests(metafunc):
    if "env_id" in metafunc.fixturenames:
        given = metafunc.config.getoption("--env_id")
        metafunc.parametrize("env_id", given or EXAMPLES + MANISKILL, scope="module")


def make(env_id, sim_backend="physx_cpu", **kwargs):
    return gym.make(env_id, obs_mode="state", sim_backend=sim_backend, render_backend="none", **kwargs)


@pytest.fixture(scope="module", params=["physx_cpu", "physx_cuda"])
def sim_backend(request):
    if request.param == "physx_cuda" and not (
        torch.cuda.is_available() and [*Path.home().glob(".sapien/physx/*/libPhysX*")]
    ):
        pytest.skip("needs a GPU and PhysX's GPU library (SAPIEN downloads it when it first simulates on a GPU)")
    return request.param


@pytest.fixture(scope="module")
def envs(env_id, sim_backend):
    """NUM_ENVS environments of the task in one batch."""
    env = make(env_id, sim_backend, num_envs=NUM_ENVS)
    yield env
    env.close()


# ----- what the checks compare ----------------------------------------------------------------------------------------


def everything(env):
    """Returns what an episode is made of, by name: tensors (num_envs, ...), and the task's other tensors."""
    base, parts = env.unwrapped, {}
    for name, actor in {**base.scene.actors, **base.scene.actor_views}.items():
        if len(actor._objs) == base.num_envs and actor.px_body_type != "static":
            parts[f"pose of {name}"] = actor.pose.raw_pose
            if actor.px_body_type == "dynamic":
                parts[f"velocity of {name}"] = torch.cat([actor.linear_velocity, actor.angular_velocity], dim=1)
    for name, robot in {**base.scene.articulations, **base.scene.articulation_views}.items():
        if len(robot._objs) == base.num_envs:
            parts |= {f"joint positions of {name}": robot.qpos, f"joint velocities of {name}": robot.qvel}
            parts |= {f"base of {name}": robot.root_pose.raw_pose}

    def collect(name, value):
        if isinstance(value, Pose):
            value = value.raw_pose
        if isinstance(value, torch.Tensor):
            parts[f"attribute {name}"] = value
        elif isinstance(value, (dict, list, tuple)):
            for k, v in value.items() if isinstance(value, dict) else enumerate(value):
                collect(f"{name}[{k!r}]", v)

    for name, value in vars(base).items():
        if name not in ("_last_obs", "_init_raw_obs", "_init_raw_state", "_elapsed_steps"):  # ManiSkill's bookkeeping
            collect(name, value)
    return {name: value.clone() for name, value in parts.items()}


def rows_of(env, parts):
    """Returns those of `parts` that have a row for each environment."""
    return {k: v for k, v in parts.items() if v.ndim and len(v) == env.unwrapped.num_envs}


def play(env, steps, seed=0):
    """Take random actions; returns the result of the last one, and that action."""
    env.action_space.seed(seed)
    for _ in range(steps):
        action = env.action_space.sample()
        result = env.step(action)
    return *result, action


def first_difference(a, b, rows=slice(None)):
    for name in a | b:
        if name not in a or name not in b or a[name].shape != b[name].shape:
            return name
        if not torch.allclose(a[name][rows].double(), b[name][rows].double(), rtol=0, atol=0, equal_nan=True):
            return name
    return None


def placed(parts):
    """Returns the parts that _initialize_episode decides, without those that ManiSkill decides."""
    return {k: v for k, v in parts.items() if k.startswith(("pose", "joint positions", "attribute"))}


def seeds(start):
    return list(range(start, start + NUM_ENVS))


OWN_TENSOR = (
    "self.{0} has {1} rows after a reset of environments {2}. A tensor of your own keeps num_envs rows: allocate it in "
    "_load_scene, and write self.{0}[env_idx] = ... in _initialize_episode"
)


def reset_some(env, env_idx, **options):
    try:
        return env.reset(options={"env_idx": torch.tensor(env_idx, device=env.unwrapped.device), **options})
    except (RuntimeError, IndexError, ValueError, AssertionError) as error:
        if "reconfigure" in str(error):
            raise
        for name, value in vars(env.unwrapped).items():
            if isinstance(value, torch.Tensor) and value.shape[:1] == (len(env_idx),):
                raise AssertionError(OWN_TENSOR.format(name, len(env_idx), env_idx)) from error
        raise AssertionError(
            f"a reset of environments {env_idx} of {NUM_ENVS} fails: {error}. Whatever _initialize_episode makes must "
            "have len(env_idx) rows, not num_envs"
        ) from error


# ----- the checks: each raises AssertionError with a message that names the fault -------------------------------------


def check_observations(env):
    """Observations have the declared shape and are finite."""
    space = env.get_wrapper_attr("single_observation_space")
    obs, _ = env.reset(seed=seeds(0))
    for step in range(10):
        assert tuple(obs.shape[1:]) == space.shape, f"observations {tuple(obs.shape[1:])}, declared {space.shape}"
        assert torch.isfinite(obs).all(), f"an observation is not finite {step} steps after the reset"
        obs = play(env, 1, seed=step)[0]


def check_seeds(env):
    """The same seeds give the same episodes, and other seeds give others. Each environment has its own episode."""
    of_episodes = lambda: {k: v for k, v in rows_of(env, everything(env)).items() if v.is_floating_point()}
    env.reset(seed=seeds(5))
    first = of_episodes()
    env.reset(seed=seeds(5))
    name = first_difference(first, of_episodes())
    assert name is None, f"two resets with the same seeds differ in the {name}: it is drawn from an unseeded generator"
    env.reset(seed=seeds(500))
    other = of_episodes()
    assert first_difference(first, other), "two seeds give the same episode: nothing is randomised"
    for name in placed(first):
        if not torch.equal(first[name], other[name]) and len(first[name]) > 1:
            alike = (first[name] == first[name][0]).all()
            assert not alike, f"the {name} is random, but the same in all environments: draw len(env_idx) rows"


def check_company(env):
    """An episode follows from its own seed, whatever the seeds of the other environments are."""
    row, first, second = 2, seeds(5), seeds(500)
    second[row] = first[row]
    starts = []
    for numbers in (first, second):
        env.reset(seed=numbers)
        starts.append({k: v[row] for k, v in placed(rows_of(env, everything(env))).items()})
    for name, value in starts[0].items():
        assert torch.allclose(value.double(), starts[1][name].double(), atol=1e-5, equal_nan=True), (
            f"the {name} of one seed depends on the seeds of other environments: draw from "
            "self._batched_episode_rng[env_idx], not from torch.rand, and pass enhanced_determinism=True"
        )


def check_neighbours(env):
    """What an environment does in an episode does not depend on what the others do."""
    row, results = 2, []
    env.action_space.seed(0)
    shape = env.action_space.shape
    own = [env.action_space.sample()[row] for _ in range(10)]
    for company in (1, 2):
        env.action_space.seed(company)
        env.reset(seed=seeds(5), options=dict(reconfigure=True))  # PhysX remembers contacts of earlier episodes
        results.append([])
        for action in own:
            actions = env.action_space.sample().reshape(shape)
            actions[row] = action
            obs, reward, terminated, truncated, info = env.step(actions)
            numbers = {k: v for k, v in info.items() if isinstance(v, torch.Tensor) and v.shape == reward.shape}
            everything = {"observation": obs, "reward": reward, "end": terminated | truncated, **numbers}
            results[-1].append({k: v[row].double() for k, v in everything.items()})
    for step, (one, other) in enumerate(zip(*results)):
        for name in one:
            assert torch.allclose(one[name], other[name], atol=1e-4, equal_nan=True), (
                f"the {name} of an environment depends on the actions of the others, {step + 1} steps after the reset: "
                "do not compute it from the rows of all environments"
            )


def check_everything_is_initialised(env):
    """Nothing is left over from the episode before."""
    env.reset(seed=seeds(5))
    first = everything(env)
    play(env, 15)
    env.reset(seed=seeds(5))
    after = everything(env)
    for name in first:
        if not name.startswith("attribute") and not torch.allclose(first[name], after[name], atol=1e-5):
            raise AssertionError(f"the {name} is left from the episode before: _initialize_episode does not set it")


def check_partial_reset(env):
    """A partial reset changes the environments of env_idx, and no others."""
    env.reset(seed=seeds(5))
    for env_idx in ([1, 3], [2], [0], [0, 1, 2]):
        play(env, 4)
        before = everything(env)
        reset_some(env, env_idx)
        after, others = everything(env), [i for i in range(NUM_ENVS) if i not in env_idx]
        exact = ppo.is_batch(env.unwrapped.scene)  # exact on the CPU; on a GPU the last bits may differ
        for name in rows_of(env, before):
            assert before[name].shape == after[name].shape, OWN_TENSOR.format(
                name.removeprefix("attribute "), len(after[name]), env_idx
            )
            assert torch.allclose(
                before[name][others].double(), after[name][others].double(), atol=0 if exact else 1e-5, equal_nan=True
            ), f"a reset of environments {env_idx} changes the {name} of environments {others}: env_idx is ignored"
        before, after = [placed(rows_of(env, parts)) for parts in (before, after)]
        assert first_difference(before, after, env_idx), f"a reset of environments {env_idx} does nothing"


def check_overlap(env, resets=1000, tolerance=2e-3):
    """By PhysX's own contacts, no free object starts inside another (CPU only). Few episodes start in success."""
    _, info = env.reset(seed=seeds(10_000))
    solved = 0
    for k in range(resets // NUM_ENVS):
        if "success" in info:
            solved += int(info["success"].sum())
        scene = env.unwrapped.scene
        scene.px.step()
        for i, system in enumerate(scene.px.systems):
            free = {body for body in system.rigid_dynamic_components if not body.kinematic}
            for contact in system.get_contacts():
                if free & set(contact.bodies):
                    depth = -min([point.separation for point in contact.points], default=0)
                    names = " and ".join(body.entity.name.removeprefix(f"scene-{i}_") for body in contact.bodies)
                    assert depth < tolerance, (
                        f"{names} overlap by {1000 * depth:.0f} mm in reset {k} of environment {i}"
                    )
        scene._gpu_fetch_all()
        _, info = env.reset()
    assert solved <= resets / 20, f"{solved} of {resets} episodes start in success"


def check_options(env):
    """Options of reset reach _initialize_episode."""
    seen, initialize = [], env.unwrapped._initialize_episode

    def spy(env_idx, options):
        seen.append(options)
        return initialize(env_idx, options)

    env.unwrapped._initialize_episode = spy
    try:
        reset_some(env, [1, 2], something=3)
    finally:
        del env.unwrapped._initialize_episode
    assert seen and seen[-1].get("something") == 3, "reset's options do not reach _initialize_episode"


def check_restoring_states(env):
    """reset_to_env_states restores the states of all or of some environments, without _initialize_episode."""
    env.reset(seed=seeds(5))
    play(env, 5)

    def flatten(tree, prefix=""):
        parts = [flatten(v, f"{prefix}{k} ") if isinstance(v, dict) else {prefix + k: v} for k, v in tree.items()]
        return {k: v for part in parts for k, v in part.items() if not k.startswith("controller")}  # not restored

    read = lambda: flatten(env.unwrapped.get_state_dict())
    rows = lambda tree, i: {k: rows(v, i) for k, v in tree.items()} if isinstance(tree, dict) else tree[i]
    state, flat, expected = env.unwrapped.get_state_dict(), read(), everything(env)
    play(env, 5)
    env.unwrapped._initialize_episode = lambda env_idx, options: pytest.fail("_initialize_episode was called")
    try:
        env.reset(options=dict(reset_to_env_states=dict(env_states=state)))
        restored = everything(env)
        for name, value in expected.items():
            if not name.startswith("attribute"):
                assert torch.allclose(restored[name], value, atol=1e-5), f"the {name} is not restored"
        env_idx = torch.tensor([1, 3], device=env.unwrapped.device)
        play(env, 5)
        before = read()
        env.reset(options=dict(env_idx=env_idx, reset_to_env_states=dict(env_states=rows(state, env_idx))))
        others = [i for i in range(NUM_ENVS) if i not in (1, 3)]
        for name, after in read().items():
            assert torch.allclose(after[[1, 3]], flat[name][[1, 3]], atol=1e-5), f"not restored: {name} of [1, 3]"
            assert torch.allclose(after[others], before[name][others], atol=1e-5), f"restoring [1, 3] changes {name}"
    finally:
        del env.unwrapped._initialize_episode


def check_rewards(env_id, sim_backend, steps=60):
    """Normalised dense rewards are within [0, 1], in success as well, and dense ones are bounded. Random actions do not
    succeed everywhere."""
    modes = ppo.find_task(env_id).cls.SUPPORTED_REWARD_MODES
    for mode in [mode for mode in ("normalized_dense", "dense") if mode in modes]:
        env = make(env_id, sim_backend, num_envs=NUM_ENVS, reward_mode=mode)
        env.reset(seed=seeds(3))
        succeeded = torch.zeros(NUM_ENVS, dtype=torch.bool)
        for step in range(steps):
            obs, reward, *_, info, action = play(env, 1, seed=step)
            if "success" in info:
                won = {**info, "success": torch.ones_like(info["success"])}
                action = common.to_tensor(action, device=obs.device)
                won = env.unwrapped.get_reward(obs=obs, action=action, info=won)
                reward = torch.cat([reward, won])
            assert torch.isfinite(obs).all() and torch.isfinite(reward).all(), "observation or reward not finite"
            low, high = (-1e-5, 1 + 1e-5) if mode == "normalized_dense" else (-1e3, 1e3)
            assert ((reward >= low) & (reward <= high)).all(), f"{mode} reward {reward.tolist()}"
            succeeded |= info.get("success", torch.zeros_like(succeeded)).cpu()
        env.close()
        assert not succeeded.all(), "random actions succeed in all environments: check `success`"


def check_autoreset(env_id, sim_backend):
    """When an episode ends, its final observation is not the first one of the next episode."""
    env = make(env_id, sim_backend, num_envs=NUM_ENVS, max_episode_steps=6)
    envs = ppo.ManiSkillVectorEnv(env, record_metrics=True)
    envs.reset(seed=seeds(3))
    ended = torch.zeros(NUM_ENVS, dtype=torch.bool)
    for _ in range(14):
        obs, *_, infos = envs.step(common.to_tensor(envs.action_space.sample(), device=envs.device))
        if "final_observation" in infos:
            done = infos["_final_info"]
            same = (infos["final_observation"][done] == obs[done]).all(dim=1)
            assert not same.any(), "the final observation is the one after the reset"
            ended |= done.cpu()
    envs.close()
    assert ended.all(), "no episode ended at its time limit"


# ----- on each task ---------------------------------------------------------------------------------------------------


def test_observations(envs):
    check_observations(envs)


def test_seeds(envs):
    check_seeds(envs)


def test_company(envs, env_id):
    if env_id in MANISKILL:  # these draw from torch.rand
        with pytest.raises(AssertionError, match="depends on the seeds of other environments"):
            check_company(envs)
    else:
        check_company(envs)


def test_neighbours(envs):
    check_neighbours(envs)


def test_everything_is_initialised(envs):
    check_everything_is_initialised(envs)


def test_partial_reset(envs):
    check_partial_reset(envs)


def test_no_overlap(envs, env_id, request):
    if not ppo.is_batch(envs.unwrapped.scene):
        pytest.skip("only CPU simulation reports the contacts")
    check_overlap(envs, resets=1000 if "examples" in env_id or request.config.getoption("--env_id") else 250)


def test_options(envs):
    check_options(envs)


def test_restoring_states(envs):
    check_restoring_states(envs)


def test_rewards(env_id, sim_backend):
    check_rewards(env_id, sim_backend)


def test_autoreset(env_id, sim_backend):
    check_autoreset(env_id, sim_backend)
