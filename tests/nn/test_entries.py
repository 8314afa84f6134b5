"""A network that sees some entries only."""

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import from_space
from rewardtogo.nn import GRU, LSTM, MLP, Entries
from rewardtogo.nn.entries import entries_of

SPEC = from_space(spaces.Box(np.array([-1, -2, -3, -4], np.float32), np.array([1, 2, 3, np.inf], np.float32)))


def test_it_is_the_network_of_these_entries(key):
    torso, alone = Entries((2, 0), MLP(5)).build(SPEC, key), MLP(5).build(from_space(spaces.Box(-1, 1, (2,))), key)
    x = jnp.asarray([0.1, 0.2, 0.3, 0.4])
    assert torso.features == 5 and torso.init() == ()
    assert np.array_equal(torso((), x)[1], alone((), x[jnp.asarray([2, 0])])[1])
    blind = jax.grad(lambda x: torso((), x)[1].sum())(x)
    assert not blind[1] and not blind[3] and blind[0] and blind[2]
    left = entries_of(SPEC, (2, 0))
    assert np.array_equal(left.low, [-3, -1]) and np.array_equal(left.high, [3, 1])


def test_a_memory_inside_remembers(key):
    assert Entries((1,), GRU(4)).has_memory and not Entries((1,)).has_memory
    torso = Entries((1,), LSTM(4, MLP(3))).build(SPEC, key)
    carry, _ = torso(torso.init(), jnp.ones(4))
    assert jax.tree.map(jnp.shape, carry) == jax.tree.map(jnp.shape, torso.init())
    assert any(np.any(x != y) for x, y in zip(jax.tree.leaves(carry), jax.tree.leaves(torso.init()), strict=True))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda key: Entries(()), "at least one of them"),
        (lambda key: Entries((1, 1)), "distinct entries"),
        (lambda key: Entries((4,)).build(SPEC, key), "are 0 to 3"),
        (lambda key: Entries((0,)).build(from_space(spaces.Discrete(3)), key), "this observation is discrete"),
        (lambda key: Entries((0,)).build(from_space(spaces.Box(0, 1, (2, 2))), key), r"a box of shape \(2, 2\)"),
    ],
)
def test_what_is_refused(make, words, key):
    with pytest.raises(ValueError, match=words):
        make(key)
