import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import MASK, from_space
from rewardtogo.nn import MLP, RunningNorm, action_mask, flat_size, flatten_observation, has_images


@pytest.mark.parametrize(
    ("space", "observation", "expected"),
    [
        (spaces.Box(-1, 1, (2,), np.float32), jnp.asarray([0.5, -0.25]), [0.5, -0.25]),
        (spaces.Box(-1, 1, (2, 1), np.float32), jnp.asarray([[0.5], [-0.25]]), [0.5, -0.25]),
        (spaces.Box(0, 255, (2,), np.uint8), jnp.asarray([0, 51], jnp.uint8), [0.0, 0.2]),
        (spaces.Discrete(3), jnp.asarray(1, jnp.int32), [0, 1, 0]),
        (spaces.Discrete(3, start=5), jnp.asarray(2, jnp.int32), [0, 0, 1]),
        (spaces.MultiDiscrete([2, 3]), jnp.asarray([1, 0], jnp.int32), [0, 1, 1, 0, 0]),
        (spaces.MultiBinary(3), jnp.asarray([1, 0, 1], jnp.int8), [1, 0, 1]),
        (
            spaces.Tuple((spaces.Discrete(2), spaces.MultiBinary(1))),
            {"0": jnp.asarray(0), "1": jnp.ones(1, jnp.int8)},
            [1, 0, 1],
        ),
        (
            spaces.Dict(
                {"b": spaces.Discrete(2), "a": spaces.Box(0, 1, (1,), np.float32), MASK: spaces.MultiBinary(2)}
            ),
            {"a": jnp.asarray([0.5]), "b": jnp.asarray(1), MASK: jnp.ones(2, jnp.int8)},
            [0.5, 0, 1],
        ),
    ],
)
def test_flatten(space, observation, expected):
    spec = from_space(space)
    flat = flatten_observation(spec, observation)
    np.testing.assert_allclose(flat, expected, atol=1e-7)
    assert flat.dtype == jnp.float32
    assert flat_size(spec) == len(expected)
    assert not has_images(spec)


def test_the_mask_is_found_where_there_is_one():
    assert action_mask(jnp.zeros(2)) is None
    assert action_mask({"a": jnp.zeros(2)}) is None
    assert action_mask({MASK: jnp.ones(2)}).shape == (2,)


def test_an_observation_that_is_only_a_mask_is_refused():
    spec = from_space(spaces.Dict({MASK: spaces.MultiBinary(2)}))
    with pytest.raises(ValueError, match="mask"):
        MLP(4).build(spec, jax.random.key(0))


# --- running statistics ----------------------------------------------------------------------------------------------


SPEC = from_space(
    spaces.Dict(
        {"x": spaces.Box(-9, 9, (3,), np.float32), "n": spaces.Discrete(2), "p": spaces.Box(0, 255, (2,), np.uint8)}
    )
)


def batch(seed: int, *shape: int) -> dict[str, jax.Array]:
    rng = np.random.default_rng(seed)
    x = rng.normal([1.0, -2.0, 30.0], [1.0, 0.1, 5.0], (*shape, 3))
    return {"x": jnp.asarray(x, jnp.float32), "n": jnp.ones(shape, jnp.int32), "p": jnp.ones((*shape, 2), jnp.uint8)}


def test_statistics_are_those_of_all_the_data():
    batches = [batch(0, 7, 4), batch(1, 1, 4), batch(2, 50)]
    norm = RunningNorm.of(SPEC)
    assert set(norm.mean) == {"x"}
    for observations in batches:
        norm = norm.update(observations)
    data = np.concatenate([np.asarray(b["x"], np.float64).reshape(-1, 3) for b in batches])
    np.testing.assert_allclose(norm.mean["x"], data.mean(0), rtol=1e-6)
    np.testing.assert_allclose(norm.square["x"] / norm.count, data.var(0), rtol=1e-5)
    assert norm.count == len(data)
    one = {"x": batches[0]["x"][0, 0], "n": jnp.asarray(1), "p": jnp.ones(2, jnp.uint8)}
    seen = norm(one)
    np.testing.assert_allclose(seen["x"], (np.asarray(one["x"]) - data.mean(0)) / data.std(0), rtol=1e-4, atol=1e-5)
    assert seen["n"] is one["n"]
    assert seen["p"] is one["p"]


def test_merging_is_exact_in_float64():
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        data = rng.normal(1e3, 1.0, (60, 1))
        norm = RunningNorm({"": jnp.zeros(1)}, {"": jnp.zeros(1)}, jnp.zeros(()))
        for part in np.split(data, [1, 2, 9, 30]):
            norm = norm.update(jnp.asarray(part))
        np.testing.assert_allclose(norm.mean[""], data.mean(0), rtol=1e-14)
        np.testing.assert_allclose(norm.square[""] / 60, data.var(0), rtol=1e-12)


def test_statistics_of_nothing_change_nothing_but_clip():
    spec = from_space(spaces.Box(-99, 99, (2,), np.float32))
    norm = RunningNorm.of(spec)
    np.testing.assert_allclose(norm(jnp.asarray([0.5, 50.0])), [0.5, 10.0], rtol=1e-6)


def test_a_constant_part_stays_finite():
    spec = from_space(spaces.Box(-99, 99, (1,), np.float32))
    norm = RunningNorm.of(spec).update(jnp.full((8, 1), 3.0))
    np.testing.assert_array_equal(norm(jnp.asarray([3.0])), 0.0)
