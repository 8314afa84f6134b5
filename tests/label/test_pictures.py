"""What a labeller sees is what was observed: pictures against those of the state at the same moment, boards, numbers with their names."""

import io

import gymnasium
import jax
import numpy as np
import pytest
from PIL import Image

from rewardtogo.core import MASK, from_space
from rewardtogo.envs.drawing import picture
from rewardtogo.envs.registry import COMPILED
from rewardtogo.label import start_labelling
from rewardtogo.label.actions import ACTIONS
from rewardtogo.label.pictures import Numbers, Pictures


def pictures_of(env: str, tmp_path, size: int = 4):
    learner = {"network": {"sizes": [4]}}
    loop = {"updates": 1, "batch_size": 2}
    return start_labelling(env, out=tmp_path / "run", size=size, rounds=1, learner=learner, loop=loop, quiet=True)


@pytest.mark.parametrize(
    "name",
    [
        "CartPole-v1",
        "CartPoleNoVel-v1",
        "MountainCar-v0",
        "Pendulum-v1",
        "Acrobot-v1",
        "FrozenLake-v1",
        "Taxi-v4",
        "TicTacToe",
    ],
)
def test_a_picture_is_that_of_the_state(name, tmp_path):
    env = COMPILED[name]()
    reset, step = jax.jit(lambda k: env.reset(k)), jax.jit(lambda s, a, k: env.step(s, a, k))
    spec = from_space(env.action_space)
    with pictures_of(name, tmp_path) as run:
        batch = run.round
        assert batch is not None
        pictures = Pictures(run)
        batch.queue.observations = jax.tree.map(np.array, batch.queue.observations)
        state, seen = reset(jax.random.key(3))
        for index in range(4):
            for turn in range(1 if isinstance(seen, dict) else 3):
                key = jax.random.key(10 * index + turn)
                action = np.argmax(seen[MASK]) if isinstance(seen, dict) else spec.sample(key)
                state, timestep = step(state, action, key)
                if timestep.done:
                    state, seen = reset(key)
                else:
                    seen = timestep.observation
            for kept, new in zip(jax.tree.leaves(batch.queue.observations), jax.tree.leaves(seen), strict=True):
                kept[index] = new
            ours = np.asarray(Image.open(io.BytesIO(pictures.png(batch, index) or b"")), float)
            theirs = np.asarray(picture(env, state, seen), float)
            # The arc tangent of what was observed is rounded: an edge may fall to the next point.
            assert ours.shape == theirs.shape and np.mean(np.abs(ours - theirs) > 8) < 1e-3
            assert np.mean(np.any(ours != ours[-1, -1], axis=-1)) > 0.005
        assert pictures.png(batch, 0) is pictures.png(batch, 0)
        pictures.close()


def test_boards_and_what_has_no_picture(tmp_path):
    with pictures_of("Catch", tmp_path / "a") as run:
        assert run.round is not None
        picture = np.asarray(Image.open(io.BytesIO(Pictures(run).png(run.round, 0) or b"")))
        board = np.asarray(run.round.queue.observations[0])[..., 0]
        scale = picture.shape[1] // board.shape[1]
        assert scale >= 32 and np.array_equal(picture[scale // 2 :: scale, scale // 2 :: scale, 0], board)
    with pictures_of("OneStep", tmp_path / "b") as run:
        assert run.round is not None and Pictures(run).png(run.round, 0) is None


def test_numbers(tmp_path):
    with pictures_of("CartPole-v1", tmp_path) as run:
        assert run.round is not None
        seen = np.array([[1.0, 20.0, 0.1, -3.0], [0.0, -20.0, 0.0, 5.0]], np.float32)
        numbers = Numbers(run.algorithm.spec, "CartPole-v1")
        numbers.see(seen)
        shown = numbers.of(seen[0])
        assert [n["name"] for n in shown] == ["position", "velocity", "angle", "angular velocity"]
        assert [n["value"] for n in shown] == pytest.approx([1.0, 20.0, 0.1, -3.0])
        # A velocity has no bounds, so that the batch gives them.
        assert [(n["low"], n["high"]) for n in shown][:2] == [pytest.approx((-4.8, 4.8)), (-20.0, 20.0)]


@pytest.mark.parametrize("name", sorted(ACTIONS))
def test_actions_have_the_right_number_of_names(name):
    if name in COMPILED:
        spec = from_space(COMPILED[name]().action_space)
    else:
        pytest.importorskip("Box2D")
        spec = from_space(gymnasium.make(name).action_space)
    assert len(ACTIONS[name]) == (spec.counts[0] if spec.kind == "discrete" else spec.size)
