"""The small problems of chapter 2: their dynamics by hand, their pictures, their experts, and that they can be had by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.catalogue import ENVIRONMENTS
from rewardtogo.core import env_spec
from rewardtogo.envs import imitation_problems as problems
from rewardtogo.envs.imitation_problems import Braking, Lane, LastTwo, draw_road, read_picture, side_view
from rewardtogo.envs.registry import COMPILED, make
from rewardtogo.envs.tabular_problems import GROUND, ROPE, TIGHTROPE_EXPERT, tightrope
from rewardtogo.exact import expected_return, one_hot_policy
from rewardtogo.runner.check import check_by_name
from rewardtogo.runner.evaluate import Evaluator
from rewardtogo.runner.experts import expert_of

EXPERTS = {
    "Steering": "steer_by_picture",
    "Lane": "steer",
    "BrakeLight": "brake",
    "Drone": "pass_the_tree",
    "Tightrope": "balance",
}
BEST = {"Steering": 1000, "Lane": 200, "BrakeLight": 100, "Drone": 1, "Tightrope": 50}


def test_every_compiled_environment_is_in_the_catalogue():
    assert set(COMPILED) == set(ENVIRONMENTS)


@pytest.mark.parametrize("name", EXPERTS)
def test_the_expert_of_each_is_found_by_name_and_reaches_the_optimum(name, key, item):
    env = make(name, 4)
    expert = expert_of(f"rewardtogo.envs.imitation_problems:{EXPERTS[name]}", env_spec(env))
    returns = Evaluator(env, 4)(expert, key)[0]
    with item("2.3") as check_item:
        check_item(returns.min(), "==", BEST[name], f"return of the scripted expert in {name}")


@pytest.mark.parametrize("name", [*EXPERTS, "LastTwo"])
def test_nothing_is_wrong_with_them(name):
    assert not [str(p) for p in check_by_name(name) if p.severity == "error"]


def test_the_car_by_hand(key):
    env = Lane(wind=0.0)
    state, observation = env.reset(key)
    assert np.array_equal(observation, [0, 0, 0])
    state, step = env.step(state, jnp.full(1, 0.5), key)
    assert np.allclose([state.direction, state.offset], [0.05, 0.2 * np.sin(0.05)])
    state, step = env.step(state, jnp.full(1, 0.5), key)
    theta = 0.05 + 0.05 - 0.05 * np.sin(2 * np.pi / 50)
    assert np.allclose(
        step.observation, [0.2 * np.sin(0.05) + 0.2 * np.sin(theta), theta, np.sin(4 * np.pi / 50)], atol=1e-6
    )
    assert float(step.reward) == 1.0 and not bool(step.terminated)
    _, step = env.step(problems.LaneState(jnp.asarray(0.95), jnp.asarray(0.5), jnp.asarray(0)), jnp.zeros(1), key)
    assert bool(step.terminated)


@pytest.mark.parametrize("steering", [0, 1, 2])
def test_the_car_of_the_pictures_turns_by_a_tenth(steering, key):
    env = Lane(wind=0.0, picture=True)
    state, picture = env.reset(key)
    after, step = env.step(state, jnp.asarray(steering), key)
    assert np.isclose(after.direction, 0.1 * (steering - 1))
    assert step.observation.shape == (16, 16, 1) and picture[:, 7].min() > 200


@pytest.mark.parametrize(("offset", "direction"), [(0.0, 0.0), (0.5, -0.1), (-0.6, 0.2), (0.3, 0.3)])
def test_a_picture_can_be_read(offset, direction):
    y, theta = jax.jit(read_picture)(draw_road(jnp.asarray(offset), jnp.asarray(direction)))
    assert np.allclose([y, theta], [offset, direction], atol=0.02)


def test_a_side_camera_sees_what_the_moved_car_would(item):
    worst = 0.0
    for offset, direction in ((0.2, 0.0), (-0.3, 0.0), (0.1, 0.1), (0.0, -0.15)):
        seen = side_view(draw_road(jnp.asarray(0.1), jnp.asarray(0.05)), offset, direction)
        there = draw_road(jnp.asarray(0.1 + offset), jnp.asarray(0.05 + direction))
        read, wanted = np.array(jax.jit(read_picture)(seen)), np.array([0.1 + offset, 0.05 + direction])
        worst = max(worst, np.abs(read - wanted).max())
        assert np.abs(seen.astype(int) - there.astype(int)).max() < 50
    whole = side_view(draw_road(jnp.asarray(0.0), jnp.asarray(0.0)), 0.5)
    with item("2.33") as check_item:
        check_item(worst, "<=", 0.02, "place of the car, read from a side camera, against where the camera was")
        exact = np.asarray(draw_road(jnp.asarray(0.5), jnp.asarray(0.0)), int) - np.asarray(whole, int)
        check_item(np.abs(exact).max(), "<=", 1, "a camera three pixels aside, against the picture from there, of 255")


def test_the_light_shows_the_last_action_and_nothing_else(key):
    @jax.jit
    def play(env, key):
        def step(now, keys):
            state, _ = now
            action = jax.random.bernoulli(keys[0]).astype(jnp.int32)
            state, timestep = env.step(state, action, keys[1])
            return (state, timestep.observation), (action, timestep.reward, now[0].obstacle, timestep.observation)

        return jax.lax.scan(step, env.reset(key), jax.random.split(key, (5000, 2)))[1]

    action, reward, obstacle, seen = map(np.asarray, play(Braking(), key))
    assert np.array_equal(seen[:, 1], action) and np.array_equal(reward, (action == obstacle).astype(float))
    assert abs((seen[:, 0] != seen[:, 2]).mean() - 0.02) < 0.008
    assert abs((obstacle[1:] != obstacle[:-1]).mean() - 0.01) < 0.006
    assert not np.asarray(play(Braking(light=False), key)[3])[:, 1].any()


def test_the_last_two(key):
    env = LastTwo()
    state, first = env.reset(key)
    state, step = env.step(state, jnp.asarray(0), key)
    assert float(step.reward) == 1.0  # o_0 XOR o_0
    wanted = int(first[0] != step.observation[0])
    assert [float(env.step(state, jnp.asarray(a), key)[1].reward) for a in (0, 1)] == [
        float(a == wanted) for a in (0, 1)
    ]


def test_the_tightrope_by_hand():
    for recovers in (True, False):
        mdp = tightrope(5, recovers=recovers)
        assert expected_return(mdp, one_hot_policy(TIGHTROPE_EXPERT, 2)) == 5
        assert mdp.transitions[ROPE, 1, GROUND] == mdp.transitions[GROUND, 0, GROUND] == 1
        assert mdp.transitions[GROUND, 1, ROPE] == float(recovers)
        # One mistake at first, the expert ever after: up again in the second step, or never.
        one = np.stack([one_hot_policy(np.array([1 if t == 0 else 0, 1]), 2) for t in range(5)])
        assert expected_return(mdp, one) == (4 if recovers else 0)
