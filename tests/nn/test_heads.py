import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithms_under_test import jit
from rewardtogo.core import from_space
from rewardtogo.nn import ActionHead
from rewardtogo.nn.heads import centre, half_width

KEY = jax.random.key(0)
SPACES = [
    spaces.Discrete(3),
    spaces.MultiDiscrete([2, 3]),
    spaces.MultiDiscrete([[2, 3], [4, 2]]),
    spaces.MultiBinary(3),
    spaces.MultiBinary((2, 2)),
    spaces.Box(-2.0, 4.0, (2,), np.float32),
    spaces.Box(-np.inf, np.inf, (2, 2), np.float32),
    spaces.Box(np.array([0.0, -np.inf], np.float32), np.array([1.0, np.inf], np.float32)),
]


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_every_space_has_a_law_over_its_elements(space):
    spec = from_space(space)

    @jit
    def everything(key):
        law = ActionHead.of(4, spec, key)(jnp.ones(4))
        action, log_prob = law.sample_and_log_prob(key)
        return action, log_prob, law.log_prob(action), law.mode(), law.entropy()

    action, log_prob, again, mode, entropy = everything(KEY)
    assert action.shape == mode.shape == spec.shape
    assert action.dtype == mode.dtype == spec.zeros().dtype
    np.testing.assert_allclose(log_prob, again, rtol=1e-6)
    assert entropy.shape == log_prob.shape == ()
    if spec.kind != "box":
        assert spec.to_space().contains(np.asarray(action).astype(spec.to_space().dtype))


@pytest.mark.parametrize("space", SPACES[:5], ids=str)
def test_the_first_policy_is_nearly_uniform(space):
    spec = from_space(space)
    entropy = jit(lambda key: ActionHead.of(4, spec, key)(jnp.ones(4)).entropy())(KEY)
    uniform = sum(np.log(n) for n in spec.counts) if spec.counts else spec.size * np.log(2)
    assert entropy == pytest.approx(uniform, abs=1e-3)


def test_a_gaussian_works_in_units_of_the_box():
    spec = from_space(spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([4.0, 0.5], np.float32)))
    np.testing.assert_allclose(centre(spec), [1.0, 0.25])
    np.testing.assert_allclose(half_width(spec), [3.0, 0.25])
    law = ActionHead.of(4, spec, KEY, gain=0.0)(jnp.ones(4))
    np.testing.assert_allclose(law.mean, [1.0, 0.25])
    np.testing.assert_allclose(law.std, [3.0, 0.25], rtol=1e-6)
    open_ended = from_space(SPACES[7])
    np.testing.assert_allclose(centre(open_ended), [0.5, 0.0])
    np.testing.assert_allclose(half_width(open_ended), [0.5, 1.0])


def test_a_masked_choice_has_probability_zero():
    head = ActionHead.of(4, from_space(spaces.Discrete(3)), KEY)
    law = head(jnp.ones(4), jnp.asarray([1, 0, 1], jnp.int8))
    np.testing.assert_allclose(law.probs, [0.5, 0.0, 0.5], atol=1e-2)  # type: ignore[attr-defined]
    assert law.probs[1] == 0.0  # type: ignore[attr-defined]
    draws = jax.vmap(law.sample)(jax.random.split(KEY, 200))
    assert set(np.asarray(draws).tolist()) == {0, 2}
