"""Feature points: places by hand, points that move as a picture does, and positions linear in them before anything is learned."""

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.core import from_space
from rewardtogo.envs.pixel_double_integrator import picture
from rewardtogo.nn import FeaturePoints, feature_points

KEY = jax.random.key(0)
SPEC = from_space(spaces.Box(0, 255, (16, 16, 1), np.uint8))


def test_points_by_hand():
    """A sharp peak is its place; no response at all is the middle; two equal peaks are in between. Strengths by numpy."""
    responses = np.zeros((5, 9, 3), np.float32)
    responses[1, 6, 0] = 1.0
    responses[0, 0, 2] = responses[4, 8, 2] = 1.0
    x, y, strength = np.asarray(feature_points(jnp.asarray(responses), jnp.full(3, 200.0)))
    assert np.allclose(x, [0.5, 0.0, 0.0], atol=1e-5) and np.allclose(y, [-0.5, 0.0, 0.0], atol=1e-5)
    assert np.allclose(strength, [200 - np.log(45), 0.0, 200 + np.log(2) - np.log(45)], atol=1e-3)
    soft = np.exp(responses[..., 0]) / np.exp(responses[..., 0]).sum()
    x, y, _ = np.asarray(feature_points(jnp.asarray(responses), jnp.ones(3)))
    assert x[0] == pytest.approx((soft * np.linspace(-1, 1, 9)).sum(), abs=1e-6)
    assert y[0] == pytest.approx((soft * np.linspace(-1, 1, 5)[:, None]).sum(), abs=1e-6)


def test_positions_are_linear_in_them():
    """Of random filters: what dense layers after convolutions have to learn is there from the start."""
    torso = FeaturePoints((16,), (3,), (1,)).build(SPEC, KEY)
    places = jnp.asarray(np.random.default_rng(0).uniform(-1.5, 1.5, (400, 2)), jnp.float32)
    seen = jax.jit(jax.vmap(lambda p: torso((), picture(p, 16))[1]))(places)
    assert seen.shape == (400, torso.features) == (400, 48)
    inputs, wanted = np.concatenate([seen[:, :32], np.ones((400, 1))], 1), np.asarray(places)
    weights = np.linalg.lstsq(inputs[:300], wanted[:300], rcond=None)[0]
    left = ((inputs[300:] @ weights - wanted[300:]) ** 2).mean() / wanted.var()
    assert left < 0.02


def test_other_parts_join_and_layers_follow():
    spec = from_space(spaces.Dict({"a": spaces.Box(0, 255, (8, 8, 3), np.uint8), "b": spaces.Box(-1, 1, (2,))}))
    torso = FeaturePoints((4, 5), (3, 3), (1, 1), (7,)).build(spec, KEY)
    assert torso.features == 7 and torso.layers[0].weight.shape == (7, 3 * 5 + 2)
    observation = spec.zeros()
    assert torso((), observation)[1].shape == (7,) and torso.init() == ()
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(torso))


def test_refusals_and_the_name():
    with pytest.raises(ValueError, match="needs pictures"):
        FeaturePoints().build(from_space(spaces.Box(-1, 1, (3,))), KEY)
    with pytest.raises(ValueError, match="at least one convolution"):
        FeaturePoints((), (), ())
    with pytest.raises(ValueError, match="as many channels"):
        FeaturePoints((4, 4), (3,), (1,))
    assert not FeaturePoints().has_memory and rtg.FeaturePoints is FeaturePoints
