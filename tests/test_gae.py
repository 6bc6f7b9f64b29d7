"""compute_gae equals its definitions, written out as sums in float64."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import ppo


@st.composite
def rollouts(draw):
    num_steps, num_envs = draw(st.integers(1, 8)), draw(st.integers(1, 3))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    random = lambda: torch.randn(num_steps, num_envs, generator=generator, dtype=torch.float64)
    flags = lambda p: torch.rand(num_steps, num_envs, generator=generator) < p
    terminated, truncated = [flags(draw(st.sampled_from([0.0, 0.3, 1.0]))) for _ in range(2)]
    values, final_values = random(), random()
    # within an episode the next observation is the one that the next step starts from
    following = torch.cat([values[1:], final_values[-1:]])
    true_next_values = torch.where(terminated | truncated, final_values, following)
    return dict(
        rewards=random(),
        values=values,
        true_next_values=true_next_values,
        terminated=terminated,
        truncated=truncated,
    )


def n_step_advantages(rewards, values, next_values, dones, gamma, t):
    """A^(1), A^(2), ... from step t of one environment, up to the end of its episode or of the rollout."""
    advantages, discounted = [], 0.0
    for k in range(t, len(rewards)):
        discounted += gamma ** (k - t) * rewards[k]
        advantages.append(discounted + gamma ** (k - t + 1) * next_values[k] - values[t])
        if dones[k]:
            break
    return advantages


def brute_force(rewards, values, next_values, dones, gamma, lam, finite_horizon):
    result = torch.zeros_like(rewards)
    for env in range(rewards.shape[1]):
        columns = [x[:, env].tolist() for x in (rewards, values, next_values, dones)]
        for t in range(len(rewards)):
            terms = n_step_advantages(*columns, gamma, t)
            weights = [lam**n for n in range(len(terms))]
            if finite_horizon:
                weights = [w / sum(weights) for w in weights]
            else:  # the infinite sum, where all n-step returns beyond the end are equal to the last that exists
                weights = [(1 - lam) * w for w in weights[:-1]] + weights[-1:]
            result[t, env] = sum(w * a for w, a in zip(weights, terms))
    return result


@settings(max_examples=300, deadline=None)
@given(
    rollouts(),
    st.sampled_from([0.0, 0.8, 0.99, 1.0]),
    st.sampled_from([0.0, 0.9, 1.0]),
    st.booleans(),
    st.sampled_from(["always", "truncated", "never"]),
)
def test_equals_definition(rollout, gamma, lam, finite_horizon, rule):
    terminated = rollout["terminated"]
    dones = terminated | rollout["truncated"]
    next_values = rollout["true_next_values"].clone()
    for index in dones.nonzero().tolist():  # as `rollout` does
        t, env = index
        counts = {"always": True, "never": False, "truncated": not terminated[t, env]}[rule]
        next_values[t, env] *= counts

    args = rollout["rewards"], rollout["values"], next_values, dones, gamma, lam, finite_horizon
    advantages, returns = ppo.compute_gae(*args)
    torch.testing.assert_close(advantages, brute_force(*args), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(returns, advantages + rollout["values"])


def test_float_dones_and_devices(device):
    """Boolean dones and float32 dones give the same result. The training loop stores them as float32 on its device."""
    x = torch.rand(5, 4, device=device)
    dones = torch.rand(5, 4, device=device) < 0.3
    for finite in (False, True):
        as_bool = ppo.compute_gae(x, x, x, dones, 0.9, 0.95, finite)
        as_float = ppo.compute_gae(x, x, x, dones.float(), 0.9, 0.95, finite)
        assert as_bool[0].device.type == device.type and as_bool[0].dtype == torch.float32
        assert all(torch.equal(a, b) for a, b in zip(as_bool, as_float))
