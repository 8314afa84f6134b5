"""The tree of a search, made for all its nodes at once, and the four steps of one simulation (notes, Algorithm 16).

    descend    from the root along known edges, until one leads to something new
    expand     a node for it: one in every simulation, no more (item 8.21)
    evaluate   by the guide: a rollout, or a network
    back up    the return is counted in every edge of the path

Nodes are rows of arrays; row 0 is the root. One root, no batch axis: `vmap` gives many trees in one program. The states that nodes
stand for are kept in the tree, so that going on from a node is rolling the simulator back to it (item 8.19).

Chance: with `outcomes` K > 1, every passage of an edge samples the next state anew, and each outcome that is seen for the first time
becomes a child of its own, until there are K; after that, one that is not among them is replaced by one that is, as often as they came up.
The mean over an edge is then an expectation (item 8.22). With K = 1 an edge leads for ever to what it led to first.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..core import Choices, PRNGKey, State
from .guides import Guide, is_over, sign
from .tree_policies import Bounds, Edges, TreePolicy


class Tree(eqx.Module):
    """M nodes, A actions, K outcomes; the first `size` rows are in use.

    - `states`: what the nodes stand for, `[M, ...]`.
    - `children`: the node that an action and an outcome lead to, -1 where there is none yet.
    - `counts`, `totals`: how often an action was taken, and the sum of the returns that followed, discounted, the action's own reward
      included, as the first player counts.
    - `prior`, `legal`: of the actions.
    - `reward`, `sign`, `over`: the reward on the way into a node; 1 where the first player is to move, -1 where the second; an end.
    - `low`, `high`: the extremes of all returns so far.
    - `cut`: how many rollouts did not come to an end.
    """

    states: State
    children: Int[Array, "M A K"]
    counts: Float[Array, "M A"]
    totals: Float[Array, "M A"]
    prior: Float[Array, "M A"]
    legal: Bool[Array, "M A"]
    reward: Float[Array, "M"]
    sign: Float[Array, "M"]
    over: Bool[Array, "M"]
    size: Int[Array, ""]
    low: Float[Array, ""]
    high: Float[Array, ""]
    cut: Int[Array, ""]


class Walk(eqx.Module):
    """A way down: D edges at most.

    - `nodes`, `actions`: along the path, `depth` actions of it.
    - `before`: the state that the last action was taken in. Kept on the way, because where the compiler reads it from the tree once more
      after the loop, it copies all the states of all the trees in every simulation.
    - `going`: whether it goes on; `new`: whether the last node is one that the tree does not have yet.
    - `slot`: the last node's place among the outcomes of the last action.
    """

    nodes: Int[Array, "D1"]
    actions: Int[Array, "D"]
    depth: Int[Array, ""]
    before: State
    slot: Int[Array, ""]
    going: Bool[Array, ""]
    new: Bool[Array, ""]


def plant(model: Choices, root: State, nodes: int, outcomes: int) -> Tree:
    """An empty tree with room for `nodes`, the root not yet evaluated."""
    root = jax.tree.map(jnp.asarray, root)
    actions = model.num_actions
    states = jax.tree.map(lambda x: jnp.zeros((nodes, *x.shape), x.dtype), root)
    zeros, edges = jnp.zeros(nodes), jnp.zeros((nodes, actions))
    none, zero = jnp.zeros(nodes, bool), jnp.zeros((), jnp.int32)
    children = jnp.full((nodes, actions, outcomes), -1, jnp.int32)
    return Tree(
        states, children, edges, edges, edges, edges > 0, zeros, zeros, none, zero, jnp.inf * jnp.ones(()),
        -jnp.inf * jnp.ones(()), zero,
    )  # fmt: skip


def grow(
    model: Choices, guide: Guide, tree: Tree, node: Int[Array, ""], state: State, discount: ScalarLike, key: PRNGKey
) -> tuple[Tree, Float[Array, ""]]:
    """Write a state into the row `node`, nowhere where that is beyond the last one, and evaluate it."""
    over, legal = is_over(model, state), model.legal(state)
    belief = guide(model, state, legal, discount, key)
    write = lambda rows, value: rows.at[node].set(value, mode="drop")  # noqa: E731
    tree = dataclasses.replace(
        tree,
        states=jax.tree.map(write, tree.states, state),
        prior=write(tree.prior, belief.prior),
        legal=write(tree.legal, legal),
        sign=write(tree.sign, sign(model, state)),
        over=write(tree.over, over),
        size=tree.size + (node < tree.reward.shape[0]),
        cut=tree.cut + (belief.cut & ~over),
    )
    return tree, jnp.where(over, 0.0, belief.value)


def edges_of(tree: Tree, node: Int[Array, ""], bounds: Bounds) -> Edges:
    """What is known of the actions in a node. Returns are scaled by the bounds given, or else by the extremes so far."""
    counts = tree.counts[node]
    mean = tree.totals[node] / jnp.maximum(counts, 1.0)
    low, high = (tree.low, tree.high) if bounds is None else bounds
    scaled = jnp.where(counts > 0, (mean - low) / jnp.maximum(high - low, 1e-6), 0.0)
    scaled = jnp.where((tree.sign[node] < 0) & (counts > 0), 1.0 - scaled, scaled)
    return Edges(scaled, counts, tree.prior[node], counts.sum() + (node > 0))


def descend(
    model: Choices,
    tree: Tree,
    rule: TreePolicy,
    bounds: Bounds,
    max_depth: int,
    key: PRNGKey,
) -> Walk:
    """From the root to an edge that leads out of the tree, to an end, or to the greatest depth."""
    tie_key, step_key = jax.random.split(key)
    lot = jax.random.uniform(tie_key, (model.num_actions,))
    zero = jnp.zeros((), jnp.int32)

    def step(walk: Walk) -> Walk:
        node = walk.nodes[walk.depth]
        score = jnp.where(tree.legal[node], rule(edges_of(tree, node, bounds)), -jnp.inf)
        action = jnp.where(score == score.max(), lot, -1.0).argmax().astype(jnp.int32)
        before = jax.tree.map(lambda x: x[node], tree.states)
        child, slot = follow(model, tree, node, before, action, jax.random.fold_in(step_key, walk.depth))
        new, depth = child < 0, walk.depth + 1
        nodes = walk.nodes.at[depth].set(jnp.where(new, tree.size, child))
        going = ~new & ~tree.over[child] & (depth < max_depth)
        return Walk(nodes, walk.actions.at[walk.depth].set(action), depth, before, slot, going, new)

    nodes, actions = jnp.zeros(max_depth + 1, jnp.int32), jnp.zeros(max_depth, jnp.int32)
    root = jax.tree.map(lambda x: x[0], tree.states)
    start = Walk(nodes, actions, zero, root, zero, ~tree.over[0], jnp.zeros((), bool))
    return jax.lax.while_loop(lambda walk: walk.going, step, start)


def follow(
    model: Choices, tree: Tree, node: Int[Array, ""], before: State, action: Int[Array, ""], key: PRNGKey
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Where an action leads this time: the child and its place among the outcomes; -1 and a free place where it is new."""
    children = tree.children[node, action]
    if children.shape[0] == 1:
        return children[0], jnp.zeros((), jnp.int32)
    move_key, lot_key = jax.random.split(key)
    sample = model.transition(before, action, move_key)
    there = children >= 0
    same = [
        (known[children] == seen[None]).reshape(len(children), -1).all(1)
        for known, seen in zip(jax.tree.leaves(tree.states), jax.tree.leaves(sample), strict=True)
    ]
    known = jnp.stack([there, *same]).all(0)
    times = tree.counts[children].sum(1) + 1.0
    instead = jax.random.categorical(lot_key, jnp.where(there, jnp.log(times), -jnp.inf))
    free = jnp.argmin(there)
    slot = jnp.where(known.any(), jnp.argmax(known), jnp.where(there.all(), instead, free)).astype(jnp.int32)
    return jnp.where(there[slot], children[slot], -1), slot


def expand(
    model: Choices, guide: Guide, tree: Tree, walk: Walk, discount: ScalarLike, descend_key: PRNGKey, key: PRNGKey
) -> tuple[Tree, Float[Array, ""]]:
    """Give the end of a walk its node, if it is new, and evaluate it. `descend_key` is the one that the walk was made with."""
    _, step_key = jax.random.split(descend_key)
    at = jnp.maximum(walk.depth - 1, 0)
    parent, action, leaf = walk.nodes[at], walk.actions[at], walk.nodes[walk.depth]
    move_key, _ = jax.random.split(jax.random.fold_in(step_key, at))  # the sample that `follow` saw
    after = model.transition(walk.before, action, move_key)
    beyond = tree.reward.shape[0]
    node, parent = jnp.where(walk.new, leaf, beyond), jnp.where(walk.new, parent, beyond)
    reward = tree.reward.at[node].set(model.reward(walk.before, action, after), mode="drop")
    children = tree.children.at[parent, action, walk.slot].set(node, mode="drop")
    tree = dataclasses.replace(tree, reward=reward, children=children)
    return grow(model, guide, tree, node, after, discount, key)


def back_up(tree: Tree, walk: Walk, value: Float[Array, ""], discount: ScalarLike) -> Tree:
    """Count the return of a simulation in every edge of its path: G_i = r_{i+1} + gamma G_{i+1}, from the leaf's value."""

    def step(loop: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        i, following, returns = loop
        now = tree.reward[walk.nodes[i + 1]] + discount * following
        return i - 1, now, returns.at[i].set(now)

    first = (walk.depth - 1, value, jnp.zeros(walk.actions.shape))
    _, _, returns = jax.lax.while_loop(lambda loop: loop[0] >= 0, step, first)
    on_path = jnp.arange(len(walk.actions)) < walk.depth
    rows = jnp.where(on_path, walk.nodes[:-1], tree.reward.shape[0])
    return dataclasses.replace(
        tree,
        counts=tree.counts.at[rows, walk.actions].add(1.0, mode="drop"),
        totals=tree.totals.at[rows, walk.actions].add(returns, mode="drop"),
        low=jnp.minimum(tree.low, jnp.where(on_path, returns, jnp.inf).min()),
        high=jnp.maximum(tree.high, jnp.where(on_path, returns, -jnp.inf).max()),
    )
