"""What a labeller sees is what was observed: pictures against Gymnasium's own at the same moment, boards, numbers with their names."""

import io

import gymnasium
import numpy as np
import pytest
from PIL import Image

from rewardtogo.core import Spec
from rewardtogo.label import start_labelling
from rewardtogo.label.actions import ACTIONS
from rewardtogo.label.pictures import Numbers, Painter, Pictures

pytest.importorskip("pygame", reason="pictures need the extra render")


def pictures_of(env: str, tmp_path, size: int = 4):
    learner = {"network": {"sizes": [4]}}
    loop = {"updates": 1, "batch_size": 2}
    return start_labelling(env, out=tmp_path / "run", size=size, rounds=1, learner=learner, loop=loop, quiet=True)


@pytest.mark.parametrize("name", ["CartPole-v1", "MountainCar-v0", "Pendulum-v1", "Acrobot-v1", "FrozenLake-v1"])
def test_a_picture_is_that_of_the_original(name, tmp_path):
    with pictures_of(name, tmp_path) as run:
        batch, original = run.round, gymnasium.make(name, render_mode="rgb_array")
        assert batch is not None
        pictures = Pictures(run)
        seen, _ = original.reset(seed=3)
        original.action_space.seed(0)
        for index in range(4):
            for _ in range(1 if name == "FrozenLake-v1" else 4):
                seen, _, terminated, truncated, _ = original.step(original.action_space.sample())
                if terminated or truncated:
                    seen, _ = original.reset()
            batch.queue.observations = np.array(batch.queue.observations)
            batch.queue.observations[index] = seen
            if name == "FrozenLake-v1":
                original.unwrapped.lastaction = None
            if name == "Pendulum-v1":
                original.unwrapped.last_u = None  # the arrow of what was done last
            ours = np.asarray(Image.open(io.BytesIO(pictures.png(batch, index) or b"")), float)
            theirs = np.asarray(original.render(), float)
            # An observation is rounded to 32 bits: an edge may fall to the next point.
            assert ours.shape == theirs.shape and np.mean(np.abs(ours - theirs) > 8) < 2e-3
            assert np.mean(np.any(ours != ours[0, 0], axis=-1)) > 0.005
        pictures.close()
        original.close()


def test_boards_and_what_has_no_picture(tmp_path):
    with pictures_of("Catch", tmp_path / "a") as run:
        assert run.round is not None
        picture = np.asarray(Image.open(io.BytesIO(Pictures(run).png(run.round, 0) or b"")))
        board = np.asarray(run.round.queue.observations[0])[..., 0]
        scale = picture.shape[1] // board.shape[1]
        assert scale >= 32 and np.array_equal(picture[scale // 2 :: scale, scale // 2 :: scale, 0], board)
    with pictures_of("OneStep", tmp_path / "b") as run:
        assert run.round is not None and Pictures(run).png(run.round, 0) is None


def test_the_stones_of_both_players(tmp_path):
    spec = Spec("box", (2, 6, 7), "int8", (0.0,), (1.0,))
    painter = Painter({"id": "ConnectFour", "backend": "jax", "by_name": True, "kwargs": {}}, spec)
    board = np.zeros((2, 6, 7), np.int8)
    board[0, 0, 1] = board[1, 1, 6] = 1  # row 0 is the lowest
    picture = np.asarray(Image.open(io.BytesIO(painter.png(board) or b"")), int)
    scale = picture.shape[1] // 7
    middle = picture[scale // 2 :: scale, scale // 2 :: scale]
    blue, red = (middle[..., i] > 180 for i in (2, 0))
    assert middle.shape == (6, 7, 3)
    assert np.argwhere(blue & ~red).tolist() == [[5, 1]] and np.argwhere(red & ~blue).tolist() == [[4, 6]]


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
    from rewardtogo.core.spec import from_space
    from rewardtogo.envs.registry import COMPILED

    if name in COMPILED:
        spec = from_space(COMPILED[name]().action_space)
    else:
        pytest.importorskip("Box2D")
        spec = from_space(gymnasium.make(name).action_space)
    assert len(ACTIONS[name]) == (spec.counts[0] if spec.kind == "discrete" else spec.size)
