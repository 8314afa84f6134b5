"""Monte Carlo tree search (notes, Algorithm 16, sections 8.2.3 and 8.2.4; Browne et al. 2012; Silver et al. 2018).

    search = TreeSearch(simulations=500)                               # UCT with random rollouts
    solution = mcts(game, state, key, search)                          # solution.value.action
    solution = mcts(Numbered(KnownModel(env), 2), state, key, search)  # any model with so many actions

The notes' loop never comes to its last line (erratum E8.10): here it has a budget, and then chooses the action that was taken most
often (the robust child) or the one of the best mean (the max child). Two players: every return is counted as the first player's, and each
node reads it from the side of whoever is to move there, which is negamax whatever the order of turns.

Many roots: `jax.vmap` over `mcts`, roots and keys, is one program with that many trees in it.
"""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from ..core import (
    Action,
    Carry,
    Choices,
    Configured,
    Model,
    Number,
    Observation,
    Policy,
    PRNGKey,
    Solution,
    State,
    number,
    part,
    setting,
)
from .guides import Guide, Rollouts
from .problem import as_module
from .tree import Tree, back_up, descend, expand, grow, plant
from .tree_policies import UCT, Bounds, TreePolicy


class TreeSearch(Configured):
    """How to search. The floats are traced; a new one compiles nothing."""

    simulations: int = setting(100, "simulations for a decision, each of which adds one node to the tree", at_least=1)
    rule: TreePolicy = part(UCT(), "how simulations go down the tree: UCT() or PUCT()")
    guide: Guide = part(Rollouts(), "what is believed of a new node: Rollouts() or Guided(network)")
    discount: Number = number(1.0, "gamma, along the path and in rollouts", at_least=0, at_most=1)
    outcomes: int = setting(
        1, "K: next states that are told apart after one action; 1 for deterministic models", at_least=1
    )
    max_depth: int = setting(0, "deepest node; 0 for as deep as the number of simulations allows", at_least=0)
    choose: Literal["robust", "max"] = setting(
        "robust", "most visits (robust) or the best mean (max)", choices=("robust", "max")
    )
    bounds: Bounds = eqx.field(default=None)
    """Least and greatest return, which the tree policy sees as 0 and 1; the extremes met so far where left out (erratum E8.9)."""

    def __check_init__(self) -> None:
        if self.bounds is not None and not any(isinstance(b, Tracer) for b in self.bounds):
            low, high = self.bounds
            if not (np.isfinite(low) and np.isfinite(high) and low < high):
                raise ValueError(f"returns lie between a lower and an upper bound, such as (-1, 1), not {self.bounds}")


class Decision(eqx.Module):
    """What a search found of its root.

    - `action`: the choice; `visits` and `q_values` of all actions, the latter from the side of who is to move, NaN where never taken.
    - `value`: the mean return of all simulations, from the same side.
    - `tree`: all that it was found with.
    """

    action: Int[Array, ""]
    visits: Float[Array, "A"]
    q_values: Float[Array, "A"]
    value: Float[Array, ""]
    tree: Tree

    @property
    def probabilities(self) -> Float[Array, "A"]:
        """The share of the visits that each action got: what a policy is distilled from."""
        return self.visits / jnp.maximum(self.visits.sum(), 1.0)


def mcts(model: Model, root: State, key: PRNGKey, search: TreeSearch | None = None) -> Solution:
    """Search from one state: a `Solution` whose value is a `Decision`.

    `converged` says whether there was anything to decide: not where the root is an end. `stats`: `nodes` in the tree, `cut` rollouts.
    Raises `ValueError` for a model without numbered actions, and, outside of a compiled program, where the root is an end.
    """
    search = TreeSearch() if search is None else search
    if not isinstance(model, Choices):
        raise ValueError(
            f"a tree search needs numbered actions, and {type(model).__name__} does not say how many: give it as Numbered(model, A)"
        )
    if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((model, root, key))):
        _check_root(model, root)
    tree = _search(model, root, key, search)
    counts, side = tree.counts[0], tree.sign[0]
    mean = side * tree.totals[0] / jnp.maximum(counts, 1.0)
    decision = Decision(
        _choice(search.choose, tree.legal[0], counts, mean),
        counts,
        jnp.where(counts > 0, mean, jnp.nan),
        side * tree.totals[0].sum() / jnp.maximum(counts.sum(), 1.0),
        tree,
    )
    return Solution(decision, ~tree.over[0], {"nodes": tree.size, "cut": tree.cut})


@jax.jit
def _search(model: Choices, root: State, key: PRNGKey, search: TreeSearch) -> Tree:
    begin_key, noise_key, loop_key = jax.random.split(key, 3)
    root = jax.tree.map(jnp.asarray, root)
    tree = plant(model, root, search.simulations + 1, search.outcomes)
    tree, _ = grow(model, search.guide, tree, jnp.zeros((), jnp.int32), root, search.discount, begin_key)
    prior = search.rule.root_prior(tree.prior[0], tree.legal[0], noise_key)
    tree = eqx.tree_at(lambda t: t.prior, tree, tree.prior.at[0].set(prior))
    depth = min(search.max_depth or search.simulations, search.simulations)

    def simulate(tree: Tree, keys: Array) -> tuple[Tree, None]:
        walk = descend(model, tree, search.rule, search.bounds, depth, keys[0])
        tree, value = expand(model, search.guide, tree, walk, search.discount, keys[0], keys[1])
        return back_up(tree, walk, value, search.discount), None

    tree, _ = jax.lax.scan(simulate, tree, jax.random.split(loop_key, (search.simulations, 2)))
    return tree


def _choice(by: str, legal: Bool[Array, "A"], counts: Float[Array, "A"], mean: Float[Array, "A"]) -> Int[Array, ""]:
    """The most visited action, or the one of the best mean; ties by the other of the two."""
    mean = jnp.where(counts > 0, mean, -jnp.inf)
    first, second = (counts, mean) if by == "robust" else (mean, counts)
    first = jnp.where(legal, first, -jnp.inf)
    return jnp.where(legal & (first == first.max()), second, -jnp.inf).argmax().astype(jnp.int32)


def _check_root(model: Choices, root: State) -> None:
    if bool(model.terminal(root)):
        raise ValueError("the game is over in the state to search from: there is nothing to decide")
    if not bool(model.legal(root).any()):
        raise ValueError("no action is allowed in the state to search from, and it is not marked as terminal")


class Numbered(Choices):
    """A model with `size` actions, all of them always allowed, and one player.

    - `view`: what a state looks like to a network; the state itself where it is left out.
    """

    model: Model
    size: int = eqx.field(static=True)
    view: Callable | None = eqx.field(default=None, converter=as_module)

    def __check_init__(self) -> None:
        if isinstance(self.size, bool) or not isinstance(self.size, int) or self.size < 1:
            raise ValueError(f"there must be at least one action to choose, and a whole number, not {self.size}")

    @property
    def num_actions(self) -> int:
        return self.size

    def encode(self, observation: Observation) -> State:
        return self.model.encode(observation)

    def transition(self, state: State, action: Action, key: PRNGKey) -> State:
        return self.model.transition(state, action, key)

    def reward(self, state: State, action: Action, next_state: State) -> Float[Array, ""]:
        return self.model.reward(state, action, next_state)

    def terminal(self, state: State) -> Bool[Array, ""]:
        return self.model.terminal(state)

    def legal(self, state: State) -> Bool[Array, "A"]:
        del state
        return jnp.ones(self.num_actions, bool)

    def player(self, state: State) -> Int[Array, ""]:
        del state
        return jnp.zeros((), jnp.int32)

    def observe(self, state: State) -> Observation:
        return state if self.view is None else self.view(state)


class SearchPolicy(Policy):
    """Plays by searching from what it sees, anew at every step."""

    model: Choices
    search: TreeSearch

    def init(self, key: PRNGKey) -> Carry:
        del key
        return ()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Any]]:
        found = mcts(self.model, self.model.encode(observation), key, self.search).value
        return carry, found.action, {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        del carry
        found = mcts(self.model, self.model.encode(observation), jax.random.key(0), self.search).value
        return {"value": found.value, "q_values": found.q_values, "probabilities": found.probabilities}
