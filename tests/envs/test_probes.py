"""The values that probes claim, against their own transitions; and that the mistakes they are made for do show."""

import functools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import env_spec
from rewardtogo.envs import probes
from rewardtogo.envs.vectorize import vectorize

PASSIVE = [
    probes.OneStep(),
    probes.ObservedReward(),
    probes.DelayedReward(),
    probes.DelayedReward(4),
    probes.TruncatedLoop(),
    probes.TruncatedLoop(10, terminates=True),
    probes.TruncatedCycle(),
    probes.TruncatedCycle(5),
    probes.CountingEnv(),
]
CHOOSING = [probes.ActionReward(), probes.MatchingReward()]
EVERY = [*PASSIVE, *CHOOSING, probes.QuadraticReward(), probes.RecallProbe(), probes.RecallProbe(1, 3)]
name = lambda probe: repr(probe).replace(" ", "")  # noqa: E731


@functools.cache
def roll(probe, length=40, size=4):
    """Observations before each of `length` random actions in `size` copies, those actions, and the timesteps; flat."""
    env = vectorize(probe, size)

    @jax.jit
    def run(key):
        reset_key, action_key, step_key = jax.random.split(key, 3)
        state, first = env.reset(jax.random.split(reset_key, size))
        actions = jax.vmap(jax.vmap(env_spec(env).action.sample))(jax.random.split(action_key, (length, size)))
        xs = (actions, jax.random.split(step_key, (length, size)))
        _, steps = jax.lax.scan(lambda s, x: env.step(s, *x), state, xs)
        return jnp.concatenate([first[None], steps.observation[:-1]]), actions, steps, steps.done

    flat = lambda x: np.asarray(x).reshape(-1, *x.shape[2:])  # noqa: E731
    before, actions, steps, done = run(jax.random.key(0))
    names = ("observation", "reward", "terminated", "truncated", "final_observation")
    columns = {name: flat(getattr(steps, name)) for name in names}
    return flat(before), flat(actions), SimpleNamespace(**columns, done=flat(done))


def index(probe, observations):
    """Where each observation is in the probe's list, the final ones of terminated episodes aside."""
    gaps = np.abs(np.asarray(probe.observations())[None] - observations[:, None]).max(axis=-1)
    return gaps.argmin(axis=1), gaps.min(axis=1) < 1e-6


@pytest.mark.parametrize("probe", PASSIVE, ids=name)
@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.99])
def test_values_obey_the_bellman_equation(probe, gamma):
    before, _, steps = roll(probe)
    here, known = index(probe, before)
    there, known_next = index(probe, steps.final_observation)
    assert known.all() and np.all(known_next | steps.terminated)
    assert set(here) == set(range(len(probe.observations())))
    values = probe.values(gamma)
    target = steps.reward + gamma * (1 - steps.terminated) * values[there]
    np.testing.assert_allclose(values[here], target, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("probe", CHOOSING, ids=name)
def test_values_of_actions(probe):
    before, actions, steps = roll(probe)
    here, known = index(probe, before)
    assert known.all() and steps.terminated.all()
    np.testing.assert_array_equal(probe.q_values(0.9)[here, actions], steps.reward)
    np.testing.assert_array_equal(probe.q_values(0.9).max(axis=1), probe.values(0.9))
    assert set(zip(here, actions, strict=True)) == {(i, a) for i in range(len(probe.observations())) for a in range(2)}


@pytest.mark.parametrize("probe", EVERY, ids=name)
def test_value_of_an_episode(probe):
    keys = jax.random.split(jax.random.key(1), 2000)
    first = np.asarray(jax.jit(jax.vmap(lambda key: probe.reset(key)[1]))(keys))
    here, known = index(probe, first)
    assert known.all()
    assert abs(probe.values(0.9)[here].mean() - probe.value(0.9)) <= 4 / np.sqrt(2000)


@pytest.mark.parametrize("probe", EVERY, ids=name)
def test_spaces_and_states(probe):
    before, _, steps = roll(probe)
    assert all(probe.observation_space.contains(o) for o in (*before, *steps.final_observation))
    assert before.dtype == steps.reward.dtype == np.float32
    assert all(eqx.is_array(leaf) for leaf in jax.tree.leaves(probe.reset(jax.random.key(0))))


def test_terminal_mask():
    before, _, steps = roll(probes.OneStep())
    assert steps.terminated.all() and probes.OneStep().value(0.99) == 1.0
    # What is seen at the end is what was seen at the start: without a mask the fixed point is 1/(1 - gamma).
    np.testing.assert_array_equal(before, steps.final_observation)


def test_truncated_loop_has_the_values_of_the_erratum():
    assert abs(probes.TruncatedLoop(10).value(0.99) - 100) < 1e-9
    assert abs(probes.TruncatedLoop(10, terminates=True).value(0.99) - sum(0.99**t for t in range(10))) < 1e-12
    _, _, steps = roll(probes.TruncatedLoop(10), size=1)
    np.testing.assert_array_equal(np.flatnonzero(steps.truncated), [9, 19, 29, 39])
    assert not steps.terminated.any()


def fixed_point(probe, gamma, following, discount):
    """The tabular values that satisfy the mean of v(o) = r + discount v(o') over the sampled transitions."""
    before, _, steps = roll(probe, length=90, size=1)
    here = np.eye(len(probe.observations()))[index(probe, before)[0]]
    there = np.eye(len(probe.observations()))[index(probe, following(steps))[0]]
    return np.linalg.solve(here.T @ (here - discount(steps, gamma)[:, None] * there), here.T @ steps.reward)


def test_truncated_cycle_tells_right_from_wrong():
    probe, gamma = probes.TruncatedCycle(3), 0.9
    right = fixed_point(probe, gamma, lambda s: s.final_observation, lambda s, g: g * (1 - s.terminated))
    np.testing.assert_allclose(right, probe.values(gamma), rtol=1e-5)
    from_reset = fixed_point(probe, gamma, lambda s: s.observation, lambda s, g: g * (1 - s.terminated))
    as_end = fixed_point(probe, gamma, lambda s: s.final_observation, lambda s, g: g * (1 - s.done))
    for wrong in (from_reset, as_end):
        assert np.abs(wrong - right).max() > 0.1 * right.max()


@pytest.mark.parametrize(("delay", "cues"), [(1, 2), (3, 2), (2, 3)])
def test_recall(delay, cues):
    probe, size = probes.RecallProbe(delay, cues), 3000

    def episode(key, answer):
        state, observation = probe.reset(key)
        seen, total, asked = [observation], 0.0, []
        for t in range(delay + 1):
            action = answer(seen, t)
            state, step = probe.step(state, action, key)
            total += 0.9**t * step.reward
            seen.append(step.observation)
            asked.append(step.terminated)
        return total, jnp.stack(seen), jnp.stack(asked)

    keys = jax.random.split(jax.random.key(2), size)
    recall = lambda seen, t: jnp.argmax(seen[0][:-1]).astype(jnp.int32)  # noqa: E731
    total, seen, ended = jax.jit(jax.vmap(lambda key: episode(key, recall)))(keys)
    np.testing.assert_allclose(total, probe.value(0.9), rtol=1e-6)
    assert np.all(ended[:, -1]) and not np.any(ended[:, :-1])
    # The cue is shown once, and the question once, at the end.
    assert np.all(np.asarray(seen)[:, 0, :-1].sum(axis=-1) == 1) and not np.asarray(seen)[:, 1:, :-1].any()
    np.testing.assert_array_equal(np.asarray(seen)[:, :, -1], np.tile(np.eye(delay + 2)[delay], (size, 1)))
    # When asked, all episodes look the same: a memoryless policy is a fixed answer, and each is right once in `cues`.
    fixed = jax.jit(jax.vmap(lambda key, answer: episode(key, lambda seen, t: answer)[0], in_axes=(0, None)))
    for answer in range(cues):
        mean = float(np.mean(fixed(keys, jnp.asarray(answer, jnp.int32))))
        assert abs(mean - probe.memoryless_value(0.9)) <= 4 * 0.9**delay * 0.5 / np.sqrt(size)
    assert probe.memoryless_value(0.9) == pytest.approx(probe.value(0.9) / cues)


def test_quadratic_reward():
    probe = probes.QuadraticReward()
    _, actions, steps = roll(probe)
    np.testing.assert_allclose(steps.reward, -((actions[:, 0] - 0.5) ** 2), atol=1e-6)
    assert steps.terminated.all() and steps.reward.max() <= probe.value(0.9)
    noise = np.random.default_rng(0).normal(0.2, 0.3, 200_000)
    assert probe.gaussian_value(0.2, 0.3) == pytest.approx(-np.mean((noise - 0.5) ** 2), rel=0.02)


def test_refusals():
    for wrong in (
        lambda: probes.DelayedReward(0),
        lambda: probes.TruncatedLoop(0),
        lambda: probes.TruncatedCycle(-1),
        lambda: probes.RecallProbe(0),
        lambda: probes.RecallProbe(3, 1),
        lambda: probes.CountingEnv(0),
    ):
        with pytest.raises(ValueError, match="must be at least"):
            wrong()
    with pytest.raises(ValueError, match="must be odd, not 4"):
        probes.TruncatedCycle(4)
