"""Functions that the scripts launch as CUDA graphs give the same results as step by step, and do not make the host read
a number.

On the CPU, recorded_graph.py stands in for CUDA graphs."""

import dataclasses
import math
import subprocess
import sys
from typing import Optional

import pytest
import test_rgb
import torch
from conftest import ROOT, SMALL, without_clock
from recorded_graph import RecordedGraph

import ppo
import ppo_rgb


@pytest.fixture(params=[ppo, ppo_rgb], ids=["ppo", "ppo_rgb"])
def script(request):
    return request.param


@pytest.fixture
def small(script):
    return SMALL if script is ppo else test_rgb.SMALL_IMAGES


@pytest.fixture
def with_graphs(train, script, device, monkeypatch):
    def run(**flags):
        with monkeypatch.context() as patch:
            if device.type == "cpu":
                patch.setattr(script, "CudaGraph", RecordedGraph)
            return train(cudagraphs=True, **flags)

    return run


def close(a, b, device):
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        return all(close(a[k], b[k], device) for k in a)
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b) if device.type == "cpu" else torch.allclose(a, b, rtol=1e-3, atol=1e-5)
    return a == b or device.type == "cuda" and math.isclose(a, b, rel_tol=1e-2, abs_tol=1e-3)


FLAGS = [
    dict(anneal_lr=True, norm_obs=True, target_kl=0.003, update_epochs=8),
    dict(clip_vloss=True, finite_horizon_gae=True, bootstrap_at_done="truncated", norm_adv=False, num_minibatches=7),
    # a graph freezes Python numbers: this case finds one that you compute from a flag and change between iterations
    {f.name: 0.9 * (f.default or 0.1) for f in dataclasses.fields(ppo.Args) if f.type in (float, Optional[float])},
]


@pytest.mark.parametrize("flags", FLAGS, ids=["kl-stop", "others", "every-float"])
def test_equals_step_by_step(train, with_graphs, script, device, flags):
    if script is ppo_rgb:
        flags = flags | dict(random_shift=2, obs_mode="rgb+depth+segmentation", update_epochs=2)
    (rows, last), (graph_rows, graph_last) = train(cudagraphs=False, **flags), with_graphs(**flags)
    assert all(close(a, b, device) for a, b in zip(without_clock(rows), without_clock(graph_rows), strict=True))
    assert close(last["agent"], graph_last["agent"], device)


def test_equals_step_by_step_after_a_resume(train, with_graphs, small, device):
    """A resumed run loads the optimizer's tensors before it captures anything."""
    size, results = small.num_envs * small.num_steps, []
    for i, run in enumerate((train, with_graphs)):
        flags = dict(eval_freq=0, anneal_lr=True, **{} if run is with_graphs else dict(cudagraphs=False))
        run(total_timesteps=4 * size, **flags)
        results.append(run(resume=f"runs/run{i + 1}", total_timesteps=8 * size, **flags))
    (rows, last), (graph_rows, graph_last) = results
    assert all(close(a, b, device) for a, b in zip(without_clock(rows), without_clock(graph_rows), strict=True))
    assert close(last["agent"], graph_last["agent"], device)


@pytest.mark.slow
@pytest.mark.parametrize("script", [ppo])
def test_compiled_is_near(train, script, monkeypatch):
    """The compiled network is near the original in every minibatch. It draws the noise of actions from another
    generator, so the runs differ."""
    update, compared = script.update_minibatch, []

    def compare(agent, optimizer, args, obs, actions, **others):
        for x, y in zip(
            agent.get_action_and_value(obs, actions), type(agent).get_action_and_value(agent, obs, actions)
        ):
            compared.append(torch.testing.assert_close(x, y, rtol=1e-4, atol=1e-4))
        return update(agent, optimizer, args, obs=obs, actions=actions, **others)

    monkeypatch.setattr(script, "update_minibatch", compare)
    rows, *_ = train(total_timesteps=640, compile=True, cudagraphs=False)
    assert len(compared) == 4 * 2 * 4 * 4 and all(row.get("approx_kl", 0) < 0.1 for row in rows)


def capture(script, function):
    return script.CudaGraph(function, SMALL, torch.device("cuda"))


@pytest.mark.gpu
def test_functions_are_captured_at_the_fourth_call(script, capsys):
    calls = []
    launch = capture(script, lambda: calls.append(0))
    for _ in range(6):
        launch()
    assert len(calls) == 4 and not capsys.readouterr().out


@pytest.mark.gpu
def test_an_observation_lies_where_the_graph_finds_it(script):
    """Every call copies the observation to the same place. The function itself is not called after the capture."""
    seen = []

    def double(obs):
        seen.append(obs)
        return 2 * (obs["state"] if isinstance(obs, dict) else obs)

    for names in (None, ("state", "rgb")):
        seen.clear()
        launch = capture(script, double)
        for call in range(6):
            state = torch.full((2, 3), float(call), device="cuda")
            result = launch({name: state.clone() for name in names} if names else state.clone())
            for value in seen[0].values() if names else seen:
                assert torch.equal(value, state) and value.data_ptr() != state.data_ptr()
            assert torch.equal(result, 2 * state)
        assert len(seen) == 4 and all(x is seen[0] for x in seen)


CANNOT_BE_CAPTURED = """
import torch, {script} as script
def looks():
    torch.randn(1, device="cuda").item()
launch = script.CudaGraph(looks, script.Args(), torch.device("cuda"))
for _ in range(6):
    launch()
"""


@pytest.mark.gpu
def test_what_cannot_be_captured_ends_the_run_in_one_line(script):
    """The line names the function, the reason and the flag that helps. A failed capture breaks CUDA in its process."""
    code = CANNOT_BE_CAPTURED.format(script=script.__name__)
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    message = "RunError: looks cannot be a CUDA graph, --no-cudagraphs does without: "
    assert process.returncode == 1 and message in process.stderr


class Guard:
    """While `on`, the host must not read a number from a tensor."""

    LOOKS = ("item", "tolist", "__bool__", "__int__", "__float__", "__index__", "cpu", "numpy", "nonzero")

    def __init__(self, monkeypatch, device):
        self.on, self.cuda, self.count = False, device.type == "cuda", 0
        for name in self.LOOKS:
            monkeypatch.setattr(torch.Tensor, name, self.guarded(name, getattr(torch.Tensor, name)))

    def guarded(self, name, method):
        def look(*args, **kwargs):
            assert not self.on, f"the host reads a number: {name}"
            self.count += 1
            return method(*args, **kwargs)

        return look

    def set(self, on):
        self.on = on
        if self.cuda:
            torch.cuda.set_sync_debug_mode("error" if on else "default")


def test_the_host_looks_at_nothing_in_rollout_and_update(train, script, device, monkeypatch):
    """The host reads no number from the first step of the policy to the end of the rollout, or in an epoch of the
    update. The environments' step is an exception: ManiSkillVectorEnv asks whether an episode ended. Between rollouts
    and epochs the host may read numbers."""
    guard = Guard(monkeypatch, device)
    step, rollout = script.ManiSkillVectorEnv.step, script.rollout
    guarded_calls = []

    def unguarded_step(self, actions):
        was_on = guard.on  # off in evaluations
        guard.set(False)
        try:
            return step(self, actions)
        finally:
            guard.set(was_on)

    def guarded_rollout(*arguments):
        try:
            return rollout(*arguments)
        finally:
            assert guard.on
            guard.set(False)

    class Guarded:
        def __init__(self, function, args, device):
            self.function = function

        def __call__(self, *obs):
            guard.set(True)
            try:
                return self.function(*obs)
            finally:
                guard.set(self.function.__name__ == "get_action_and_value")  # the rollout goes on
                guarded_calls.append(self.function.__name__)

        def close(self):
            pass

    monkeypatch.setattr(script.ManiSkillVectorEnv, "step", unguarded_step)
    monkeypatch.setattr(script, "rollout", guarded_rollout)
    monkeypatch.setattr(script, "CudaGraph", Guarded)
    train(norm_obs=True)
    assert guarded_calls.count("get_action_and_value") == 40
    assert guarded_calls.count("update_epoch") >= 4 and guard.count > 0
