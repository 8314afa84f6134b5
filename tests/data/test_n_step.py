"""n steps as one transition, against the sum written out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import Transition
from rewardtogo.data import n_step

GAMMA = 0.9


def sequences(terminated, truncated) -> Transition:
    """Two sequences of three steps that count up; the flags are given by step for the first one."""
    number = jnp.arange(6.0).reshape(3, 2)
    flags = lambda values: jnp.stack([jnp.asarray(values), jnp.zeros(3, bool)], 1)  # noqa: E731
    action = jnp.arange(6).reshape(3, 2)
    return Transition(
        number, action, number + 1, flags(terminated), flags(truncated), number + 2, {"log_prob": -number}
    )


@pytest.mark.parametrize(
    ("terminated", "truncated", "total", "discount", "following"),
    [
        ((0, 0, 0), (0, 0, 0), 1 + 0.9 * 3 + 0.81 * 5, 0.9**3, 6),
        ((0, 1, 0), (0, 0, 0), 1 + 0.9 * 3, 0.0, 4),
        ((0, 0, 0), (0, 1, 0), 1 + 0.9 * 3, 0.9**2, 4),
        ((1, 0, 0), (0, 1, 0), 1, 0.0, 2),
        ((0, 0, 1), (0, 0, 0), 1 + 0.9 * 3 + 0.81 * 5, 0.0, 6),
    ],
)
def test_by_hand(terminated, truncated, total, discount, following):
    found = n_step(sequences(np.array(terminated, bool), np.array(truncated, bool)), GAMMA)
    assert found.reward[0] == pytest.approx(total, rel=1e-6)
    assert found.extras["discount"][0] == pytest.approx(discount, rel=1e-6)
    assert found.next_observation[0] == following
    end = int(np.argmax(np.add(terminated, truncated))) if np.any(np.add(terminated, truncated)) else 2
    assert bool(found.terminated[0]) == bool(terminated[end]) and bool(found.truncated[0]) == bool(truncated[end])
    # The second sequence has no end, whatever the first one has.
    assert found.reward[1] == pytest.approx(2 + 0.9 * 4 + 0.81 * 6, rel=1e-6) and found.next_observation[1] == 7
    assert found.observation.tolist() == [0, 1] and found.action.tolist() == [0, 1]
    assert found.extras["log_prob"].tolist() == [0, -1]


def test_one_step_is_the_transition():
    t = jax.tree.map(lambda x: x[:1], sequences(np.array([1, 0, 0], bool), np.zeros(3, bool)))
    found = n_step(t, GAMMA)
    for name in ("observation", "action", "reward", "terminated", "truncated", "next_observation"):
        assert np.array_equal(getattr(found, name), getattr(t, name)[0])
    assert found.extras["discount"].tolist() == pytest.approx([0.0, 0.9])
