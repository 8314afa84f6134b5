"""Playing through the class: a script's episodes are those of stepping the environment by hand, bit for bit; keeping, throwing away."""

import json
from typing import Any

import gymnasium
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.core import Environment, Timestep, env_spec
from rewardtogo.data import Damaged, load_dataset
from rewardtogo.data.episodes import read_description
from rewardtogo.envs.drawing import picture_of
from rewardtogo.envs.host import seeds_of
from rewardtogo.envs.registry import COMPILED
from rewardtogo.imitation import BC
from rewardtogo.label import Playing, play_by, start_playing
from rewardtogo.label.film import png
from rewardtogo.label.playing import playable_rate
from rewardtogo.runner.plan import plan


def balance(observation):
    """Pushes towards where the pole leans, which holds it for some 40 steps."""
    return int(observation[2] > 0)


def begin(out, env: Any = "CartPole-v1", **options) -> Playing:
    return start_playing(env, out=out, **{"episodes": 3, "seed": 5, **options})


FIELDS = ("observation", "action", "reward", "terminated", "truncated", "next_observation")


def bits(tree) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def only(tree):
    return jax.tree.map(lambda x: np.asarray(x)[0], tree)


def by_hand(env_name: str, player, seed: int, attempts: list[int]) -> list[tuple]:
    """Steps of these attempts, one call of the compiled environment after another."""
    env, rows = rtg.make(env_name, 1), []
    reset, step = jax.jit(lambda key: env.reset(key)), jax.jit(lambda *given: env.step(*given))
    for attempt in attempts:
        key = jax.random.fold_in(jax.random.key(seed), attempt)
        state, seen = reset(jax.random.fold_in(key, 0)[None])
        for t in range(10_000):
            before = only(seen)
            action = np.asarray(player(before), env_spec(env).action.dtype)
            state, now = step(state, action[None], jax.random.fold_in(key, t + 1)[None])
            ends = only((now.reward, now.terminated, now.truncated, now.final_observation))
            rows.append((before, action, *ends))
            seen = now.observation
            if ends[1] or ends[2]:
                break
    return rows


@pytest.mark.parametrize(
    ("env", "player"),
    [
        ("CartPole-v1", balance),
        ("Pendulum-v1", lambda o: np.clip(o[1:2] - o[2:3], -2, 2).astype(np.float32)),
        (
            "Taxi-v4",
            lambda o: int(np.flatnonzero(o["action_mask"])[int(o["observation"]) % int(o["action_mask"].sum())]),
        ),
    ],
)
def test_a_script_gives_what_stepping_by_hand_gives(env, player, tmp_path, item):
    with begin(tmp_path / "data", env, episodes=2) as playing:
        assert play_by(player, playing) == 2
    found = load_dataset(tmp_path / "data").transitions
    rows = by_hand(env, player, 5, [0, 1])
    table = [jax.tree.map(lambda *x: np.stack(x), *column) for column in zip(*rows, strict=True)]
    with item("2.4") as check:
        wrong = [name for name, theirs in zip(FIELDS, table, strict=True) if bits(vars(found)[name]) != bits(theirs)]
        check(len(found.reward), "==", len(rows), f"steps played in {env}")
        check(len(wrong), "==", 0, f"fields of a played dataset that differ from stepping {env} by hand")


def test_gymnasiums_own_gives_what_gymnasium_gives(tmp_path):
    with begin(tmp_path / "data", backend="gymnasium", episodes=2) as playing:
        play_by(balance, playing)
        picture = playing.picture()
    found, at = jax.tree.map(np.asarray, load_dataset(tmp_path / "data").transitions), 0
    env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    for attempt in range(2):
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(5), attempt), 0)
        seen, _ = env.reset(seed=seeds_of(np.asarray(jax.random.key_data(key))[None])[0])
        over = False
        while not over:
            assert found.observation[at].tobytes() == seen.tobytes()
            seen, reward, terminated, truncated, _ = env.step(int(found.action[at]))
            assert (found.reward[at], found.terminated[at], found.truncated[at]) == (reward, terminated, truncated)
            assert found.next_observation[at].tobytes() == seen.tobytes()
            over, at = terminated or truncated, at + 1
    assert at == len(found.reward)
    if picture is not None:  # what is shown at the end is the end, and not the next beginning
        import io

        from PIL import Image

        assert np.array_equal(np.asarray(Image.open(io.BytesIO(picture))), np.asarray(env.render()))


@pytest.mark.parametrize("env", ["CartPole-v1", "FrozenLake-v1", "TicTacToe"])
def test_where_a_compiled_episode_ended_is_seen(env, tmp_path):
    """And not where the next one begins, which the automatic reset of copies side by side would show."""
    with begin(tmp_path / "data", env) as playing:
        while playing.over is None:
            playing.act(int(np.argmax(playing.allowed)) if playing.allowed is not None else 1)
        inner: Any = COMPILED[env]()
        wanted = [picture_of(inner, playing.observation)]
        if env == "TicTacToe":  # at the end an observation does not tell whose stones are whose
            one, other = playing.observation["board"]
            wanted = [inner.game.draw(one, other), inner.game.draw(other, one)]
        assert playing.picture() in [png(np.asarray(w)) for w in wanted]
        ended = playing.picture()
        playing.begin()
        assert playing.picture() != ended


def test_thrown_away_and_cut(tmp_path):
    with begin(tmp_path / "data", episodes=3) as playing:
        first = playing.observation.copy()
        for _ in range(4):
            playing.act(1)
        assert (playing.step, playing.total, playing.kept) == (4, 4.0, 0)
        playing.discard()  # in progress
        assert (playing.step, playing.total, playing.attempt) == (0, 0.0, 2)
        assert not np.array_equal(playing.observation, first)
        while playing.over is None:
            playing.act(1)
        assert playing.over == "terminated" and playing.kept == 1
        assert load_dataset(tmp_path / "data").num_episodes == 1  # on the disk at once
        playing.discard()  # over, and kept
        assert playing.kept == 0 and read_description(tmp_path / "data")["episodes"] == 0
        with pytest.raises(Damaged, match="has no episodes"):
            load_dataset(tmp_path / "data")
        playing.act(0)
        playing.act(1)
        playing.keep()
        assert playing.over == "cut" and playing.result() == {
            "episodes": 1, "steps": 2, "return_mean": 2.0, "length_mean": 2.0,
        }  # fmt: skip
        playing.begin()
        play_by(balance, playing)
        assert playing.complete and not (tmp_path / "data" / "episodes-00003.safetensors").exists()
    data = load_dataset(tmp_path / "data")
    ends = data.bounds[1:] - 1
    assert data.num_episodes == 3 and data.lengths[0] == 2
    assert data.transitions.truncated[ends].tolist() == [True, False, False]
    assert data.transitions.terminated[ends].tolist() == [False, True, True]
    rows = by_hand("CartPole-v1", balance, 5, [3, 4])
    assert bits(np.stack([r[0] for r in rows])) == bits(data.transitions.observation[2:])


def test_going_on_is_going_on(tmp_path):
    """In two sittings the same starts come as in one, and none comes twice."""
    for name, stops in (("one", [4]), ("two", [1, 3, 4])):
        for episodes in stops:
            with start_playing("CartPole-v1", out=tmp_path / name, episodes=episodes) as playing:
                play_by(balance, playing)
    one, two = (load_dataset(tmp_path / name).transitions for name in ("one", "two"))
    assert bits(one) == bits(two)
    about = read_description(tmp_path / "two")["about"]
    assert (about["begun"], about["seed"], about["env"], about["collector"]) == (
        4,
        0,
        "CartPole-v1",
        {"player": "person"},
    )
    assert about["return_mean"] == pytest.approx(load_dataset(tmp_path / "two").returns.mean())


def test_a_process_that_is_killed_leaves_whole_episodes(tmp_path):
    path = tmp_path / "data"
    with begin(path, episodes=2) as playing:
        playing.act(1)
        playing.keep()
        # Killed after a file was written and before it was named.
        (path / "episodes-00001.safetensors").write_bytes(b"half of an episode")
    assert load_dataset(path).num_episodes == 1
    with begin(path, episodes=2) as playing:
        assert playing.kept == 1 and playing.attempt == 2
        play_by(balance, playing)
    assert load_dataset(path).num_episodes == 2


def test_an_empty_folder_is_not_left_behind(tmp_path):
    with begin(tmp_path / "data"):
        assert (tmp_path / "data" / "dataset.json").exists()
        with pytest.raises(ValueError, match=r"another process adds to .*data: use its page, or stop it first"):
            begin(tmp_path / "data")
    assert not (tmp_path / "data").exists()
    (tmp_path / "data").mkdir()
    with begin(tmp_path / "data"):
        (tmp_path / "data" / "notes.txt").write_text("mine")
    assert [p.name for p in (tmp_path / "data").iterdir()] == ["notes.txt"]


def test_folders_are_numbered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with begin(None) as one, begin(None) as other:
        assert [p.dataset.path.as_posix() for p in (one, other)] == ["datasets/CartPole-v1-1", "datasets/CartPole-v1-2"]


def test_bc_learns_from_it(tmp_path):
    """A clone of a steady player balances the pole where a random network does not."""
    steady = lambda o: int(0.1 * o[0] + 0.4 * o[1] + 3 * o[2] + o[3] > 0)  # noqa: E731
    with begin(tmp_path / "data", episodes=4) as playing:
        play_by(steady, playing)
        assert playing.result()["return_mean"] == 500.0
    learner = BC(network=rtg.MLP(32), learning_rate=3e-3)
    run = rtg.train(
        learner, "CartPole-v1", data=tmp_path / "data", steps=400, out=tmp_path / "run", quiet=True
    )  # fmt: skip
    assert run.evaluation["return_mean"] > 300
    # And DAgger begins from it.
    asking: Any = plan("dagger", "CartPole-v1", data=str(tmp_path / "data"), expert=balance_of_jax).algorithm
    assert asking.demonstrations.num_steps == 2000


def balance_of_jax(observation):
    return (observation[2] > 0).astype(jnp.int32)


# --- what cannot be ----------------------------------------------------------------------------------------------------


def test_wrong_moves(tmp_path):
    with begin(tmp_path / "data") as playing:
        for wrong in (2, -1, 0.5, "left", None, [0], float("nan"), [[1]]):
            with pytest.raises(ValueError, match=r"an action here is a whole number from 0 to 1, not "):
                playing.act(wrong)
        with pytest.raises(ValueError, match=r"no action is taken in this episode yet, so there is nothing to keep"):
            playing.keep()
        with pytest.raises(ValueError, match=r"this episode is not over yet: keep it as it is, or throw it away"):
            playing.begin()
        assert playing.step == 0
        while playing.over is None:
            playing.act(0)
        with pytest.raises(ValueError, match=rf"this episode is over after {playing.step} steps: begin the next one"):
            playing.act(0)
        with pytest.raises(ValueError, match=r"this episode is over and kept already"):
            playing.keep()
        play_by(balance, playing)
        with pytest.raises(ValueError, match=r"all 3 episodes are kept"):
            playing.begin()


def test_bounds_and_masks(tmp_path):
    with begin(tmp_path / "a", "Pendulum-v1") as playing:
        for wrong in ([2.1], 1.0, [0.0, 0.0], [float("inf")]):
            with pytest.raises(ValueError, match=r"an action here is 1 numbers of shape \(1,\) within the bounds"):
                playing.act(wrong)
        playing.act([2.0])
    with begin(tmp_path / "b", "Taxi-v4") as playing:
        assert playing.allowed is not None
        forbidden = int(np.flatnonzero(~playing.allowed)[0])
        with pytest.raises(ValueError, match=rf"action {forbidden} is forbidden here: allowed are \["):
            playing.act(forbidden)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"env": "CartPol-v1"}, r"there is no environment 'CartPol-v1': did you mean CartPole-v1"),
        ({"episodes": 0}, r"there must be at least one episode and at most 1,000,000, not 0"),
        ({"seed": -1}, r"a seed is a whole number from 0 to 2\^32 - 1, not -1"),
        ({"env": "Catch", "backend": "gymnasium"}, r"Catch is not one of Gymnasium's environments"),
        ({"env_kwargs": {"normalise_reward": 0.9}}, r"demonstrations have the environment's own rewards"),
    ],
)
def test_what_is_refused_writes_nothing(options, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        begin(tmp_path / "data", **options)
    assert not (tmp_path / "data").exists()


def test_several_copies_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"one environment can be played at a time, and this has 2 copies"):
        begin(tmp_path / "data", rtg.make("CartPole-v1", 2))


def test_the_data_of_something_else(tmp_path):
    out = tmp_path / "data"
    with begin(out, "FrozenLake-v1", env_kwargs={"is_slippery": False}) as playing:
        play_by(lambda o: 1, playing)
    before = sorted((p.name, p.stat().st_mtime_ns) for p in out.iterdir() if p.name != "lock")
    for options, words in (
        (
            {"env": "CartPole-v1", "env_kwargs": {}},
            r"is a dataset whose env is FrozenLake-v1, and here it is CartPole-v1: give another folder",
        ),
        ({"env_kwargs": {}}, r"whose kwargs is \{'is_slippery': False\}, and here it is \{\}"),
        ({"seed": 6}, r"whose seed is 5, and here it is 6"),
        ({"player": "script"}, r"whose collector is \{'player': 'person'\}, and here it is \{'player': 'script'\}"),
        ({}, r"has 3 episodes already, of the 3 that it is to have in all: ask for more"),
    ):
        with pytest.raises(ValueError, match=words):
            begin(out, **{"env": "FrozenLake-v1", "env_kwargs": {"is_slippery": False}, **options})
    assert before == sorted((p.name, p.stat().st_mtime_ns) for p in out.iterdir() if p.name != "lock")
    # Other spaces under the same name.
    described = json.loads((out / "dataset.json").read_text())
    described["action"]["counts"] = [5]
    (out / "dataset.json").write_text(json.dumps(described))
    with pytest.raises(ValueError, match=r"action space is Discrete\(5\) and the environment's is Discrete\(4\)"):
        begin(out, "FrozenLake-v1", env_kwargs={"is_slippery": False}, episodes=9)
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match=r"file is a file: a dataset is a folder"):
        begin(tmp_path / "file")
    with pytest.raises(Damaged, match=r"is not a dataset: it has no dataset.json"):
        begin(tmp_path)


class Faulty(gymnasium.Env):
    """Raises in its third step."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)
    count = 0

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.count += 1
        if self.count == 3:
            raise ZeroDivisionError("the wheel came off")
        return np.full(2, self.count / 10, np.float32), 1.0, False, False, {}


def test_an_environment_that_raises(tmp_path):
    with begin(tmp_path / "data", Faulty) as playing:
        playing.act(1)
        playing.keep()
        playing.begin()
        playing.act(1)
        playing.act(1)
        with pytest.raises(
            rtg.EnvironmentFailure, match=r"Faulty raised ZeroDivisionError in step after 2 .*the wheel"
        ):
            playing.act(1)
        playing.discard()  # the next episode begins as if nothing had been
        playing.act(0)
        playing.keep()
    assert load_dataset(tmp_path / "data").lengths.tolist() == [1, 1]


# --- time --------------------------------------------------------------------------------------------------------------


class Still(Environment):
    """Nothing moves, and nothing says how fast."""

    @property
    def observation_space(self):
        return spaces.Box(-1, 1, (100,), np.float32)

    @property
    def action_space(self):
        return spaces.Discrete(2)

    def reset(self, key):
        return jnp.zeros(()), jnp.zeros(100)

    def step(self, state, action, key):
        never = jnp.zeros((), bool)
        return state, Timestep(jnp.zeros(100), jnp.zeros(()), never, never, jnp.zeros(100), {})


@pytest.mark.parametrize(
    ("env", "backend", "rate"),
    [
        ("CartPole-v1", "auto", 15.0),
        ("CartPole-v1", "gymnasium", 15.0),
        ("PendulumNoVel-v1", "auto", 15.0),
        ("FrozenLake-v1", "gymnasium", 0.0),
        ("Taxi-v4", "auto", 0.0),
        ("Catch", "auto", 0.0),
        ("TicTacToe", "auto", 0.0),
        (Still(), "auto", 0.0),
    ],
)
def test_what_moves_of_itself_plays_in_time(env, backend, rate, tmp_path):
    with begin(tmp_path / "data", env, backend=backend) as playing:
        assert playable_rate(playing) == rate
