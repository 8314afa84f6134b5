import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithms_under_test import first_gradient, jit
from rewardtogo.core import from_space
from rewardtogo.nn import CNN, GRU, LSTM, MLP, Custom, Linear, Optimiser, as_network, flatten_observation, global_norm
from rewardtogo.nn.network import convolve

KEY = jax.random.key(0)
VECTOR = from_space(spaces.Box(-1, 1, (3,), np.float32))
IMAGE = from_space(spaces.Box(0, 255, (12, 10, 3), np.uint8))
BOTH = from_space(
    spaces.Dict({"eye": spaces.Box(0, 255, (12, 10, 3), np.uint8), "way": spaces.Box(-1, 1, (2,), np.float32)})
)


@pytest.mark.parametrize(
    ("network", "spec", "features"),
    [
        (MLP(5, 7), VECTOR, 7),
        (MLP(), VECTOR, 3),
        (MLP(6), IMAGE, 6),
        (CNN(sizes=(9,)), IMAGE, 9),
        (CNN((4,), (3,), (2,), ()), IMAGE, 5 * 4 * 4),
        (CNN((4,), (3,), (2,), (6,)), BOTH, 6),
        (GRU(5, MLP(4)), VECTOR, 5),
        (LSTM(5, CNN((2,), (3,), (2,), (3,))), IMAGE, 5),
        (GRU(5), VECTOR, 5),
    ],
)
def test_shapes(network, spec, features):
    assert hash(network) == hash(network)
    torso, (carry, out) = jit(lambda key: (torso := network.build(spec, key), torso(torso.init(), spec.zeros())))(KEY)
    assert torso.features == features
    assert all(eqx.is_array(leaf) for leaf in jax.tree.leaves(torso))
    assert network.has_memory == bool(jax.tree.leaves(torso.init()))
    assert out.shape == (features,)
    assert out.dtype == jnp.float32
    assert jax.tree.map(jnp.shape, carry) == jax.tree.map(jnp.shape, torso.init())


def test_an_mlp_is_what_it_says():
    torso = MLP(5, 4, activation="relu").build(VECTOR, KEY)
    x = np.array([0.3, -0.2, 0.9], np.float32)
    expected = x
    for layer in torso.layers:
        expected = np.maximum(np.asarray(layer.weight) @ expected + np.asarray(layer.bias), 0)
    np.testing.assert_allclose(torso((), jnp.asarray(x))[1], expected, atol=1e-6)


def test_a_convolution_is_what_it_says():
    torso = CNN((2,), (3,), (2,), ()).build(IMAGE, KEY)
    picture = np.asarray(jax.random.randint(KEY, (12, 10, 3), 0, 256)).astype(np.uint8)
    weight = np.asarray(torso.stacks[0][0].weight).reshape(2, 3, 3, 3)  # channel, row, column, depth
    expected = np.zeros((5, 4, 2))
    for i in range(5):
        for j in range(4):
            patch = picture[2 * i : 2 * i + 3, 2 * j : 2 * j + 3].astype(np.float64) / 255
            expected[i, j] = np.maximum((weight * patch).sum((1, 2, 3)), 0)
    np.testing.assert_allclose(torso((), jnp.asarray(picture))[1], expected.ravel(), atol=1e-5)


@pytest.mark.parametrize("shape", [(3, 5), (5, 3), (4, 4)])
@pytest.mark.parametrize("gain", [0.01, np.sqrt(2.0)])
def test_weights_are_orthogonal(shape, gain):
    layer = Linear.of(shape[1], shape[0], KEY, gain)
    weight = np.asarray(layer.weight)
    gram = weight @ weight.T if shape[0] <= shape[1] else weight.T @ weight
    np.testing.assert_allclose(gram, gain**2 * np.eye(min(shape)), atol=1e-6)
    np.testing.assert_array_equal(layer.bias, 0)


@pytest.mark.parametrize(
    "make",
    [
        lambda: MLP(0),
        lambda: MLP(True),
        lambda: MLP(3, activation="sinus"),
        lambda: CNN((4, 4), (3,), (2,)),
        lambda: CNN((4,), (0,), (2,)),
        lambda: GRU(0),
        lambda: LSTM(-1),
        lambda: GRU(4, LSTM(4)),
        lambda: CNN().build(VECTOR, KEY),
        lambda: as_network("mlp"),
        lambda: as_network(3),
    ],
)
def test_a_wrong_recipe_is_refused_in_one_sentence(make):
    with pytest.raises(ValueError) as error:
        make()
    assert "\n" not in str(error.value)
    assert len(str(error.value)) > 20


# --- networks of somebody else ---------------------------------------------------------------------------------------


class Mine(eqx.Module):
    weight: jax.Array
    table: np.ndarray
    name: str = "mine"

    def __call__(self, x: jax.Array) -> jax.Array:
        return jnp.tanh(self.weight @ x) + self.table


MADE = {
    "module": Mine(jnp.ones((4, 3)), np.ones(4, np.float32)),
    "equinox": eqx.nn.MLP(3, 4, 8, 1, key=KEY),
    "function": lambda spec, key: eqx.nn.MLP(spec.size, 4, 8, 1, key=key),
    "sequential": lambda spec, key: eqx.nn.Sequential([eqx.nn.Linear(3, 4, key=key), eqx.nn.Lambda(jnp.tanh)]),
}


@pytest.mark.parametrize("name", MADE)
def test_a_network_of_your_own(name):
    network = as_network(MADE[name])
    torso = jit(lambda key: network.build(VECTOR, key))(KEY)
    assert torso.features == 4
    assert all(eqx.is_array(leaf) for leaf in jax.tree.leaves(torso))
    x = jnp.asarray([0.1, 0.2, 0.3])
    out = jit(lambda t, x: t((), x)[1])(torso, x)
    module = MADE[name] if isinstance(MADE[name], eqx.Module) else MADE[name](VECTOR, KEY)
    np.testing.assert_allclose(out, module(x), atol=1e-6)
    gradient = jax.grad(lambda t: t((), x)[1].sum())(torso)
    assert max(float(jnp.abs(g).max()) for g in jax.tree.leaves(gradient)) > 0


def test_a_function_gives_each_seed_its_own_parameters():
    torsos = [as_network(MADE["function"]).build(VECTOR, jax.random.key(seed)) for seed in (0, 1)]
    first, second = (jax.tree.leaves(torso)[0] for torso in torsos)
    assert not np.array_equal(first, second)


def test_a_network_of_your_own_sees_the_observation_as_it_is():
    build = lambda spec, key: lambda o: flatten_observation(spec, o)  # noqa: E731
    torso = as_network(build).build(BOTH, KEY)
    assert torso.features == 12 * 10 * 3 + 2


@pytest.mark.parametrize(
    "wrong",
    [
        eqx.nn.MLP(5, 4, 8, 1, key=KEY),  # another observation
        lambda spec, key: eqx.nn.MLP(3, "scalar", 8, 1, key=key),  # no vector
        lambda spec, key: lambda x: (x, x),
        lambda spec, key: jnp.ones(3),  # no function
        lambda spec, key: None,
        lambda spec: eqx.nn.MLP(3, 4, 8, 1, key=KEY),  # no key
        eqx.nn.MLP,  # a class
    ],
)
def test_a_wrong_network_is_refused_in_one_sentence(wrong):
    with pytest.raises(ValueError, match="network") as error:
        as_network(wrong).build(VECTOR, KEY)
    assert "\n" not in str(error.value)


def test_custom_modules_are_static_where_they_are_no_arrays():
    assert isinstance(as_network(MADE["module"]), Custom)
    assert hash(jax.tree.structure(as_network(MADE["module"])))


# --- gradient descent ------------------------------------------------------------------------------------------------


def test_adam_clips_by_the_global_norm():
    """The first step of Adam is the rate times the sign, whatever the clipping; its moments show the clipped gradient."""
    parameters = {"a": jnp.zeros(2), "b": jnp.zeros(1)}
    gradient = {"a": jnp.asarray([3.0, -4.0]), "b": jnp.asarray([12.0])}
    assert global_norm(gradient) == pytest.approx(13.0)
    adam = Optimiser(0.1, 1.0, eps=0.0)
    new, state = adam.step(parameters, gradient, adam.init(parameters))
    np.testing.assert_allclose(new["a"], [-0.1, 0.1], rtol=1e-5)
    seen = first_gradient(state, parameters)
    np.testing.assert_allclose(seen["a"], np.array([3.0, -4.0]) / 13.0, rtol=1e-5)


def test_global_norm_of_nothing_is_zero():
    assert global_norm({"a": jnp.zeros(0)}) == 0.0


@pytest.mark.parametrize(
    ("shape", "kernel", "stride"),
    [((84, 84, 4), 8, 4), ((10, 5, 1), 3, 1), ((11, 9, 2), 3, 2), ((9, 8, 3), 2, 3), ((7, 7, 1), 7, 5)],
)
def test_a_convolution_is_that_of_xla(shape, kernel, stride):
    """Kernels that are whole cells and such that are not, pictures with rows to spare and without; gradients too."""
    keys = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(keys[0], shape)
    layer = Linear(jax.random.normal(keys[1], (5, kernel * kernel * shape[-1])), jax.random.normal(keys[2], (5,)))

    def theirs(x, layer):
        filters = layer.weight.reshape(5, kernel, kernel, shape[-1]).transpose(1, 2, 3, 0)
        numbers = ("NHWC", "HWIO", "NHWC")
        y = jax.lax.conv_general_dilated(x[None], filters, (stride, stride), "VALID", dimension_numbers=numbers)[0]
        return y + layer.bias[None, None]

    def both(x, layer):
        square = lambda f: lambda x, layer: (f(x, layer) ** 2).sum()  # noqa: E731
        ours = lambda x, layer: convolve(x, layer, stride)  # noqa: E731
        return [(f(x, layer), jax.grad(square(f), (0, 1))(x, layer)) for f in (ours, theirs)]

    a, b = jax.jit(both)(x, layer)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4 * float(jnp.abs(other).max()))
