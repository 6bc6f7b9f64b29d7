"""The gradient step follows PPO's loss and Adam's rule, computed independently in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import box

import ppo

OBS, ACT, ROWS = 5, 3, 40


def make(**flags):
    torch.manual_seed(0)
    flags = dict(desired_kl=None, norm_obs=False) | flags
    args = ppo.Args(learning_rate=1e-2, **flags)
    agent = ppo.Agent(box(OBS), box(ACT), args).double()
    with torch.no_grad():
        agent.actor_mean[-1].weight *= 50  # far from the initial, nearly constant policy
        agent.actor_logstd += 0.1 * torch.randn(1, ACT)
    batch = dict(
        obs=torch.randn(ROWS, OBS).double(),
        actions=torch.randn(ROWS, ACT).double(),
        advantages=torch.randn(ROWS).double() * 2 + 1,
        returns=torch.randn(ROWS).double(),
        values=torch.randn(ROWS).double(),
    )
    with torch.no_grad():
        old = agent.get_action_and_value(batch["obs"], batch["actions"])[1]
    batch["logprobs"] = old + 0.3 * torch.randn(ROWS).double()  # ratios on both sides of the clipping range
    return args, agent, batch


def reference_loss(args, agent, b):
    """Computes the loss and the metrics from the parameters, without the agent's own methods."""

    def mlp(layers, x):
        for layer in layers:
            if isinstance(layer, torch.nn.Linear):
                x = x @ layer.weight.T + layer.bias
            elif isinstance(layer, torch.nn.LayerNorm):
                x = x - x.mean(1, keepdim=True)
                x = x / ((x**2).mean(1, keepdim=True) + 1e-5).sqrt() * layer.weight + layer.bias
            elif isinstance(layer, torch.nn.Tanh):
                x = torch.tanh(x)
        return x

    x = b["obs"]
    if args.norm_obs:
        x = ((x - agent.obs_mean) / (agent.obs_var + 1e-5).sqrt()).clamp(-10, 10)
    actor, critic = agent.actor_mean, agent.critic
    mean = mlp(actor[0], x) @ actor[1].weight.T + actor[1].bias
    value = (mlp(critic[0], x) @ critic[1].weight.T + critic[1].bias)[:, 0]
    std = agent.actor_logstd.exp()
    logprob = (-0.5 * ((b["actions"] - mean) / std) ** 2 - agent.actor_logstd - 0.5 * np.log(2 * np.pi)).sum(1)
    ratio = (logprob - b["logprobs"]).exp()
    adv = b["advantages"]
    if args.norm_adv:
        adv = (adv - adv.mean()) / (((adv - adv.mean()) ** 2).mean().sqrt() + 1e-8)
    eps = args.clip_coef
    surrogate = torch.minimum(ratio * adv, ratio.clamp(1 - eps, 1 + eps) * adv).mean()
    error = (value - b["returns"]) ** 2
    if args.clip_vloss:
        clipped = b["values"] + (value - b["values"]).clamp(-eps, eps)
        error = torch.maximum(error, (clipped - b["returns"]) ** 2)
    entropy = (agent.actor_logstd + 0.5 * np.log(2 * np.pi * np.e)).sum()
    metrics = dict(
        policy_loss=-surrogate,
        value_loss=0.5 * error.mean(),
        entropy=entropy,
        approx_kl=(ratio - 1 - ratio.log()).mean(),
        clipfrac=((ratio - 1).abs() > eps).double().mean(),
    )
    return metrics["policy_loss"] - args.ent_coef * entropy + args.vf_coef * metrics["value_loss"], metrics


@pytest.mark.parametrize(
    "flags",
    [
        {},
        dict(norm_adv=False, ent_coef=0.05),
        dict(clip_vloss=True, vf_coef=2.0, clip_coef=0.1),
        dict(max_grad_norm=0.01),
        dict(norm_obs=True, layer_norm=True),
    ],
)
def test_one_step(flags):
    args, agent, batch = make(**flags)
    agent.update_normalization(batch["obs"])
    loss, expected = reference_loss(args, agent, batch)
    parameters = list(agent.parameters())
    gradients = torch.autograd.grad(loss, parameters)
    norm = torch.sqrt(sum((g**2).sum() for g in gradients))
    scale = min(1.0, args.max_grad_norm / (norm.item() + 1e-6))
    # Adam's first step: the bias-corrected moments are g and g^2
    wanted = [p.detach() - 1e-2 * g * scale / ((g * scale).abs() + 1e-5) for p, g in zip(parameters, gradients)]

    optimizer = ppo.make_optimizer(agent, replace(args, logstd_lr_factor=1.0), torch.device("cpu"))
    metrics = ppo.update_minibatch(agent, optimizer, args, **batch)

    for p, w in zip(parameters, wanted):
        torch.testing.assert_close(p.detach(), w, rtol=1e-6, atol=1e-9)
    metrics = dict(zip(ppo.UPDATE_METRICS, metrics.tolist()))
    assert metrics.pop("grad_norm") == pytest.approx(norm.item())
    assert metrics == pytest.approx({k: v.item() for k, v in expected.items()})
    assert 0 < metrics["clipfrac"] < 1, "the case must exercise the clipping"


def test_minibatch_of_one_row_stays_finite():
    args, agent, batch = make()
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-2)
    metrics = ppo.update_minibatch(agent, optimizer, args, **{k: v[:1] for k, v in batch.items()})
    assert metrics.isfinite().all() and all(p.isfinite().all() for p in agent.parameters())


def test_running_normalization_equals_statistics_of_all_data():
    _, agent, _ = make(norm_obs=True)
    data = torch.randn(300, OBS).double() * torch.tensor([0.1, 1, 10, 100, 0]) + torch.arange(OBS)
    for part in data.split([10, 200, 90]):
        agent.update_normalization(part)
    torch.testing.assert_close(agent.obs_mean, data.mean(0), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(agent.obs_var, data.var(0, correction=0), rtol=1e-3, atol=1e-3)


def test_initial_policy_is_nearly_zero_and_deterministic_action_is_its_mean():
    torch.manual_seed(0)
    agent = ppo.Agent(box(OBS), box(ACT), ppo.Args())
    obs = torch.randn(64, OBS)
    assert agent.get_action(obs).abs().max() < 0.1
    torch.manual_seed(0)
    samples = torch.stack([agent.get_action_and_value(obs)[0] for _ in range(2000)])
    torch.testing.assert_close(samples.mean(0), agent.get_action(obs), atol=0.08, rtol=0)
    assert agent.get_value(obs).shape == (64,)
