"""`rtg check-env`: every kind of name."""

import gymnasium
import pytest
from gymnasium.envs.classic_control import PendulumEnv

from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.runner.check import check_by_name


class Endless(PendulumEnv):
    """No time limit."""


class Broken(gymnasium.Env):
    """No spaces."""


class Needy(gymnasium.Env):
    """Wants an argument."""

    def __init__(self, size):
        self.size = size


def make_cart():
    return CartPole()


several = vectorize(CartPole(), 2)
HERE = __name__


def test_names_that_are_right():
    for name in ("OneStep", "CartPole-v1", "gymnasium.envs.classic_control:CartPole-v1", f"{HERE}:make_cart"):
        assert check_by_name(name) == []


def test_names_of_environments_that_are_wrong():
    assert [p.severity for p in check_by_name(f"{HERE}:Endless")] == ["warning"]
    assert any(p.severity == "error" for p in check_by_name(f"{HERE}:Broken"))


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("CartPol-v1", "did you mean CartPole-v1"),
        ("no_such_module:Env", "cannot be imported"),
        (f"{HERE}:Endles", "did you mean Endless"),
        ("rewardtogo.core:Spec", "neither a gymnasium.Env nor"),
        (f"{HERE}:several", "is a Vectorized: name a gymnasium.Env"),
    ],
)
def test_names_of_nothing(name, sentence):
    with pytest.raises(ValueError, match=sentence):
        check_by_name(name)
