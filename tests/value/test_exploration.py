"""Noise on actions: the two processes against their exact moments, and what a policy does with them."""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import EnvSpec, from_space
from rewardtogo.ops import Linear

KEY = jax.random.key(0)
BOX = from_space(spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32)))
SPEC = EnvSpec(from_space(spaces.Box(-1, 1, (3,), np.float32)), BOX)


def paths(noise: rtg.OU | rtg.Gaussian, chains: int, steps: int) -> np.ndarray:
    """`[steps, chains]`, from the state at the start of an episode."""
    keys = jax.random.split(KEY, (steps,))

    def run(keys: jax.Array) -> jax.Array:
        step = lambda state, key: noise(state, (chains,), key)  # noqa: E731
        return jax.lax.scan(step, noise.init((chains,)), keys)[1]

    return np.asarray(jit(run)(keys), np.float64)


def test_ornstein_uhlenbeck_has_its_exact_sd_and_correlation(item):
    x = paths(rtg.OU(sigma=0.2, theta=0.15, dt=1.0), 2000, 1200)[200:]
    exact = 0.2 / np.sqrt(1 - 0.85**2)
    with item("6.26") as check:
        check(abs(exact - 0.3797), "<=", 5e-5, "the formula at 0.15, 0.2, 1, against the number in the list")
        check(
            abs(x.std() / exact - 1),
            "<=",
            0.01,
            "standard deviation, relative to sigma sqrt(dt) / sqrt(1 - (1 - theta dt)^2)",
        )
        for lag in (1, 5):
            found = (x[lag:] * x[:-lag]).mean() / (x * x).mean()
            check(abs(found - 0.85**lag), "<=", 0.01, f"autocorrelation at lag {lag}, (1 - theta dt)^{lag}")
        # Sigma is not the standard deviation, as one may think.
        check(abs(x.std() / 0.2 - 1), ">", 0.5, "sigma taken for the standard deviation: relative error")


def test_smaller_steps_of_time_and_the_formula():
    noise = rtg.OU(sigma=0.5, theta=2.0, dt=0.25)
    x = paths(noise, 2000, 400)[50:]
    np.testing.assert_allclose(x.std(), noise.stationary_sd(), rtol=0.01)
    np.testing.assert_allclose((x[1:] * x[:-1]).mean() / (x * x).mean(), 0.5, atol=0.01)


def test_gaussian_noise_has_its_sd_and_no_correlation(item):
    x = paths(rtg.Gaussian(0.3), 1000, 400)
    with item("6.26") as check:
        check(abs(x.std() / 0.3 - 1), "<=", 0.01, "Gaussian: standard deviation, relative")
        check(abs((x[1:] * x[:-1]).mean() / (x * x).mean()), "<=", 0.01, "Gaussian: autocorrelation at lag 1")


def act(learner: rtg.DDPG, number: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Many first actions of the explorer at one observation, and the greedy one."""
    state = learner.init(SPEC, KEY)

    def actions(keys: jax.Array) -> tuple[jax.Array, jax.Array]:
        explorer, greedy = learner.policy(state, explore=True), learner.policy(state, explore=False)
        one = lambda policy, key: policy(policy.init(key), jnp.ones(3), key)[1]  # noqa: E731
        return jax.vmap(lambda k: one(explorer, k))(keys), one(greedy, KEY)

    return jax.device_get(jit(actions)(jax.random.split(KEY, number)))


def test_noise_is_in_units_of_half_the_box_and_stays_inside():
    explored, greedy = act(rtg.DDPG(network=rtg.MLP(4), noise=rtg.Gaussian(0.1)))
    np.testing.assert_allclose(explored.std(0), [0.2, 0.5], rtol=0.1)
    np.testing.assert_allclose(explored.mean(0), greedy, atol=0.05)
    wild, _ = act(rtg.DDPG(network=rtg.MLP(4), noise=rtg.Gaussian(5.0)))
    assert wild.min(0).tolist() == [-2.0, 0.0]
    assert wild.max(0).tolist() == [2.0, 10.0]


def test_no_noise_is_the_greedy_policy():
    for noise in (rtg.Gaussian(0.0), rtg.OU(sigma=0.0)):
        explored, greedy = act(rtg.DDPG(network=rtg.MLP(4), noise=noise), 3)
        np.testing.assert_array_equal(explored, np.broadcast_to(greedy, explored.shape))


def test_noise_may_be_scheduled():
    learner = rtg.DDPG(network=rtg.MLP(4), noise=rtg.Gaussian(Linear(0.4, 0.1)))
    loop = rtg.OffPolicy(rtg.make("Pendulum-v1", 1), learner, updates=2, unroll=1).with_horizon(50)
    state = loop.learner.init(SPEC, KEY)
    for updates, sd in ((0, 0.4), (50, 0.25), (100, 0.1), (999, 0.1)):
        at = eqx.tree_at(lambda s: s.updates, state, jnp.asarray(updates, jnp.int32))
        policy = loop.learner.policy(at, explore=True)
        assert float(policy.noise.sd) == pytest.approx(sd, rel=1e-5)  # type: ignore[attr-defined]


def test_noise_that_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match=r"Gaussian.sd must be in \[0, inf\), not -0.1"):
        rtg.Gaussian(-0.1)
    with pytest.raises(ValueError, match="grows without end: give them a product below 2"):
        rtg.OU(theta=4.0, dt=0.5)
    with pytest.raises(ValueError, match=r"OU.theta must be in \(0, inf\)"):
        rtg.OU(theta=0.0)
