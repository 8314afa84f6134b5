"""Many seeds in groups: the same numbers as side by side, whatever the shapes."""

import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.runner.engine import by_groups


@pytest.mark.parametrize("most", [1, 4, 5, 8, 100])
def test_groups_change_nothing(most):
    seeds = (jnp.arange(8.0), jnp.zeros((8, 0)))  # a discrete policy has a log std without numbers
    found, empty = by_groups(lambda seed: (seed[0] ** 2, seed[1]), seeds, most)
    np.testing.assert_array_equal(found, np.arange(8.0) ** 2)
    assert empty.shape == (8, 0)
