import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType

import rewardtogo as rtg
from algorithms_under_test import ALGORITHMS_UNDER_TEST
from rewardtogo.loops import shard


def mesh(kind: AxisType = AxisType.Auto):
    return jax.make_mesh((2,), ("devices",), axis_types=(kind,), devices=jax.devices()[:2])


def test_shard_spreads_what_divides():
    with jax.set_mesh(mesh()):
        out = jax.jit(shard)(
            {"even": jnp.ones((4, 3)), "odd": jnp.ones(3), "one": jnp.ones(()), "none": jnp.ones((0, 2))}
        )
        second = jax.jit(lambda x: shard(x, axis=1))(jnp.ones((3, 4)))
    whole = {name: value.sharding.is_fully_replicated for name, value in out.items()}
    assert whole == {"even": False, "odd": True, "one": True, "none": True}
    assert second.sharding.shard_shape((3, 4)) == (3, 2)


def test_an_explicit_mesh_is_refused():
    with jax.set_mesh(mesh(AxisType.Explicit)), pytest.raises(ValueError, match="axis_types"):
        shard(jnp.ones(4))


@pytest.mark.parametrize("name", ["ppo", pytest.param("dqn", marks=pytest.mark.slow)])
def test_a_run_on_two_devices_is_the_run_on_one(name):
    """Through the engine, in several chunks: what a chunk gives back lies where the next one takes it."""
    train = lambda: rtg.run(ALGORITHMS_UNDER_TEST[name](), jax.random.key(0), 3, row_every=1, chunk_seconds=1e-6)  # noqa: E731
    alone, _ = train()
    with jax.set_mesh(mesh()):
        together, _ = train()
    assert not together.actor.observation.sharding.is_fully_replicated
    for a, b in zip(jax.tree.leaves(alone.learner), jax.tree.leaves(together.learner), strict=True):
        np.testing.assert_allclose(a, np.asarray(b), atol=1e-4)
