"""Wrappers: exact sequences across automatic resets, at termination and at truncation; spaces; rewards; refusals."""

from types import SimpleNamespace

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import Environment, Timestep, VectorEnv, env_spec
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.mountain_car import MountainCarContinuous
from rewardtogo.envs.pendulum import Pendulum
from rewardtogo.envs.probes import CountingEnv, QuadraticReward
from rewardtogo.envs.reward_wrappers import NormalizeReward, RewardFunction, ScaleReward, merge
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.envs.wrappers import (
    ClipAction,
    DelayObservation,
    FrameStack,
    MaskObservation,
    NoisyObservation,
    RescaleAction,
)


class Echo(Environment):
    """Pays the action it was given. Actions in a box that is not symmetric."""

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0, 1, (1,), np.float32)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(np.array([-1, 2], np.float32), np.array([3, 2.5], np.float32), dtype=np.float32)

    def reset(self, key):
        return jnp.zeros(1), jnp.zeros(1)

    def step(self, state, action, key):
        never = jnp.zeros((), bool)
        return state, Timestep(state, action @ jnp.asarray([1.0, 100.0]), never, never, state, {"given": action})


class Picture(Environment):
    """A 2 x 3 picture with one channel, filled with the number of steps taken."""

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0, 255, (2, 3, 1), np.uint8)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key):
        return jnp.zeros((), jnp.uint8), jnp.zeros((2, 3, 1), jnp.uint8)

    def step(self, state, action, key):
        state, never = state + jnp.uint8(1), jnp.zeros((), bool)
        picture = jnp.full((2, 3, 1), state, jnp.uint8)
        return state, Timestep(picture, jnp.ones(()), never, never, picture, {})


class SecondOrder(Environment):
    """A number from 0 to 4 that the two before it determine: x'' = (x' + 2 x + x' x) mod 5. Starts anywhere."""

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0, 4, (1,), np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key):
        state = jax.random.randint(key, (2,), 0, 5)
        return state, state[1:].astype(float)

    def step(self, state, action, key):
        state = jnp.stack([state[1], (state[1] + 2 * state[0] + state[1] * state[0]) % 5])
        seen, never = state[1:].astype(float), jnp.zeros((), bool)
        return state, Timestep(seen, jnp.ones(()), never, never, seen, {})


def roll(env: VectorEnv, length: int, actions=None, policy=lambda observation, action: action):
    """First observation, actions and `length` timesteps, as NumPy arrays `[length, size, ...]`. Random actions."""

    @jax.jit
    def run(env, key, actions):
        reset_key, action_key, step_key = jax.random.split(key, 3)
        state, first = env.reset(jax.random.split(reset_key, env.num_envs))
        if actions is None:
            action_keys = jax.random.split(action_key, (length, env.num_envs))
            actions = jax.vmap(jax.vmap(env_spec(env).action.sample))(action_keys)

        def step(loop, given):
            state, timestep = env.step(loop[0], policy(loop[1], given[0]), given[1])
            return (state, timestep.observation), timestep

        final, steps = jax.lax.scan(step, (state, first), (actions, jax.random.split(step_key, (length, env.num_envs))))
        return first, actions, final, steps, steps.done

    # The environment is an argument of the compiled program: each has only leaves that may be one.
    first, actions, final, steps, done = run(env, jax.random.key(0), actions)
    assert all(eqx.is_array(leaf) for leaf in jax.tree.leaves(final))
    names = ("observation", "reward", "terminated", "truncated", "final_observation", "extras")
    columns = {name: jax.tree.map(np.asarray, getattr(steps, name)) for name in names}
    return np.asarray(first), np.asarray(actions), SimpleNamespace(**columns, done=np.asarray(done))


def ending(how: str, wrap):
    """A counting environment of 3 steps, wrapped, that terminates, or is truncated inside or around the wrapper."""
    if how == "terminated":
        return wrap(CountingEnv(3))
    return wrap(TimeLimit(CountingEnv(9), 3)) if how == "truncated inside" else TimeLimit(wrap(CountingEnv(9)), 3)


HOW = ["terminated", "truncated inside", "truncated outside"]


def check_sequence(env, how, first, seen, final):
    """Two copies show `first`, then `seen` and at the ends `final`; they end after steps 3 and 6."""
    shown, _, steps = roll(vectorize(env, 2), 7)
    for b in range(2):
        np.testing.assert_array_equal(shown[b], first)
        np.testing.assert_array_equal(steps.observation[:, b], seen)
        np.testing.assert_array_equal(steps.final_observation[:, b], final)
        np.testing.assert_array_equal(steps.reward[:, b], [1, 2, 3, 1, 2, 3, 1])
        np.testing.assert_array_equal(np.flatnonzero(steps.done[:, b]), [2, 5])
    assert steps.terminated.any() == (how == "terminated") and steps.truncated.any() == (how != "terminated")


@pytest.mark.parametrize("how", HOW)
def test_frame_stack_across_resets(how):
    seen = [[0, 0, 1], [0, 1, 2], [0, 0, 0], [0, 0, 1], [0, 1, 2], [0, 0, 0], [0, 0, 1]]
    final = [[0, 0, 1], [0, 1, 2], [1, 2, 3], [0, 0, 1], [0, 1, 2], [1, 2, 3], [0, 0, 1]]
    env = ending(how, lambda env: FrameStack(env, 3))
    check_sequence(env, how, [0, 0, 0], seen, final)
    assert env.observation_space.shape == (3,)


@pytest.mark.parametrize("how", HOW)
def test_delay_across_resets(how):
    env = ending(how, lambda env: DelayObservation(env, 1))
    check_sequence(env, how, [0], np.c_[[0, 1, 0, 0, 1, 0, 0]], np.c_[[0, 1, 2, 0, 1, 2, 0]])


def test_longer_delay_across_resets():
    env = DelayObservation(CountingEnv(3), 2)
    check_sequence(env, "terminated", [0], np.c_[[0, 0, 0, 0, 0, 0, 0]], np.c_[[0, 0, 1, 0, 0, 1, 0]])


@pytest.mark.parametrize("how", HOW)
def test_mask_across_resets(how):
    env = ending(how, lambda env: MaskObservation(FrameStack(env, 3), (2, 0)))
    seen = [[1, 0], [2, 0], [0, 0], [1, 0], [2, 0], [0, 0], [1, 0]]
    final = [[1, 0], [2, 0], [3, 1], [1, 0], [2, 0], [3, 1], [1, 0]]
    check_sequence(env, how, [0, 0], seen, final)


@pytest.mark.parametrize("how", HOW)
def test_noise_across_resets(how):
    none = ending(how, lambda env: NoisyObservation(env, 0.0))
    check_sequence(none, how, [0], np.c_[[1, 2, 0, 1, 2, 0, 1]], np.c_[[1, 2, 3, 1, 2, 3, 1]])


def test_a_stack_repeats_the_first_observation_of_its_own_episode():
    first, _, steps = roll(vectorize(FrameStack(TimeLimit(CartPole(), 6), 2), 3), 40)
    pairs = np.concatenate([first[None], steps.observation]).reshape(41, 3, 2, 4)
    final = steps.final_observation.reshape(40, 3, 2, 4)
    np.testing.assert_array_equal(pairs[0, :, 0], pairs[0, :, 1])
    np.testing.assert_array_equal(pairs[1:][steps.done][:, 0], pairs[1:][steps.done][:, 1])
    np.testing.assert_array_equal(final[:, :, 0], pairs[:-1, :, 1])


def test_stacked_pictures_lie_in_the_channels():
    env = FrameStack(Picture(), 3)
    assert env.observation_space == spaces.Box(0, 255, (2, 3, 3), np.uint8)
    _, _, steps = roll(vectorize(env, 1), 4)
    assert steps.observation.dtype == np.uint8
    np.testing.assert_array_equal(steps.observation[:, 0, 1, 2], [[0, 0, 1], [0, 1, 2], [1, 2, 3], [2, 3, 4]])
    assert np.all(steps.observation == steps.observation[:, :, :1, :1])


@pytest.mark.parametrize(("size", "determined"), [(1, False), (2, True)])
def test_two_frames_determine_a_second_order_process(size, determined):
    env = TimeLimit(FrameStack(SecondOrder(), size), 20)
    first, _, steps = roll(vectorize(env, 8), 100)
    before = np.concatenate([first[None], steps.observation[:-1]])
    # A stack of repeats at the start of an episode is not two observations.
    started = np.concatenate([np.ones((1, 8), bool), steps.done[:-1]])
    pairs = {(tuple(a), tuple(b)) for a, b in zip(before[~started], steps.final_observation[~started], strict=True)}
    assert (len({a for a, _ in pairs}) == len(pairs)) == determined


def test_mask_hides_velocities():
    env = MaskObservation(CartPole(), keep=(0, 2))
    np.testing.assert_array_equal(env.observation_space.high, CartPole().observation_space.high[[0, 2]])
    first, actions, steps = roll(vectorize(env, 2), 30)
    whole, _, everything = roll(vectorize(CartPole(), 2), 30, actions)
    np.testing.assert_array_equal(first, whole[:, [0, 2]])
    np.testing.assert_allclose(steps.final_observation, everything.final_observation[..., [0, 2]], atol=1e-6)


@pytest.mark.parametrize("scale", [0.5, np.array([0.1, 2.0, 0.0], np.float32)])
def test_noise(scale):
    env = NoisyObservation(Pendulum(), scale)
    assert env.observation_space == spaces.Box(-np.inf, np.inf, (3,), np.float32)
    truth = lambda state: np.stack([np.cos(state[:, 0]), np.sin(state[:, 0]), state[:, 1]], axis=1)  # noqa: E731
    reset_keys, keys = jax.random.split(jax.random.key(3), (2, 4000))
    state, seen = jax.jit(jax.vmap(lambda key: env.reset(key)))(reset_keys)
    looks = [seen - truth(state)]
    state, step = jax.jit(jax.vmap(lambda s, key: env.step(s, jnp.zeros(1), key)))(state, keys)
    looks.append(step.observation - truth(state))
    for noise in np.asarray(looks):
        assert np.all(np.abs(noise.mean(axis=0)) <= 4 * scale / np.sqrt(4000) + 1e-6)
        np.testing.assert_allclose(noise.std(axis=0), np.broadcast_to(scale, 3), rtol=4 / np.sqrt(8000), atol=1e-6)
    np.testing.assert_array_equal(step.observation, step.final_observation)
    # Fresh noise at each look, none in the state or in the reward.
    assert np.abs(np.corrcoef(looks[0][:, 0], looks[1][:, 0])[0, 1]) < 0.07
    once = jax.jit(lambda env: env.step(jnp.ones(2), jnp.zeros(1), keys[0]))
    (plain, one), (noisy, other) = once(Pendulum()), once(env)
    np.testing.assert_array_equal(plain, noisy)
    assert one.reward == other.reward


def test_actions_are_clipped():
    env = ClipAction(Echo())
    assert env.action_space == spaces.Box(-np.inf, np.inf, (2,), np.float32)
    actions = jnp.asarray([[[-9.0, 9.0]], [[0.5, 2.25]], [[9.0, -9.0]]])
    _, _, steps = roll(vectorize(env, 1), 3, actions)
    np.testing.assert_array_equal(steps.extras["given"][:, 0], [[-1, 2.5], [0.5, 2.25], [3, 2]])
    assert env.observation_space == Echo().observation_space


def test_actions_are_rescaled():
    env = RescaleAction(Echo())
    assert env.action_space == spaces.Box(-1, 1, (2,), np.float32)
    actions = jnp.asarray([[[-1.0, 1.0]], [[0.0, 0.0]], [[1.0, -1.0]], [[0.5, -0.5]], [[2.0, -2.0]]])
    _, _, steps = roll(vectorize(env, 1), 5, actions)
    np.testing.assert_allclose(
        steps.extras["given"][:, 0], [[-1, 2.5], [1, 2.25], [3, 2], [2, 2.125], [3, 2]], rtol=1e-7
    )
    _, actions, steps = roll(vectorize(RescaleAction(Pendulum()), 2), 50)
    _, _, plain = roll(vectorize(Pendulum(), 2), 50, jnp.asarray(2 * actions))
    np.testing.assert_allclose(steps.observation, plain.observation, atol=1e-5)


@pytest.mark.parametrize("how", HOW)
def test_scaled_reward(how):
    _, _, steps = roll(vectorize(ending(how, lambda env: ScaleReward(env, -0.5)), 2), 7)
    np.testing.assert_array_equal(steps.reward[:, 0], -0.5 * np.array([1, 2, 3, 1, 2, 3, 1]))
    np.testing.assert_array_equal(steps.extras["raw_reward"][:, 1], [1, 2, 3, 1, 2, 3, 1])


def test_wrapped_twice_the_innermost_reward_is_kept():
    env = ScaleReward(ScaleReward(CountingEnv(), 2.0), jnp.asarray(3.0))
    _, _, steps = roll(vectorize(env, 1), 4)
    np.testing.assert_array_equal(steps.reward[:, 0], [6, 12, 18, 24])
    np.testing.assert_array_equal(steps.extras["raw_reward"][:, 0], [1, 2, 3, 4])


@pytest.mark.parametrize("how", HOW)
def test_a_reward_function_sees_its_own_episode_only(how):
    step = lambda here, action, there: 10 * here[0] + there[0]  # noqa: E731
    _, _, steps = roll(vectorize(ending(how, lambda env: RewardFunction(env, step)), 2), 7)
    np.testing.assert_array_equal(steps.reward[:, 0], [1, 12, 23, 1, 12, 23, 1])


def mountain_car_reward(observation, action, following):
    """What MountainCarContinuous pays, from what is seen."""
    arrived = (following[0] >= 0.45) & (following[1] >= 0.0)
    return 100.0 * arrived.astype(following.dtype) - 0.1 * action[0] ** 2


class LearnedReward(eqx.Module):
    """The same with parameters."""

    prize: jax.Array
    price: jax.Array

    def __call__(self, observation, action, following):
        arrived = (following[0] >= 0.45) & (following[1] >= 0.0)
        return self.prize * arrived.astype(following.dtype) - self.price * action[0] ** 2


def episode_returns(steps):
    """Return of each finished episode of one environment, summed in the order of the steps."""
    found, total = [], np.float32(0)
    for reward, done in zip(steps.reward[:, 0], steps.done[:, 0], strict=True):
        total += reward
        if done:
            found.append(total)
            total = np.float32(0)
    return np.array(found)


def test_the_true_reward_reproduces_returns(item):
    env = TimeLimit(MountainCarContinuous(), 110)
    learned = LearnedReward(jnp.asarray(100.0), jnp.asarray(0.1))
    # Forces of -1, 0 and 1: their squares are exact, however the compiler fuses the arithmetic.
    pump = lambda seen, action: jnp.sign(seen[:, 1:]) * (action > -0.8)  # noqa: E731
    _, _, theirs = roll(vectorize(env, 1), 2000, policy=pump)
    assert theirs.terminated.any() and theirs.truncated.any()
    for function in (mountain_car_reward, learned):
        _, _, ours = roll(vectorize(RewardFunction(env, function), 1), 2000, policy=pump)
        gap = np.abs(episode_returns(ours) - episode_returns(theirs)).max()
        with item("1.10") as check:
            check(gap, "==", 0.0, "greatest difference of an episode's return under the true reward")
        np.testing.assert_array_equal(ours.reward, theirs.reward)
        np.testing.assert_array_equal(ours.extras["raw_reward"], theirs.reward)
        np.testing.assert_array_equal(ours.final_observation, theirs.final_observation)


def test_gradients_reach_a_learned_reward():
    env, key = RewardFunction(MountainCarContinuous(), LearnedReward(jnp.ones(()), jnp.ones(()))), jax.random.key(0)
    pay = lambda env: env.step(env.reset(key)[0], jnp.asarray([0.5]), key)[1].reward  # noqa: E731
    slope = jax.jit(jax.grad(pay))(env)
    assert float(slope.function.price) == -0.25 and float(slope.function.prize) == 0.0


def normalise(rewards, dones, gamma, clip):
    """The definition over all that was seen so far, with one sample of variance 1 at first. In float64."""
    rewards = rewards.astype(np.float64)
    discounted, seen, out = np.zeros(rewards.shape[1]), [], []
    for reward, done in zip(rewards, dones, strict=True):
        discounted = gamma * discounted + reward
        seen.append(discounted)
        values = np.concatenate(seen)
        count = 1 + values.size
        mean = values.sum() / count
        variance = (1 + (values**2).sum()) / count - mean**2
        out.append(np.clip(reward / np.sqrt(variance + 1e-8), -clip, clip))
        discounted = np.where(done, 0.0, discounted)
    return np.array(out)


@pytest.mark.parametrize(("size", "clip"), [(1, 10.0), (3, 10.0), (3, 0.3)])
def test_normalised_rewards(size, clip):
    env = NormalizeReward(vectorize(TimeLimit(Pendulum(), 7), size), 0.9, clip)
    _, actions, steps = roll(env, 40)
    _, _, plain = roll(vectorize(TimeLimit(Pendulum(), 7), size), 40, jnp.asarray(actions))
    np.testing.assert_allclose(steps.reward, normalise(plain.reward, plain.done, 0.9, clip), rtol=1e-4)
    for ours, theirs in (
        (steps.extras["raw_reward"], plain.reward),
        (steps.final_observation, plain.final_observation),
        (steps.observation, plain.observation),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    assert steps.truncated.any() and (np.abs(steps.reward).max() <= clip)
    assert env.num_envs == size and env_spec(env) == env_spec(Pendulum())


def test_normalised_rewards_after_a_termination():
    _, _, steps = roll(NormalizeReward(vectorize(CountingEnv(3), 2)), 12)
    _, _, plain = roll(vectorize(CountingEnv(3), 2), 12)
    assert plain.terminated.any()
    np.testing.assert_allclose(steps.reward, normalise(plain.reward, plain.done, 0.99, 10.0), rtol=1e-5)


def test_running_statistics_merge_exactly():
    draws = np.random.default_rng(0).normal(3.0, 2.0, (50, 4))
    with jax.enable_x64(True):
        mean, variance, count = (jnp.zeros(()) for _ in range(3))
        merging = jax.jit(lambda *args: merge(*args))
        for row in draws:
            mean, variance, count = merging(mean, variance, count, jnp.asarray(row))
    np.testing.assert_allclose([mean, variance, count], [draws.mean(), draws.var(), draws.size], rtol=1e-12)


@pytest.mark.parametrize(
    "env",
    [
        FrameStack(CartPole(), 2),
        MaskObservation(CartPole(), (3,)),
        NoisyObservation(CartPole(), 0.1),
        DelayObservation(CartPole(), 2),
        ScaleReward(CartPole(), 0.1),
        RewardFunction(CartPole(), lambda o, a, n: o[0]),
        ClipAction(Pendulum()),
        RescaleAction(Pendulum()),
    ],
    ids=lambda env: type(env).__name__,
)
def test_observations_lie_in_the_space(env):
    first, _, steps = roll(vectorize(TimeLimit(env, 9), 2), 20)
    seen = (*first, *steps.observation[:, 0], *steps.final_observation[:, 1])
    assert all(env.observation_space.contains(o) for o in seen)


def test_refusals():
    refused = [
        (lambda: FrameStack(CartPole(), 0), "size must be at least 1, not 0"),
        (lambda: MaskObservation(CartPole(), ()), "at least one, not"),
        (lambda: MaskObservation(CartPole(), (0, 4)), "from 0 to 3"),
        (lambda: MaskObservation(CartPole(), (1, 1)), "distinct"),
        (lambda: MaskObservation(Picture(), (0,)), "keeps entries of a vector"),
        (lambda: NoisyObservation(CartPole(), -1.0), "at least 0, not -1"),
        (lambda: NoisyObservation(CartPole(), np.ones(3, np.float32)), r"shape \(4,\)"),
        (lambda: NoisyObservation(Picture(), 1.0), "these are uint8"),
        (lambda: DelayObservation(CartPole(), 0), "at least 1, not 0"),
        (lambda: ClipAction(CartPole()), "ClipAction works on Box"),
        (lambda: RescaleAction(CartPole()), "RescaleAction works on Box"),
        (lambda: RescaleAction(ClipAction(Pendulum())), "finite bounds"),
        (lambda: ScaleReward(CartPole(), float("nan")), "finite number"),
        (lambda: RewardFunction(CartPole(), 3), "needs a function"),
        (lambda: NormalizeReward(vectorize(CartPole(), 1), 1.5), r"in \[0, 1\], not 1.5"),
        (lambda: NormalizeReward(vectorize(CartPole(), 1), 0.9, 0.0), "above 0, not 0"),
    ]
    for make, message in refused:
        with pytest.raises(ValueError, match=message):
            make()
    env, key = RewardFunction(QuadraticReward(), lambda o, a, n: a), jax.random.key(0)
    with pytest.raises(ValueError, match=r"single number, and this one gave shape \(1,\)"):
        env.step(env.reset(key)[0], jnp.zeros(1), key)
