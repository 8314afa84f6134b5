r"""Tabular Q-learning, plain and double, online, nothing stored (Algorithm 10, Watkins and Dayan 1992; 6.3, van Hasselt 2010).

After every step

$$Q(s, a) \leftarrow Q(s, a) + \alpha\, (y - Q(s, a)), \qquad y = r + \gamma\, (1 - \text{terminated}) \max_{a'} Q(s', a'),
\qquad \alpha = \frac{\text{learning rate}}{n(s, a)^{\text{decay}}}$$

where $n(s, a)$ counts the visits. With $\tfrac12 <$ decay $\le 1$ the sum of $\alpha$ diverges and that of $\alpha^2$ does not, and Q
converges to $Q^\star$ whatever policy acts, as long as it leaves nothing out for ever (erratum E5.11: although it is no gradient descent).
The notes print $\max_{a'} Q(s_i, a_i, s'_i, r_i)$ in the target (erratum E5.6).

*Double*: two tables, a coin decides which of them learns, the one that learns chooses the next action and the other values it:

$$y = r + \gamma\, (1 - \text{terminated})\, Q_B(s', \arg\max_{a'} Q_A(s', a')).$$

It acts by the mean of both. The over-estimation of a maximum of estimates is gone, and an under-estimation may come (erratum E6.3).

Deviations: of several environments side by side, each step is learned from in turn, with the policy from before the first of them.
"""

import math
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..core import (
    MASK,
    Action,
    Carry,
    EnvSpec,
    Learner,
    Number,
    Observation,
    Policy,
    PRNGKey,
    Rollout,
    Spec,
    number,
    part,
    require_action,
    setting,
)
from ..nn import action_mask
from ..ops.schedules import Linear
from ..ops.td import double_q_target, q_target
from .exploration import UNIFORM, EpsilonGreedy, Exploration, Greedy

MOST_ENTRIES = 100_000_000
"""The largest table that is made: 800 MB with its counts."""
FORBIDDEN = -1e9
"""What a masked action is taken to be worth: finite, so that a target that does not go on stays 0 times it."""


def table_parts(spec: Spec) -> tuple[tuple[str, Spec], ...]:
    """The parts of an observation that say which row of a table it is; the action mask is none. A plain space has no name.

    Raises `ValueError` where a part does not take one of finitely many values.
    """
    parts = tuple((n, p) for n, p in spec.parts if n != MASK) if spec.kind == "dict" else (("", spec),)
    wrong = next((p for _, p in parts if p.kind not in ("discrete", "multi_discrete")), None)
    if wrong is not None or not parts:
        what = "nothing but a mask" if wrong is None else f"a {wrong.kind.replace('_', '-')} of shape {wrong.shape}"
        raise ValueError(
            f"a table has a row for each observation, and these are {what}: use a learner with a network, such as dqn, "
            "or an environment with discrete observations, such as FrozenLake-v1"
        )
    return parts


def table_rows(spec: Spec) -> int:
    """How many observations there are."""
    return math.prod(n for _, p in table_parts(spec) for n in p.counts)


def table_row(spec: Spec, observation: Observation) -> Int[Array, ""]:
    """Which row of the table an observation is: its digits, most significant first."""
    row = jnp.zeros((), jnp.int32)
    for name, p in table_parts(spec):
        digits = jnp.ravel(observation[name] if name else observation)
        for i, count in enumerate(p.counts):
            row = row * count + digits[i]
    return row


class QTableState(eqx.Module):
    """One or two tables, how often each entry was updated, the number of updates done, and what observations look like."""

    tables: Float[Array, "E S A"]
    visits: Float[Array, "E S A"]
    updates: Int[Array, ""]
    spec: Spec = eqx.field(static=True)


class QTablePolicy(Policy):
    """Acts from a table of Q-values."""

    table: Float[Array, "S A"]
    exploration: Exploration
    spec: Spec = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return ()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        q = self.table[table_row(self.spec, observation)]
        return carry, self.exploration(q, key, action_mask(observation)), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        q, mask = self.table[table_row(self.spec, observation)], action_mask(observation)
        allowed = q if mask is None else jnp.where(mask > 0, q, FORBIDDEN)
        return {"q_values": q, "value": allowed.max(), "probabilities": self.exploration.probabilities(q, mask)}


class QLearning(Learner):
    """Q-learning with a table, or with two. Discrete actions, with masks; discrete observations, several of them, dictionaries of them."""

    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    learning_rate: Number = number(1.0, "alpha of the first visit of a state and action", above=0, at_most=1)
    decay: Number = number(0.7, "alpha falls like visits to the power of minus this; 0 keeps it", at_least=0, at_most=1)
    initial: Number = number(0.0, "Q before anything is learned; more than can be had makes it try everything")
    double: bool = setting(False, "two tables: one chooses the next action, the other values it")
    exploration: Exploration = part(
        EpsilonGreedy(Linear(1.0, 0.05, fraction=0.5), UNIFORM), "how it acts while learning"
    )

    @property
    def batch(self) -> Literal["rollout"]:
        return "rollout"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete",)

    def init(self, spec: EnvSpec, key: PRNGKey) -> QTableState:
        del key
        require_action("QLearning", spec, self.action_kinds)
        shape = (2 if self.double else 1, table_rows(spec.observation), spec.action.counts[0])
        if math.prod(shape) > MOST_ENTRIES:
            raise ValueError(
                f"a table of {shape[1]:,} observations and {shape[2]} actions does not fit: use a learner with a network, such as dqn"
            )
        tables = jnp.broadcast_to(jnp.asarray(self.initial, jnp.float32), shape)
        return QTableState(tables, jnp.zeros(shape), jnp.zeros((), jnp.int32), spec.observation)

    def policy(self, state: QTableState, explore: bool) -> QTablePolicy:
        exploration = self.at(state.updates).exploration if explore else Greedy()
        as_arrays = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), exploration)
        return QTablePolicy(state.tables.mean(0), as_arrays, state.spec)

    def update(
        self, state: QTableState, batch: Rollout, key: PRNGKey
    ) -> tuple[QTableState, dict[str, Array], tuple[()]]:
        now, t = self.at(state.updates), batch.transitions
        t = jax.tree.map(
            lambda x: x.reshape(-1, *x.shape[2:]), (t.observation, t.action, t.reward, t.terminated, t.next_observation)
        )
        observation, action, reward, terminated, following = t
        row_of = jax.vmap(lambda o: table_row(state.spec, o))
        mask = action_mask(following)
        allowed = jnp.ones((len(action), state.tables.shape[-1]), bool) if mask is None else mask > 0
        coin = jax.random.bernoulli(key, 0.5, action.shape) if self.double else jnp.zeros(action.shape, bool)
        steps = (row_of(observation), action, reward, now.gamma * (1.0 - terminated), row_of(following), allowed, coin)

        def one(loop: tuple[Array, Array], step: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
            (tables, visits), (s, a, r, discount, after, may, second) = loop, step
            which = second.astype(jnp.int32)
            q_next = jnp.where(may, tables[:, after], FORBIDDEN)
            if self.double:
                y = double_q_target(r, discount, q_next[1 - which], q_next[which])
            else:
                y = q_target(r, discount, q_next[0])
            old, count = tables[which, s, a], visits[which, s, a] + 1.0
            alpha, error = now.learning_rate * count**-now.decay, y - old
            tables = tables.at[which, s, a].add(alpha * error)
            return (tables, visits.at[which, s, a].set(count)), (error, old, alpha)

        (tables, visits), (error, q, alpha) = jax.lax.scan(one, (state.tables, state.visits), steps)
        metrics = {
            "q_loss": 0.5 * jnp.square(error).mean(),
            "q_mean": q.mean(),
            "td_error": jnp.abs(error).mean(),
            "alpha": alpha.mean(),
            **now.exploration.metrics(),
        }
        return QTableState(tables, visits, state.updates + 1, state.spec), metrics, ()
