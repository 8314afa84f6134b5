"""EnvPool's environments behind the door: the same episodes as Gymnasium's, ending where and how they do."""

import importlib.util
import json
import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.cli.main import main
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.envpool import EnvPool
from rewardtogo.envs.gymnasium import EnvironmentFailure, GymnasiumEnv
from rewardtogo.envs.registry import make
from rewardtogo.runner.evaluate_run import evaluate_run
from rewardtogo.runner.plan import from_config, plan

needs_envpool = pytest.mark.skipif(importlib.util.find_spec("envpool") is None, reason="EnvPool is not installed")
SMALL = {
    "num_envs": 2,
    "preset": "none",
    "loop": {"unroll": 8},
    "learner": {"network": {"class": "MLP", "sizes": [4]}, "epochs": 1, "minibatches": 1},
}


def roll(env, actions, key):
    """First observation and timesteps `[T, B]` of one compiled scan, as NumPy."""
    keys = jax.random.split(key, env.num_envs)

    @jax.jit
    def program(actions, keys):
        state, first = env.reset(keys)
        return first, jax.lax.scan(lambda s, a: env.step(s, a, keys), state, actions)[1]

    return jax.tree.map(np.asarray, jax.block_until_ready(program(actions, keys)))


def truth(single, place, limit, first, timesteps, actions):
    """Largest error, and flags, of one of Gymnasium's own that is placed where each of EnvPool's episodes begins."""
    length, copies = timesteps.reward.shape
    terminated, truncated = np.zeros((2, length, copies), bool)
    error = 0.0
    for copy in range(copies):
        single.reset(seed=0)
        place(single.unwrapped, first[copy])
        count = 0
        for t in range(length):
            final, reward, terminated[t, copy], _, _ = single.unwrapped.step(actions[t, copy])
            count += 1
            truncated[t, copy] = count >= limit
            error = max(
                error,
                float(np.abs(final - timesteps.final_observation[t, copy]).max()),
                abs(float(reward) - float(timesteps.reward[t, copy])),
            )
            if terminated[t, copy] or truncated[t, copy]:
                place(single.unwrapped, timesteps.observation[t, copy])
                count = 0
                if isinstance(single.unwrapped, gymnasium.envs.classic_control.CartPoleEnv):
                    single.unwrapped.steps_beyond_terminated = None
    return error, terminated, truncated


def place_cartpole(env, observation):
    env.state = observation.astype(np.float64)


def place_pendulum(env, observation):
    cosine, sine, speed = observation.astype(np.float64)
    env.state = np.array([np.arctan2(sine, cosine), speed])


def place_cheetah(env, observation):
    # The position is not observed, and nothing depends on it.
    env.set_state(np.concatenate([[0.0], observation[:8]]), observation[8:].astype(np.float64))


@needs_envpool
def test_cartpole_ends_where_and_how_gymnasiums_does(item, key):
    length, copies, limit = 150, 8, 10
    rng = np.random.default_rng(0)
    always = np.broadcast_to(np.arange(copies) % 2, (length, copies))  # falls after 8 to 11 steps, the limit among them
    actions = np.where(np.arange(copies) < 6, always, rng.integers(0, 2, (length, copies))).astype(np.int32)
    env = make("CartPole-v1", copies, backend="envpool", max_episode_steps=limit)
    first, found = roll(env, jnp.asarray(actions), key)
    error, terminated, truncated = truth(
        gymnasium.make("CartPole-v1"), place_cartpole, limit, first, found, actions.astype(int)
    )
    done = terminated | truncated
    # Fallen alone, cut alone, and fallen in the very step that reaches the limit: all three happened.
    assert (terminated & ~truncated).sum() > 5 and (truncated & ~terminated).sum() > 5
    assert (terminated & truncated).sum() > 5
    np.testing.assert_array_equal(found.observation[~done], found.final_observation[~done])
    with item("X2") as check:
        check(
            (found.terminated != terminated).sum() + (found.truncated != truncated).sum(),
            "==",
            0,
            "flags of EnvPool's CartPole that differ from Gymnasium's",
        )
        check(np.abs(found.observation[done]).max(), "<=", 0.05, "what opens the next episode, within its start range")
        check(error, "<=", 1e-5, "final observations and rewards against Gymnasium's")


@needs_envpool
def test_pendulum_is_cut_and_never_ends(item, key):
    length, copies, limit = 40, 3, 7
    actions = np.random.default_rng(1).uniform(-2, 2, (length, copies, 1)).astype(np.float32)
    env = make("Pendulum-v1", copies, backend="envpool", max_episode_steps=limit)
    first, found = roll(env, jnp.asarray(actions), key)
    error, terminated, truncated = truth(gymnasium.make("Pendulum-v1"), place_pendulum, limit, first, found, actions)
    with item("X2") as check:
        check(found.terminated.sum(), "==", 0, "EnvPool's pendulums that terminated")
        check((found.truncated != truncated).sum(), "==", 0, "cut elsewhere than after the limit")
        check(error, "<=", 1e-4, "final observations and rewards against Gymnasium's")
    assert not terminated.any() and truncated.sum() == copies * (length // limit)


@needs_envpool
def test_half_cheetah_is_gymnasiums(key):
    pytest.importorskip("mujoco")
    actions = np.random.default_rng(2).uniform(-1, 1, (30, 2, 6)).astype(np.float32)
    env = make("HalfCheetah-v5", 2, backend="envpool", max_episode_steps=12)
    first, found = roll(env, jnp.asarray(actions), key)
    single = gymnasium.make("HalfCheetah-v5")
    error, terminated, truncated = truth(single, place_cheetah, 12, first, found, actions)
    single.close()
    np.testing.assert_array_equal(found.truncated, truncated)
    assert not found.terminated.any() and not terminated.any()
    assert found.observation.dtype == np.float32 and first.shape == (2, 17)
    assert error <= 1e-3


@needs_envpool
def test_keys_are_the_only_randomness(key):
    env = make("CartPole-v1", 4, backend="envpool")
    actions = jnp.zeros((25, 4), jnp.int32)
    one, again, other = (roll(env, actions, k) for k in (key, key, jax.random.key(9)))
    jax.tree.map(np.testing.assert_array_equal, one, again)
    assert not np.array_equal(one[0], other[0])
    assert len(np.unique(one[0][:, 0])) == 4


@needs_envpool
def test_the_limit_is_the_environments_own():
    for name, limit in (("CartPole-v1", 500), ("CartPole-v0", 200), ("Pendulum-v1", 200), ("HalfCheetah-v5", 1000)):
        spec = EnvPool(name, 2).spec
        assert spec is not None and spec.id == name and spec.max_episode_steps == limit
    assert EnvPool("CliffWalking-v0").spec.max_episode_steps is None


@needs_envpool
def test_spaces_and_names():
    env = GymnasiumEnv(EnvPool("HalfCheetah-v5", 3), extras=("x_velocity",))
    assert env.name == "HalfCheetah-v5" and env.num_envs == 3 and env.backend == "envpool"
    assert env.observation_space.shape == (17,) and env.action_space.shape == (6,)
    assert "x_velocity" in jax.eval_shape(env.step, *_arguments(env))[1].extras
    # EnvPool gives the smallest positive number for a bound that there is none.
    assert not EnvPool("WalkerWalk-v1").single_observation_space["velocity"].is_bounded("below")
    assert make("CartPole-v1", 2, backend="gymnasium").backend == "gymnasium"


def _arguments(env):
    keys = jax.ShapeDtypeStruct((env.num_envs,), jax.random.key(0).dtype)
    action = jax.ShapeDtypeStruct((env.num_envs, *env.action_space.shape), jnp.float32)
    return jax.ShapeDtypeStruct((), jnp.int32), action, keys


@needs_envpool
def test_pictures_have_channels_last_and_lives_are_kept():
    pool = EnvPool("Breakout-v5", 1, {"episodic_life": True, "noop_max": 1})
    observation, info = pool.reset(seed=0)
    assert observation.shape == (1, 84, 84, 4) == (1, *pool.single_observation_space.shape)
    lives, terminated = [], np.zeros(1, bool)
    for _ in range(400):
        if terminated[0]:
            before = int(info["lives"][0])
            _, info = pool.reset(options={"reset_mask": terminated})
            lives.append((before, int(info["lives"][0])))
        if len(lives) == 2:
            break
        _, _, terminated, truncated, info = pool.step(np.zeros(1, np.int64))
        assert not truncated.any()
    assert lives == [(4, 4), (3, 3)]  # the game goes on, where a reset by force would give five lives again
    pool.close()


@needs_envpool
def test_a_copy_can_be_reset_in_the_middle():
    pool = EnvPool("CartPole-v1", 3)
    began, _ = pool.reset(seed=[1, 2, 3])
    for _ in range(4):
        moved, *_ = pool.step(np.ones(3, np.int64))
    after, info = pool.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(after[[0, 2]], moved[[0, 2]])
    assert np.abs(after[1]).max() <= 0.05 and list(info["elapsed_step"]) == [4, 0, 4]
    assert not np.array_equal(after[1], began[1])


@needs_envpool
def test_a_closed_one_says_so(key):
    env = make("CartPole-v1", 2, backend="envpool")
    state, _ = env.reset(jax.random.split(key, 2))
    jax.block_until_ready(env.step(state, jnp.zeros(2, jnp.int32), jax.random.split(key, 2)))
    env.close()
    with pytest.raises(Exception, match="closed"):
        jax.block_until_ready(env.step(state + 1, jnp.zeros(2, jnp.int32), jax.random.split(key, 2)))
    failure = env.failure()
    assert isinstance(failure, EnvironmentFailure)
    assert str(failure) == "the environment CartPole-v1 raised RuntimeError in step after 1 vector steps: it is closed"


REFUSED = [
    (("HalfCheetah-v6",), {}, "'HalfCheetah-v6': did you mean HalfCheetah-v5"),
    (("zzzzzzzzzzzzzzzzzzz",), {}, "list_all_envs"),
    (("CartPole-v1",), {"colour": "red"}, "CartPole-v1 cannot be made by EnvPool: .*'colour'"),
    (("CartPole-v1",), {"seed": 3}, "seed of CartPole-v1 .* from the keys"),
    (("Go9x9-v1",), {}, "Go9x9-v1 is for several players"),
    (("CartPole-v1", 0), {}, "at least one environment, not 0"),
    ((CartPole(),), {}, "EnvPool makes environments by name"),
    ((CartPole,), {}, "EnvPool makes environments by name"),
    ((lambda: gymnasium.make("CartPole-v1"),), {}, "EnvPool makes environments by name"),
]


@needs_envpool
@pytest.mark.parametrize(("arguments", "kwargs", "sentence"), REFUSED)
def test_what_envpool_cannot_make_is_refused_in_one_sentence(arguments, kwargs, sentence):
    with pytest.raises(ValueError, match=sentence) as caught:
        make(*arguments, backend="envpool", **kwargs)
    assert "\n" not in str(caught.value)


def test_without_the_package_the_extra_is_named(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "envpool", None)
    with pytest.raises(ValueError, match=r"needs the package envpool.*'rewardtogo\[envpool\]'.*--backend gymnasium"):
        make("CartPole-v1", backend="envpool")
    assert main(["train", "ppo", "CartPole-v1", "--backend", "envpool"]) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not list(tmp_path.iterdir())


@needs_envpool
def test_the_command_refuses_an_unknown_id(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "ppo", "HalfCheetah-v6", "--backend", "envpool"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("rtg: EnvPool") and said.count("\n") == 1 and "HalfCheetah-v5" in said
    assert not list(tmp_path.iterdir())


@needs_envpool
def test_evaluation_is_in_environments_of_the_same_backend():
    for name, kwargs in (("CartPole-v1", {}), ("CartPole-v1", {"max_episode_steps": 20}), ("FrozenLake-v1", {})):
        made = plan("ppo", name, backend="envpool", steps=16, eval_episodes=3, env_kwargs=kwargs, **SMALL)
        again = from_config(json.loads(json.dumps(made.config)), steps=None)
        assert made.config["env"]["backend"] == "envpool"
        for env in (made.env, made.eval_env, again.env, again.eval_env):
            assert isinstance(env, GymnasiumEnv) and env.backend == "envpool"
        limits = {env.host.envs.spec.max_episode_steps for env in (made.env, made.eval_env, again.eval_env)}
        assert limits == {kwargs.get("max_episode_steps", {"CartPole-v1": 500, "FrozenLake-v1": 100}[name])}
    with pytest.raises(ValueError, match="20000 EnvPool environments"):
        plan("ppo", "CartPole-v1", backend="envpool", **{**SMALL, "num_envs": 20_000})


@pytest.mark.slow
@needs_envpool
def test_a_run_from_start_to_score(tmp_path):
    kwargs = {"max_episode_steps": 20}
    run = rtg.train(
        "ppo", "Pendulum-v1", backend="envpool", steps=16, out=tmp_path / "run", env_kwargs=kwargs, quiet=True, **SMALL
    )
    assert json.loads((run.path / "config.json").read_text())["env"]["backend"] == "envpool"
    assert evaluate_run(run.path, episodes=2)["length_mean"] == 20
