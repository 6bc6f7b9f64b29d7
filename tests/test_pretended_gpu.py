"""ManiSkill's tasks train on the GPU that pretended_gpu.py pretends: no tensors of two devices meet."""

import contextlib
import json
import re
from dataclasses import replace

import pytest
import test_rgb
import torch
from conftest import ROOT, SMALL, read_metrics
from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env
from pretended_gpu import simulate_on_gpu

import ppo
import ppo_rgb

pytestmark = pytest.mark.parametrize("device", ["pretended"], indirect=True)
# Our own tasks, and one of each kind of ManiSkill's: its tasks run on GPUs already.
TASKS = re.findall(r"--env_id (examples\S+)", (ROOT / "examples/recipes.sh").read_text())
TASKS += ["MS-CartpoleBalance-v1", "TwoRobotPickCube-v1", "TriFingerRotateCubeLevel0-v1", "SO100GraspCube-v1"]


@register_env("ForgetsTheDevice-v1", max_episode_steps=50)
class ForgetsTheDevice(PushCubeEnv):
    def compute_dense_reward(self, obs, action, info):
        return super().compute_dense_reward(obs, action, info) + torch.ones(self.num_envs)


@pytest.fixture
def train_task(device, in_tmp, monkeypatch):
    """A function that trains on a task for two iterations, with episodes of three steps."""

    def run(script, env_id, **flags):
        simulate_on_gpu(monkeypatch, ppo, ppo_rgb)
        args = replace(
            SMALL if script is ppo else test_rgb.SMALL_IMAGES, env_id=env_id, exp_name="run", cuda=True, num_envs=3,
            num_eval_envs=2, num_eval_episodes=2, num_steps=4, num_minibatches=2, total_timesteps=24, eval_freq=0,
            env_kwargs=json.dumps(dict(max_episode_steps=3)), **flags,
        )  # fmt: skip
        with contextlib.ExitStack() as closing:
            script.train(args, closing)
        assert [row["kind"] for row in read_metrics(in_tmp / "runs/run")] == ["eval", "train", "train", "eval"]

    return run


def test_shapes_and_tuples_keep_their_type(device):
    x = torch.ones(2, 3, device=device)
    assert type(x.shape) is type(x.size()) is torch.Size
    assert x.is_cuda and all(part.is_cuda for part in x.max(dim=1)) and x.max(dim=1).values.is_cuda


@pytest.mark.parametrize("env_id", ["PushCube-v1", *(pytest.param(x, marks=pytest.mark.slow) for x in TASKS)])
def test_tasks_train(train_task, env_id):
    train_task(ppo, env_id)


@pytest.mark.slow
@pytest.mark.render
@pytest.mark.parametrize("env_id", ["MS-CartpoleBalance-v1", "PushCube-v1"])
def test_images_train(train_task, env_id):
    train_task(ppo_rgb, env_id, control_mode=None)


def test_a_task_that_forgets_the_device_is_found(train_task):
    with pytest.raises(RuntimeError, match="Expected all tensors to be on the same device"):
        train_task(ppo, "ForgetsTheDevice-v1")
