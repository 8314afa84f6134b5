import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.core import Configured, Number, fix_horizon, number, setting
from rewardtogo.ops import Linear


class Example(Configured):
    rate: Number = number(0.5, "a rate", above=0, at_most=1)
    cost: Number = number(0, "a cost", at_least=0)
    count: int = setting(2, "a count", at_least=1, at_most=9)
    kind: str = setting("a", "a kind", choices=("a", "b"))
    on: bool = setting(True, "a switch")


@pytest.mark.parametrize(
    "wrong",
    [
        {"rate": 0.0},
        {"rate": 1.5},
        {"rate": float("nan")},
        {"rate": float("inf")},
        {"rate": "fast"},
        {"rate": True},
        {"rate": None},
        {"rate": jnp.asarray([0.5, 2.0])},
        {"rate": Linear(0.5, 2.0)},
        {"cost": -1},
        {"count": 0},
        {"count": 10},
        {"count": 2.0},
        {"count": True},
        {"kind": "c"},
    ],
)
def test_a_wrong_value_names_field_and_range(wrong):
    with pytest.raises(ValueError, match=f"Example.{next(iter(wrong))} must be") as error:
        Example(**wrong)
    assert "\n" not in str(error.value)


def test_numbers_are_traced_and_settings_are_not():
    example = Example(rate=1)
    assert isinstance(example.rate, float)
    assert jax.tree.leaves(example) == [1.0, 0.0]
    assert isinstance(Example(cost=np.int32(3)).cost, float)
    calls = []

    @jax.jit
    def read(e: Example) -> jax.Array:
        calls.append(e)
        return e.rate * e.count

    assert read(Example(rate=0.25)) == 0.5
    assert read(Example(rate=0.75)) == 1.5
    assert len(calls) == 1
    assert read(Example(rate=0.75, count=4)) == 3.0
    assert len(calls) == 2


def test_traced_values_are_not_looked_at():
    values = jax.vmap(lambda r: Example(rate=r).rate * 2)(jnp.asarray([0.5, 5.0]))
    np.testing.assert_array_equal(values, [1.0, 10.0])


def test_ends_of_an_open_range_are_allowed_in_a_schedule():
    example = Example(rate=Linear(1.0, 0.0))
    assert isinstance(example.rate, Linear)


def test_schedules_get_a_horizon_and_a_value():
    fixed = fix_horizon(Example(rate=Linear(1.0, 0.0), cost=Linear(0.0, 1.0, 4)), 10)
    assert (fixed.rate.horizon, fixed.cost.horizon) == (10, 4)
    now = fixed.at(jnp.asarray(2))
    np.testing.assert_allclose([now.rate, now.cost], [0.8, 0.5], rtol=1e-6)
    assert isinstance(now, Example)


@pytest.mark.parametrize("learner", [rtg.PPO, rtg.DQN, rtg.PolicyGradient])
def test_every_hyperparameter_is_documented(learner):
    fields = {f.name: f.metadata for f in learner.__dataclass_fields__.values()}
    assert fields
    assert all(len(meta.get("doc", "")) > 5 for meta in fields.values())


def test_a_number_given_as_an_array_is_a_leaf():
    example = Example(rate=jnp.asarray([0.1, 0.2]))
    assert eqx.is_array(example.rate)
    assert example.rate.shape == (2,)
