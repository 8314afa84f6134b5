import dataclasses

import equinox as eqx
import gymnasium as gym
import jax.numpy as jnp
import numpy as np
import pytest
from counting import Counting
from gymnasium import spaces

from rewardtogo.core import Environment, Timestep
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.check import Problem, check_env
from rewardtogo.envs.time_limit import TimeLimit


@pytest.mark.parametrize(
    "name", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1", "Taxi-v4", "Blackjack-v1", "MountainCar-v0"]
)
def test_good_environments_have_no_errors(name):
    assert [problem for problem in check_env(name) if problem.severity == "error"] == []


@pytest.mark.slow
def test_a_mujoco_environment_has_no_errors():
    pytest.importorskip("mujoco")
    assert [problem for problem in check_env("InvertedPendulum-v5") if problem.severity == "error"] == []


def test_ours_has_no_problems():
    assert check_env(CartPole(), steps=200) == []


class Good(gym.Env):
    """Ends after 10 steps; each test spoils one thing."""

    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self.look(), self.info()

    def look(self):
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def info(self):
        return {}

    def reward(self, action):
        return 1.0

    def step(self, action):
        self.count += 1
        return self.look(), self.reward(action), self.count >= 10, False, self.info()


def spoiled(**changes):
    return type("Spoiled", (Good,), changes)


def no_observation_space(self):
    raise AttributeError("'Spoiled' object has no attribute 'observation_space'")


def writing(self, action):
    action *= 0
    return Good.step(self, action)


WRONG = {
    "observation space": ({"observation_space": spaces.Text(3)}, "observation_space cannot be used: .*no fixed shape"),
    "no space": ({"action_space": None}, "action_space is None: set it to a space"),
    "attribute": ({"observation_space": property(no_observation_space)}, "a space is missing"),
    "make": ({"__init__": lambda self: 1 / 0}, "it cannot be made, ZeroDivisionError"),
    "reset": (
        {"reset": lambda self, *, seed=None, options=None: np.zeros(2)},
        r"reset\(seed=...\) gave a ndarray: return the 2",
    ),
    "reset without a seed": ({"reset": lambda self: (np.zeros(2), {})}, r"reset\(seed=...\) raised TypeError"),
    "four values": ({"step": lambda self, a: (self.look(), 0.0, True, {})}, "gave 4 values: return the 5"),
    "info": ({"info": lambda self: None}, "an info of type NoneType: return a dictionary"),
    "raises": ({"reward": lambda self, a: {}[a]}, r"step \(number 1, action .*\) raised KeyError"),
    "shape": (
        {"look": lambda self: np.zeros(3, np.float32)},
        r"does not fit Box.*shape \(3,\), and its space says \(2,\)",
    ),
    "kind": ({"observation_space": spaces.Discrete(3), "look": lambda self: 0.5}, "float64, and its space says int64"),
    "outside": (
        {"look": lambda self: np.full(2, 5 * self.np_random.random(), np.float32)},
        "was .*, outside its space Box",
    ),
    "outside discrete": (
        {"observation_space": spaces.Discrete(3), "look": lambda self: 3},
        "was 3, outside its space Discrete",
    ),
    "NaN": ({"look": lambda self: np.array([0, np.nan], np.float32)}, "held NaN or infinity"),
    "reward": ({"reward": lambda self, a: np.nan}, "a reward was nan"),
    "reward type": ({"reward": lambda self, a: np.ones(2)}, r"reward array.*return float\(reward\)"),
    "flags": (
        {"step": lambda self, a: (self.look(), 0.0, 1, False, {})},
        r"terminated as int 1: return bool\(terminated\)",
    ),
    "seed": (
        {"look": lambda self: np.random.default_rng().uniform(-1, 1, 2).astype(np.float32)},
        "gave two different observations",
    ),
    "writes": ({"action_space": spaces.Box(-1, 1, (2,)), "step": writing}, "writes into the action"),
    "action type": ({"reward": lambda self, a: 1.0 if type(a) is int else 2.0}, "takes the action np.int64"),
    "mask's shape": (
        {"info": lambda self: {"action_mask": np.ones(3)}},
        r"info\['action_mask'\] has shape \(3,\): give one entry",
    ),
    "mask of nothing": ({"info": lambda self: {"action_mask": np.zeros(2)}}, "forbade every action"),
    "mask missing": (
        {"info": lambda self: {"action_mask": np.ones(2)} if self.count == 0 else {}},
        "was missing after a step",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_errors(name):
    changes, message = WRONG[name]
    found = [problem.message for problem in check_env(spoiled(**changes), steps=100) if problem.severity == "error"]
    assert len(found) == 1, found
    with pytest.raises(Exception, match=message):
        raise RuntimeError(found[0])


def large(self):
    return self.np_random.uniform(-500, 500, 2).astype(np.float32)


WARNINGS = {
    "unbounded": ({"action_space": spaces.Box(-np.inf, np.inf, (1,))}, "no finite bounds"),
    "never ends": (
        {"step": lambda self, a: (self.look(), 1.0, False, False, {})},
        "no episode ended within 100 random steps",
    ),
    "type": ({"look": lambda self: self.np_random.uniform(-1, 1, 2)}, r"return observation.astype\(np.float32\)"),
    "list": ({"look": lambda self: [0.0, 0.0]}, "the observation is a list"),
    "large": ({"observation_space": spaces.Box(-1000, 1000, (2,)), "look": large}, "normalise observations"),
    "large reward": ({"reward": lambda self, a: 1000.0}, "rewards reach 1000 in one step"),
    "no reward": ({"reward": lambda self, a: 0.0}, "earned no reward but 0"),
    "not repeatable": ({"reward": lambda self, a: np.random.default_rng().random()}, "cannot be repeated"),
}


@pytest.mark.parametrize("name", WARNINGS)
def test_warnings(name):
    changes, message = WARNINGS[name]
    (found,) = check_env(spoiled(**changes), steps=100)
    assert found.severity == "warning"
    with pytest.raises(Exception, match=message):
        raise RuntimeError(str(found))


def test_a_good_one_and_masks():
    assert check_env(Good, steps=50) == []
    assert check_env(Good(), steps=50) == []
    unbounded = check_env(lambda: Counting(masked=True), steps=50)
    assert unbounded == []


def test_bad_requests():
    with pytest.raises(ValueError, match="3 is no environment"):
        check_env(3)
    with pytest.raises(ValueError, match="at least 1 step, not 0"):
        check_env("CartPole-v1", steps=0)
    (problem,) = check_env("NoSuch-v0")
    assert problem == Problem("error", problem.message) and "NoSuch" in str(problem)
    (problem,) = check_env("CartPole-v1", kwargs={"colour": "red"})
    assert "colour" in problem.message
    (problem,) = check_env(lambda: 3)
    assert "gave a int" in problem.message


class Compiled(Environment):
    """Counts to 5; each test spoils one thing."""

    fault: str = eqx.field(static=True, default="")

    @property
    def observation_space(self):
        return spaces.Box(0, 3 if self.fault == "outside" else 9, (1,))

    @property
    def action_space(self):
        return spaces.Discrete(2)

    def reset(self, key):
        state = {"count": jnp.zeros(())}
        if self.fault == "leaf":
            state["name"] = 3
        if self.fault == "impure":
            state["count"] += np.random.default_rng().random()
        return state, jnp.zeros(1, jnp.int32 if self.fault == "reset" else jnp.float32)

    def step(self, state, action, key):
        count = state["count"] + 1
        if self.fault == "python" and count > 3:
            count = count * 0
        if self.fault == "state":
            count = count.astype(jnp.int32)
        over = count >= (1e6 if self.fault == "endless" else 5)
        observation = (
            jnp.where(count > 2, jnp.nan, count)[None] if self.fault == "NaN" else jnp.asarray(count, jnp.float32)[None]
        )
        reward = jnp.ones(1) if self.fault == "reward" else jnp.ones(())
        final = observation[0] if self.fault == "final" else observation
        if self.fault == "tuple":
            return {"count": count}, (observation, reward, over)
        timestep = Timestep(observation, reward, over, jnp.zeros((), bool), final, {})
        if self.fault == "flags":  # past the type checker of the tests
            timestep = eqx.tree_at(lambda t: t.terminated, timestep, jnp.zeros(()))
        return {"count": count}, timestep


COMPILED = {
    "leaf": r"the state's leaf \['name'\] is a int: make it an array",
    "impure": "two different results for the same key",
    "reset": r"reset's observation is not what its space says, it is float32\[1\] and then int32\[1\]",
    "python": "step cannot be compiled, TracerBoolConversionError",
    "state": r"changes its form between reset and step, \['count'\] is float32\[\] and then int32\[\]",
    "flags": r"terminated is float32\[\], not bool\[\]",
    "reward": r"the reward is float32\[1\], not float32\[\]",
    "final": "step's final_observation is not what its space says",
    "tuple": "gave a tuple as its second value: return a Timestep",
    "outside": "was 5, outside its space",
    "NaN": "held NaN",
}


@pytest.mark.parametrize("fault", COMPILED)
def test_errors_of_compiled_environments(fault):
    found = [problem.message for problem in check_env(Compiled(fault), steps=20) if problem.severity == "error"]
    assert len(found) == 1, found
    with pytest.raises(Exception, match=COMPILED[fault]):
        raise RuntimeError(found[0])


def test_compiled_environments_that_never_end():
    (problem,) = check_env(Compiled("endless"), steps=4)
    assert problem.severity == "warning" and "no episode ended" in problem.message
    assert check_env(TimeLimit(Compiled("endless"), 3), steps=4) == []
    assert dataclasses.is_dataclass(problem)
