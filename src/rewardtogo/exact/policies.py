"""Policies as tables of probabilities: π[o, a] = π(a | o), or π_t[o, a] with time as the first axis.

A deterministic policy is the table with one 1 in each row. A policy that sees only observations acts, averaged over
what it may see, as π(a | s) = Σ_o O(o | s) π(a | o) in the hidden state.

Source: notes, section 1.1.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core import Policy, PRNGKey
from ..envs.tabular import MDP, POMDP, draw


def one_hot_policy(actions: Int[Array | np.ndarray, "... O"], num_actions: int) -> Float[np.ndarray, "... O A"]:
    """The table of a deterministic policy o -> a.

    Raises `ValueError` for an action that does not exist.
    """
    actions = np.asarray(actions)
    if actions.min() < 0 or actions.max() >= num_actions:
        raise ValueError(f"the policy chooses action {actions.max() if actions.min() >= 0 else actions.min()} "
                         f"and there are only 0 to {num_actions - 1}: give indices of actions")  # fmt: skip
    return np.eye(num_actions)[actions]


def greedy_policy(q_values: Float[Array | np.ndarray, "... O A"]) -> Float[np.ndarray, "... O A"]:
    """argmax_a Q(o, a) as a table; the first of equals."""
    return one_hot_policy(np.asarray(q_values).argmax(-1), q_values.shape[-1])


def memoryless_policy(pomdp: POMDP, policy: Float[Array | np.ndarray, "... Z A"]) -> Float[np.ndarray, "... S A"]:
    """π(a | s) = Σ_o O(o | s) π(a | o): how a policy of the observation acts in the hidden state (item 1.6).

    State distributions and J are those of the original; the joint with the observations is not kept.
    """
    return np.asarray(pomdp.emissions, np.float64) @ np.asarray(policy, np.float64)


def check_policy(
    mdp: MDP, policy: Float[Array | np.ndarray, "..."], horizon: int | None
) -> Float[np.ndarray, "... S A"]:
    """The policy in float64: `[S, A]` where there is no horizon, broadcast to `[T, S, A]` where there is.

    Raises `ValueError` for a wrong shape, and for rows that are not probabilities.
    """
    table = np.asarray(policy, np.float64)
    one = (mdp.num_states, mdp.num_actions)
    if table.shape != one and (horizon is None or table.shape != (horizon, *one)):
        over_time = "" if horizon is None else f" or [{horizon}, {one[0]}, {one[1]}]"
        raise ValueError(f"the policy has shape {table.shape} and must be [{one[0]}, {one[1]}]{over_time}: "
                         "a probability for each action in each state")  # fmt: skip
    if not (np.all(table >= 0) and np.all(np.abs(table.sum(-1) - 1) <= 1e-5)):
        raise ValueError(
            "a row of the policy is not a distribution over actions: its entries must be at least 0 and sum to 1"
        )
    return table if horizon is None else np.broadcast_to(table, (horizon, *one))


class TablePolicy(Policy):
    """Acts from a table `[O, A]`, or `[T, O, A]` with the time as its memory (the last row goes on for ever).

    Keeps `log_prob`; `inspect` shows `probabilities`.
    """

    table: Float[Array, "... O A"]

    def init(self, key: PRNGKey) -> Int[Array, ""]:
        del key
        return jnp.zeros((), jnp.int32)

    def __call__(
        self, carry: Int[Array, ""], observation: Int[Array, ""], key: PRNGKey
    ) -> tuple[Int[Array, ""], Int[Array, ""], dict[str, Array]]:
        row = self._row(carry, observation)
        action = draw(jnp.cumsum(row), jax.random.uniform(key, (), jnp.float32))
        return carry + 1, action, {"log_prob": jnp.log(row[action])}

    def inspect(self, carry: Int[Array, ""], observation: Int[Array, ""]) -> dict[str, Array]:
        return {"probabilities": self._row(carry, observation)}

    def _row(self, time: Array, observation: Array) -> Array:
        table = jnp.asarray(self.table, jnp.float32)
        return table[observation] if table.ndim == 2 else table[jnp.minimum(time, len(table) - 1), observation]
