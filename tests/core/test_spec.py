import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import EnvSpec, Spec, from_space, require_action

SPACES = {
    "box": spaces.Box(-2.0, 3.0, (2,), np.float32),
    "uneven": spaces.Box(np.array([-1, -np.inf], np.float32), np.array([1, np.inf], np.float32)),
    "open": spaces.Box(-np.inf, np.inf, (2, 2), np.float32),
    "half": spaces.Box(0.0, np.inf, (3,), np.float32),
    "image": spaces.Box(0, 255, (4, 5, 3), np.uint8),
    "discrete": spaces.Discrete(3),
    "shifted": spaces.Discrete(3, start=-1),
    "multi": spaces.MultiDiscrete([2, 4]),
    "table": spaces.MultiDiscrete([[2, 4], [3, 2]], start=[[1, 0], [0, 2]]),
    "bits": spaces.MultiBinary(4),
    "dict": spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Dict({"x": spaces.Box(0, 1, (1,), np.float32)})}),
}


@pytest.mark.parametrize("name", SPACES)
def test_a_spec_is_hashable_and_comes_back_from_space_and_json(name):
    spec = from_space(SPACES[name])
    assert hash(spec) == hash(from_space(SPACES[name]))
    assert from_space(spec.to_space()) == spec
    assert Spec.from_json(spec.to_json()) == spec


@pytest.mark.parametrize("name", SPACES)
def test_samples_are_elements(name):
    space = SPACES[name]
    spec = from_space(space)
    draw = jax.jit(lambda key: jax.vmap(spec.sample)(jax.random.split(key, 64)))(jax.random.key(0))
    for i in range(64):
        element = jax.tree.map(lambda x: np.asarray(x[i]), draw)  # noqa: B023
        if spec.kind == "dict":
            assert spec.to_space().contains(element)
        else:
            start = np.asarray(spec.start).reshape(spec.shape) if spec.start else 0
            assert space.contains((element + start).astype(space.dtype))
    zeros = spec.zeros()
    assert jax.tree.map(jnp.shape, zeros) == jax.tree.map(lambda x: x.shape[1:], draw)


def test_every_choice_is_drawn_and_none_beside():
    spec = from_space(SPACES["table"])
    draw = np.asarray(jax.vmap(spec.sample)(jax.random.split(jax.random.key(0), 200)))
    np.testing.assert_array_equal(draw.max(0), np.array([[1, 3], [2, 1]]))
    np.testing.assert_array_equal(draw.min(0), 0)


def test_tuples_and_nesting_are_flat_with_dotted_sorted_names():
    space = spaces.Dict({"z": spaces.Tuple((spaces.Discrete(2), spaces.MultiBinary(3))), "a": spaces.Discrete(4)})
    spec = from_space(space)
    assert [name for name, _ in spec.parts] == ["a", "z.0", "z.1"]
    assert spec.size == 5


def test_clip_gives_the_nearest_element():
    spec = from_space(SPACES["uneven"])
    np.testing.assert_array_equal(spec.clip(jnp.asarray([5.0, -7.0])), [1.0, -7.0])
    discrete = from_space(SPACES["discrete"])
    assert discrete.clip(jnp.asarray(2)) == 2


def test_shortest_bounds():
    assert from_space(SPACES["box"]).low == (-2.0,)
    low, high = from_space(SPACES["box"]).bounds()
    assert low.shape == high.shape == (2,)
    assert from_space(SPACES["box"]).is_bounded
    assert not from_space(SPACES["half"]).is_bounded
    assert from_space(SPACES["image"]).is_image


@pytest.mark.parametrize("space", [spaces.Text(4), spaces.Sequence(spaces.Discrete(2)), spaces.Dict({})])
def test_a_space_without_a_fixed_shape_is_refused(space):
    with pytest.raises(ValueError, match="space") as error:
        from_space(space)
    assert "\n" not in str(error.value)


def test_an_action_space_that_does_not_fit_names_those_that_do():
    spec = EnvSpec(from_space(SPACES["box"]), from_space(SPACES["multi"]))
    with pytest.raises(ValueError, match="DQN chooses discrete actions, and this environment wants multi-discrete"):
        require_action("DQN", spec, ("discrete",))


@pytest.mark.parametrize("data", [{}, {"kind": "box", "colour": 1}, {"shape": [1]}])
def test_json_that_is_no_spec_is_refused(data):
    with pytest.raises(ValueError, match="not the description"):
        Spec.from_json(data)
