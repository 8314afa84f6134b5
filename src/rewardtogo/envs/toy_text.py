"""Gymnasium's toy environments (FrozenLake, CliffWalking, Taxi), compiled: built from the transition tables they carry.

Gymnasium's environments of this family step by looking up `P[s][a]`, a list of outcomes (probability, next state, reward, end), so a twin
made of that table and of `initial_state_distrib` is the same process by construction; the same table is what dynamic programming solves.

Deviations: CliffWalking, which Gymnasium registers without a time limit, is cut after 1,000 steps: a policy that walks in circles could not
be evaluated otherwise. A cut does not change any value (erratum E1.5). Taxi's action mask, which Gymnasium tells in `info`, is a part of
the observation, as everywhere in this library. A *fickle* passenger is not in Taxi's table, so that there is no twin of it.
"""

import inspect
from typing import Any

import gymnasium
import gymnasium.envs.registration as registration
import numpy as np
from jaxtyping import Int8

from ..core import Environment
from .drawing import Pictured
from .grids import ICE, Taxi, Walk
from .sparse import SparseEnv, SparseMDP
from .time_limit import TimeLimit

LIMIT = 1000
"""Steps of an episode of a toy environment that Gymnasium registers without a limit."""
TABULAR = ("FrozenLake-v1", "FrozenLake8x8-v1", "CliffWalking-v1", "CliffWalkingSlippery-v1", "Taxi-v4")
"""The environments with a table."""


def has_twin(name: str, kwargs: dict[str, Any]) -> bool:
    """Whether the table says all of the environment that `gymnasium.make` would give with these arguments."""
    return name in TABULAR and not kwargs.get("fickle_passenger", False) and "render_mode" not in kwargs


def gymnasium_table(name: str, **kwargs: Any) -> gymnasium.Env:
    """Gymnasium's own environment, without wrappers, with a transition table `P` in it.

    Raises `ValueError` where it has none, or does not take the arguments.
    """
    try:
        made: Any = gymnasium.make(name, disable_env_checker=True, **kwargs).unwrapped
    except gymnasium.error.Error as error:
        raise ValueError(f"Gymnasium cannot make {name}: {error}") from error
    except Exception as error:
        known = ", ".join(_arguments(name)) or "none"
        given = ", ".join(f"{k}={v!r}" for k, v in kwargs.items()) or "no arguments"
        raise ValueError(f"{name} cannot be made with {given} ({error}): its arguments are {known}") from error
    if not {"P", "initial_state_distrib"} <= set(vars(made)):
        raise ValueError(
            f"{name} has no table of transitions, which dynamic programming needs: use one of {', '.join(TABULAR)}, "
            "or learn with `rtg train`"
        )
    return made


def _arguments(name: str) -> list[str]:
    entry = gymnasium.registry[name].entry_point if name in gymnasium.registry else None
    cls = registration.load_env_creator(entry) if isinstance(entry, str) else entry
    return [] if cls is None else [p for p in inspect.signature(cls).parameters if p != "render_mode"]


def table_mdp(env: Any, discount: float = 1.0) -> SparseMDP:
    """The decision process of an environment's table, every outcome as it stands there (shorter lists are filled up with probability 0).

    A state that is entered by outcomes that end, and by no others, and where no episode starts, is terminal: nothing is ever done in it.
    """
    table, initial = env.P, np.asarray(env.initial_state_distrib, np.float64)
    states, actions = len(table), len(table[0])
    width = max(len(outcomes) for row in table.values() for outcomes in row.values())
    blank = (0.0, None, 0.0, False)
    # An outcome that cannot happen stays where it is.
    rows = [
        (p, s if to is None else int(to), float(r), bool(end))
        for s in range(states)
        for a in range(actions)
        for p, to, r, end in [*table[s][a], *[blank] * (width - len(table[s][a]))]
    ]
    shape = (states, actions, width)
    probabilities, successors, rewards, ends = (np.array(column).reshape(shape) for column in zip(*rows, strict=True))
    moving = (probabilities > 0) & (successors != np.arange(states)[:, None, None])
    by_end, without = (np.bincount(successors[moving & e], minlength=states) > 0 for e in (ends, ~ends))
    terminal = by_end & ~without & ~(initial > 0)
    return SparseMDP(successors, probabilities, rewards, initial, discount, terminal, ends)


def _masks(env: Any) -> Int8[np.ndarray, "S A"] | None:
    if type(env).__name__ != "TaxiEnv":
        return None
    return np.stack([env.action_mask(s) for s in range(len(env.P))])


def _drawing(env: Any) -> Taxi | Walk:
    if type(env).__name__ == "TaxiEnv":
        return Taxi(frozenset((r, c) for r in range(5) for c in range(4) if env.desc[r + 1, 2 * c + 2] == b"|"))
    if type(env).__name__ == "FrozenLakeEnv":
        return Walk(tuple(b"".join(row).decode() for row in env.desc.tolist()), ICE)
    return Walk(("F" * 12, "F" * 12, "F" * 12, "S" + "C" * 10 + "G"))


def toy_text(name: str, **kwargs: Any) -> Environment:
    """The compiled twin of a toy environment, with the time limit that it is registered with. Raises as `gymnasium_table` does."""
    env = gymnasium_table(name, **kwargs)
    limit = gymnasium.spec(name).max_episode_steps
    return TimeLimit(Pictured(SparseEnv(table_mdp(env), _masks(env)), _drawing(env)), limit or LIMIT)
