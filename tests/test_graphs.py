"""Functions that the scripts launch as CUDA graphs give the same results as step by step, and do not make the host read
a number: on the GPU that pretended_gpu.py pretends, and on a real one."""

import dataclasses
import math
import subprocess
import sys
from collections import Counter
from functools import partial
from typing import Optional

import pytest
import test_rgb
import torch
import torch.nn as nn
from conftest import ROOT, SMALL, on_cpu_and_cuda, on_gpus, without_clock
from pretended_gpu import GpuTensor, PretendedGpu
from torch.distributions import Normal
from torch.nn.functional import one_hot

import ppo
import ppo_rgb


@pytest.fixture(params=[ppo, ppo_rgb], ids=["ppo", "ppo_rgb"])
def script(request):
    return request.param


@pytest.fixture
def small(script):
    return SMALL if script is ppo else test_rgb.SMALL_IMAGES


def close(a, b):
    """Equal on the pretended GPU, near on a real one."""
    is_exact = isinstance(torch.zeros(0, device="cuda"), GpuTensor)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        return all(close(a[k], b[k]) for k in a)
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b) if is_exact else torch.allclose(a, b, rtol=1e-3, atol=1e-5)
    return a == b or not is_exact and math.isclose(a, b, rel_tol=1e-2, abs_tol=1e-3)


FLAGS = [
    dict(anneal_lr=True, norm_obs=True, target_kl=0.003, update_epochs=8),
    dict(clip_vloss=True, finite_horizon_gae=True, bootstrap_at_done="truncated", norm_adv=False, num_minibatches=7),
    # a graph freezes Python numbers: this case finds one that you compute from a flag and change between iterations
    {f.name: 0.9 * (f.default or 0.1) for f in dataclasses.fields(ppo.Args) if f.type in (float, Optional[float])},
]


@on_gpus
@pytest.mark.parametrize("flags", FLAGS, ids=["kl-stop", "others", "every-float"])
def test_equals_step_by_step(train, script, small, flags):
    flags = flags | dict(eval_freq=0, total_timesteps=3 * small.num_envs * small.num_steps)
    if script is ppo_rgb:
        flags = flags | dict(random_shift=2, obs_mode="rgb+depth+segmentation", update_epochs=2)
    (rows, last), (graph_rows, graph_last) = train(cudagraphs=False, **flags), train(cudagraphs=True, **flags)
    assert all(close(a, b) for a, b in zip(without_clock(rows), without_clock(graph_rows), strict=True))
    assert close(last["agent"], graph_last["agent"])


@on_gpus
def test_equals_step_by_step_after_a_resume(train, small):
    """A resumed run loads the optimizer's tensors before it captures anything."""
    size, results = small.num_envs * small.num_steps, []
    for i, cudagraphs in enumerate((False, True)):
        flags = dict(eval_freq=0, anneal_lr=True, cudagraphs=cudagraphs)
        train(total_timesteps=size, **flags)
        results.append(train(resume=f"runs/run{i + 1}", total_timesteps=3 * size, **flags))
    (rows, last), (graph_rows, graph_last) = results
    assert all(close(a, b) for a, b in zip(without_clock(rows), without_clock(graph_rows), strict=True))
    assert close(last["agent"], graph_last["agent"])


@pytest.mark.slow
@on_cpu_and_cuda
@pytest.mark.parametrize("script", [ppo])
def test_compiled_is_near(train, script, device, monkeypatch):
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


@on_gpus
def test_functions_are_captured_at_the_fourth_call(script, device, capsys):
    calls = []
    launch = capture(script, lambda: calls.append(0))
    for _ in range(6):
        launch()
    assert len(calls) == 4 and not capsys.readouterr().out


@on_gpus
def test_an_observation_lies_where_the_graph_finds_it(script, device):
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


@on_gpus
@pytest.mark.parametrize("script", [ppo])
def test_full_memory_ends_the_run_in_one_line(script, device, in_tmp, monkeypatch, capsys):
    """The line says what to reduce, also if the memory is full during a capture."""

    def fill():
        if launch.num_calls == 4:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")

    launch = capture(script, fill)

    def train(args, closing):
        (in_tmp / "runs/x").mkdir(parents=True)
        (in_tmp / "runs/x/metrics.jsonl").touch()
        for _ in range(4):
            launch()

    monkeypatch.setattr(script, "train", train)
    assert script.main(["--no-cuda", "--exp_name", "x", "--num_envs", "2", "--num_actors", "1"]) == 1
    message = "the GPU's memory is full: try fewer --num_envs or more --num_minibatches"
    assert capsys.readouterr().err == f"{script.SCRIPT.name}: {message}\n"


@on_gpus
def test_learning_rates_lie_where_a_graph_reads_them(script, small, device):
    """A graph would freeze a number on the CPU. Nothing else would find that, because CUDA accepts it."""
    agent = nn.ModuleDict(dict(actor=nn.Linear(1, 1), critic=nn.Linear(1, 1)))
    agent.actor_logstd = nn.Parameter(torch.zeros(1))
    optimizer = script.make_optimizer(agent.to(device), small, device)
    assert all(group["lr"].is_cuda for group in optimizer.param_groups)


@on_gpus
def test_the_host_waits_for_nothing_in_rollout_and_update(train, script, device, monkeypatch):
    """The host reads no number from the first step of the policy to the end of the rollout, or in an epoch of the
    update. The environments' step is an exception: ManiSkillVectorEnv asks whether an episode ended. Between rollouts
    and epochs the host may read numbers."""
    mode, calls = torch.cuda.set_sync_debug_mode, Counter()

    def with_mode(name, function, after):
        def run(*arguments):
            mode("default" if name == "step" else "error")
            calls[name] += 1
            try:
                return function(*arguments)
            finally:
                mode(after)

        return run

    def no_waits(function, args, device):
        is_epoch = function.__name__ == "update_epoch"
        function = with_mode(function.__name__, function, "default" if is_epoch else "error")  # the rollout goes on
        function.close = lambda: None
        return function

    rollout, step = script.rollout, script.ManiSkillVectorEnv.step

    def guarded_rollout(agent, envs, *arguments):
        monkeypatch.setattr(envs, "step", with_mode("step", partial(step, envs), "error"))
        return with_mode("rollout", rollout, "default")(agent, envs, *arguments)

    monkeypatch.setattr(script, "rollout", guarded_rollout)
    monkeypatch.setattr(script, "CudaGraph", no_waits)
    train(norm_obs=True)
    assert calls.pop("update_epoch") >= 4 and calls.pop("get_value") > 4, "at the end of a rollout, and of episodes"
    assert calls == dict(rollout=4, step=40, get_action_and_value=40)
    mode("error")
    with pytest.raises(RuntimeError):
        torch.ones(1, device=device).item()
    mode("default")


@pytest.mark.slow
@pytest.mark.parametrize("device", ["pretended"], indirect=True)
def test_how_often_the_host_waits(train, script, small, device, monkeypatch):
    """An iteration waits as often, whatever its number of steps and minibatches. target_kl waits once an epoch."""
    rollout, step, starts = script.rollout, script.ManiSkillVectorEnv.step, []

    def counted_rollout(*arguments):
        starts.append(len(PretendedGpu.waits))
        return rollout(*arguments)

    def step_without_counting(envs, actions):  # ManiSkill's own waits
        waits = len(PretendedGpu.waits)
        result = step(envs, actions)
        del PretendedGpu.waits[waits:]
        return result

    monkeypatch.setattr(script, "rollout", counted_rollout)
    monkeypatch.setattr(script.ManiSkillVectorEnv, "step", step_without_counting)
    an_iteration = []
    for num_steps, num_minibatches, target_kl in ((4, 2, None), (8, 4, None), (4, 2, 1e9)):
        flags = dict(num_steps=num_steps, num_minibatches=num_minibatches, target_kl=target_kl, update_epochs=3)
        train(total_timesteps=3 * small.num_envs * num_steps, eval_freq=0, **flags)
        an_iteration.append(Counter(PretendedGpu.waits[starts[-2] : starts[-1]]))
    assert an_iteration[0] == an_iteration[1]
    assert (an_iteration[2] - an_iteration[0]) == Counter(__bool__=3)
    assert an_iteration[0] == Counter(item=2, tolist=3, __bool__=1, synchronize=1)


def put_on_cpu(name):
    """A fault: this tensor of the agent stays on the CPU."""

    def plant(script, monkeypatch):
        to = script.Agent.to

        def move(agent, device):
            agent = to(agent, device)
            setattr(agent, name, getattr(agent, name).cpu())
            return agent

        monkeypatch.setattr(script.Agent, "to", move)

    return plant


def after(name, fault, of_agent=False):
    """A fault in what a function of the script, or a method of the agent, returns."""

    def plant(script, monkeypatch):
        owner = script.Agent if of_agent else script
        function = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *args, **kwargs: fault(function(*args, **kwargs)))

    return plant


OTHER_DEVICE, WAITS = "Expected all tensors to be on the same device", "cannot be a CUDA graph"
FAULTS = {
    "statistics": (put_on_cpu("obs_mean"), OTHER_DEVICE),
    "bounds": (put_on_cpu("action_low"), OTHER_DEVICE),
    "advantages": (after("compute_gae", lambda x: (x[0] + torch.zeros(x[0].shape), x[1])), OTHER_DEVICE),
    "loss": (after("update_minibatch", lambda x: x * torch.ones(6)), OTHER_DEVICE),
    "noise": (after("clip_action", lambda x: x + 0.1 * torch.randn(x.shape), of_agent=True), OTHER_DEVICE),
    "detour": (after("update_minibatch", lambda x: x.cpu().to(x.device)), WAITS),
    "number": (after("update_minibatch", lambda x: x * x[0].item()), WAITS),
    "within a function of torch": (after("update_minibatch", lambda x: x * one_hot(x.long().clamp(0, 5)).sum()), WAITS),
    "branch": (after("update_minibatch", lambda x: x if x[0] > 0 else -x), WAITS),
    "mask": (after("update_minibatch", lambda x: x[x < 1e9]), WAITS),
    "constant": (after("update_minibatch", lambda x: x * torch.tensor([1.0] * 6, device=x.device)), WAITS),
    "check of arguments": (after("update_minibatch", lambda x: Normal(x, x.exp(), validate_args=True).mean), WAITS),
}


@pytest.mark.parametrize("device", ["pretended"], indirect=True)
@pytest.mark.parametrize("plant, message", FAULTS.values(), ids=FAULTS)
@pytest.mark.parametrize("script", [ppo])
def test_planted_faults_are_found(train, device, script, monkeypatch, plant, message):
    plant(script, monkeypatch)
    with pytest.raises(RuntimeError, match=message):
        train(cudagraphs=True, norm_obs=True)
