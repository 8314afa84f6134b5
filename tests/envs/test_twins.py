"""Every compiled twin against Gymnasium's own environment: spaces, 10,000 steps from its states, both ends, resets.

Half of the episodes are uniformly random; the other half are driven by a rough controller, without which no random walk
would ever reach MountainCar's goal or CartPole's time limit, and both ends have to be seen. Another 10,000 steps start
all over the observation box, where walls, wrapped angles and clipped velocities are.

Tolerances of one step, absolute. In float64 the twin differs only in the order of a few operations: 1e-12. Gymnasium
gives observations as float32, so that they may differ by one rounding of float32. In float32 a step from a rounded
state carries a few roundings, 2^-24 of the largest number involved: 50 rad for a pendulum after 200 steps, 28 rad/s for
an acrobot. All over the box the acrobot turns at speeds that it never reaches by itself, where 0.2 s is too long for
one Runge-Kutta step: it amplifies roundings a thousandfold, in either type.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rewardtogo.core import Environment
from rewardtogo.envs.acrobot import Acrobot
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.mountain_car import MountainCar, MountainCarContinuous
from rewardtogo.envs.pendulum import Pendulum
from rewardtogo.envs.time_limit import TimeLimit, TimeLimitState

STEPS = 10_000


@dataclasses.dataclass(frozen=True)
class Case:
    """A twin, its limit, a rough controller, bounds of states, float32 tolerances (along episodes, anywhere)."""

    name: str
    twin: Environment
    limit: int
    controller: Callable[[np.ndarray], int | list[float]]
    span: tuple[float, ...]
    tolerance: tuple[float, float]
    anywhere64: float = 1e-12
    angles: tuple[int, ...] = ()
    ends: tuple[str, ...] = ("terminated", "truncated")


CASES = [
    Case(
        "CartPole-v1",
        CartPole(),
        500,
        lambda s: int(s[2] + 0.3 * s[3] + 0.02 * s[0] + 0.05 * s[1] > 0),
        (2.5, 3, 0.25, 3),
        (5e-7, 1e-6),
    ),
    Case(
        "Acrobot-v1",
        Acrobot(),
        500,
        lambda s: 2 * int(s[3] > 0),
        (np.pi, np.pi, 4 * np.pi, 9 * np.pi),
        (5e-6, 1e-2),
        1e-11,
        (0, 1),
    ),
    Case("MountainCar-v0", MountainCar(), 200, lambda s: 2 * int(s[1] > 0), (1.2, 0.07), (3e-7, 3e-7)),
    Case(
        "MountainCarContinuous-v0", MountainCarContinuous(), 999, lambda s: [np.sign(s[1])], (1.2, 0.07), (3e-7, 3e-7)
    ),
    Case(
        "Pendulum-v1",
        Pendulum(),
        200,
        lambda s: [2.0 * np.sign(s[1])],
        (3 * np.pi, 8),
        (2e-5, 3e-6),
        ends=("truncated",),
    ),
]


@dataclasses.dataclass(frozen=True)
class Steps:
    """What Gymnasium did: arrays with one row a step."""

    before: np.ndarray
    action: np.ndarray
    after: np.ndarray
    observation: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray


def random_action(env: Any, rng: np.random.Generator) -> np.ndarray:
    """Any action; where it is a number, beyond the bounds too, and one that float32 holds."""
    if isinstance(env.action_space, gymnasium.spaces.Discrete):
        return rng.integers(env.action_space.n)
    bound = 1.25 * env.action_space.high
    return rng.uniform(-bound, bound).astype(np.float32).astype(np.float64)


def record(env: Any, action: np.ndarray) -> tuple:
    """One step of Gymnasium from its state in float64."""
    env.unwrapped.state = before = np.asarray(env.unwrapped.state, np.float64)
    observation, reward, terminated, truncated, _ = env.step(action)
    return (
        before,
        action,
        np.asarray(env.unwrapped.state, np.float64),
        np.array(observation),
        reward,
        terminated,
        truncated,
    )


def episodes(case: Case) -> Steps:
    env: Any = gymnasium.make(case.name, disable_env_checker=True)
    rng, rows, turn = np.random.default_rng(1), [], 0
    env.reset(seed=1)
    while len(rows) < STEPS:
        drives = turn % 2 and rng.random() < 0.95
        action = (
            np.asarray(case.controller(np.asarray(env.unwrapped.state, np.float64)))
            if drives
            else random_action(env, rng)
        )
        rows.append(record(env, action))
        if rows[-1][-2] or rows[-1][-1]:
            env.reset()
            turn += 1
    return Steps(*(np.array(column) for column in zip(*rows, strict=True)))


def anywhere(case: Case) -> Steps:
    env: Any = gymnasium.make(case.name, disable_env_checker=True).unwrapped
    rng, rows = np.random.default_rng(2), []
    env.reset(seed=2)
    for _ in range(STEPS):
        env.state = rng.uniform(-1, 1, len(case.span)) * case.span
        if case.name.startswith("MountainCar"):
            env.state[0] = rng.uniform(-1.2, 0.6)
        if case.name == "CartPole-v1":
            env.steps_beyond_terminated = None
        rows.append(record(env, random_action(env, rng)))
    return Steps(*(np.array(column) for column in zip(*rows, strict=True)))


def run(case: Case, steps: Steps, dtype: type) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The twin's steps from the same states; its own time limit counts. One compiled scan."""
    env = TimeLimit(case.twin, case.limit)
    discrete = isinstance(env.action_space, gymnasium.spaces.Discrete)
    actions = jnp.asarray(steps.action, jnp.int32 if discrete else dtype)
    keys = jax.random.split(jax.random.key(0), len(steps.before))

    def step(elapsed: jax.Array, given: tuple) -> tuple:
        state, timestep = env.step(TimeLimitState(given[0], elapsed), given[1], given[2])
        return jnp.where(timestep.done, 0, state.elapsed), (state.inner, timestep)

    inputs = (jnp.asarray(steps.before, dtype), actions, keys)
    _, (after, timestep) = jax.jit(lambda xs: jax.lax.scan(step, jnp.zeros((), jnp.int32), xs))(inputs)
    np.testing.assert_array_equal(timestep.observation, timestep.final_observation)
    names = ("observation", "reward", "terminated", "truncated")
    return np.asarray(after), {name: np.asarray(getattr(timestep, name)) for name in names}


def distance(case: Case, ours: np.ndarray, theirs: np.ndarray) -> float:
    """Greatest difference of two arrays of states; angles on the circle."""
    gap = ours.astype(np.float64) - theirs
    for i in case.angles:
        gap[:, i] = (gap[:, i] + np.pi) % (2 * np.pi) - np.pi
    return float(np.abs(gap).max())


@pytest.fixture(scope="module", params=CASES, ids=lambda case: case.name)
def recorded(request: pytest.FixtureRequest) -> tuple[Case, Steps, Steps]:
    return request.param, episodes(request.param), anywhere(request.param)


def test_spaces_and_limit(recorded):
    case, _, _ = recorded
    env: Any = gymnasium.make(case.name)
    assert case.twin.observation_space == env.observation_space
    assert case.twin.action_space == env.action_space
    assert env.spec.max_episode_steps == case.limit
    for low_or_high in ("low", "high"):
        mine, theirs = (getattr(e.observation_space, low_or_high) for e in (case.twin, env))
        np.testing.assert_array_equal(mine, theirs)


def test_float64_steps(recorded):
    case, driven, scattered = recorded
    for steps, tolerance in ((driven, 1e-12), (scattered, case.anywhere64)):
        with jax.enable_x64(True):
            after, ours = run(case, steps, jnp.float64)
        assert after.dtype == np.float64
        if case.name == "MountainCarContinuous-v0":
            # Gymnasium rounds this state to float32 after each step; rounded as well, ours is the same number.
            assert np.mean(after.astype(np.float32) == steps.after) > 0.999
            tolerance = 6e-8
        assert distance(case, after, steps.after) <= tolerance
        np.testing.assert_allclose(ours["observation"].astype(np.float32), steps.observation, rtol=1.2e-7, atol=1e-12)
        np.testing.assert_allclose(ours["reward"], steps.reward, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(ours["terminated"], steps.terminated)


def test_float32_steps(recorded):
    case, driven, scattered = recorded
    for steps, tolerance in zip((driven, scattered), case.tolerance, strict=True):
        after, ours = run(case, steps, jnp.float32)
        assert after.dtype == ours["observation"].dtype == ours["reward"].dtype == np.float32
        assert distance(case, after, steps.after) <= tolerance
        np.testing.assert_allclose(ours["observation"], steps.observation, rtol=0, atol=tolerance)
        np.testing.assert_allclose(ours["reward"], steps.reward, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(ours["terminated"], steps.terminated)


def test_both_ends_at_the_same_steps(recorded):
    case, driven, _ = recorded
    for dtype in (jnp.float32, jnp.float64):
        with jax.enable_x64(dtype is jnp.float64):
            _, ours = run(case, driven, dtype)
        for end in ("terminated", "truncated"):
            np.testing.assert_array_equal(ours[end], getattr(driven, end))
    for end in case.ends:
        assert getattr(driven, end).any(), f"{case.name} was never {end} in this test"


def test_reset_distribution(recorded):
    case, _, _ = recorded
    states, observations = jax.jit(jax.vmap(lambda key: case.twin.reset(key)))(
        jax.random.split(jax.random.key(3), STEPS)
    )
    env: Any = gymnasium.make(case.name, disable_env_checker=True).unwrapped
    env.reset(seed=3)
    theirs = [(env.reset()[0], env.state) for _ in range(2000)]
    assert np.asarray(states).dtype == np.asarray(observations).dtype == np.float32
    for ours, reference in (
        (observations, np.array([o for o, _ in theirs])),
        (states, np.array([s for _, s in theirs])),
    ):
        ours = np.asarray(ours)
        spread = np.ptp(reference, axis=0)
        # 2000 samples of Gymnasium's leave less than 1 % of a uniform's range unseen.
        assert np.all(ours.min(axis=0) >= reference.min(axis=0) - 0.01 * spread)
        assert np.all(ours.max(axis=0) <= reference.max(axis=0) + 0.01 * spread)
        for column in range(ours.shape[1]):
            result: Any = stats.ks_2samp(ours[:, column], reference[:, column])
            assert result.pvalue > 1e-3
    assert all(case.twin.observation_space.contains(np.asarray(o)) for o in observations[:100])
    centred = np.asarray(states) - np.asarray(states).mean(axis=0)
    moving = centred.std(axis=0) > 0
    correlation = np.corrcoef(centred[:, moving].T).reshape(moving.sum(), -1)
    assert np.abs(correlation - np.eye(moving.sum())).max() < 0.05
