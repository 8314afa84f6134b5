"""Tabular Markov decision processes: the arrays, the checks, and the environment that samples from them.

    P[s, a, s'] = p(s_{t+1} = s' | s_t = s, a_t = a),   R[s, a] = r(s, a),   p_0[s] = p(s_0 = s),   discount γ.

Given (s_t, a_t), the next state does not depend on anything earlier (erratum E1.4 words it so). In a partially
observed problem the agent sees o_t ~ O(· | s_t) in place of s_t. Terminal states have value 0: entering one gives
`terminated` (erratum E1.5). A finite `horizon` T is a true end of the problem too, V_T = 0 (erratum E1.2), so the
T-th step gives `terminated`; a time limit that only cuts episodes short is a wrapper's business and gives
`truncated`.

Source: notes, section 1.1.
"""

from collections.abc import Sequence

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..core import Environment, Model, PRNGKey, Timestep

Table = Array | np.ndarray | Sequence


def as_floats(values: Table) -> np.ndarray:
    """As NumPy in the precision given: float32 stays float32, everything else becomes float64."""
    array = np.array(values)
    return array if array.dtype == np.float32 else array.astype(np.float64)


def check_distributions(name: str, rows: np.ndarray) -> None:
    """Raise `ValueError` unless the last axis of `rows` holds probabilities.

    None may be negative, and they must sum to 1 within 1e-12 (float32: 1e-5).
    """
    tolerance = 1e-12 if rows.dtype == np.float64 else 1e-5
    negative = np.argwhere(~(rows >= 0))
    if len(negative):
        place, value = ", ".join(map(str, negative[0])), rows[tuple(negative[0])]
        raise ValueError(f"{name}[{place}] is {value:g}, which is no probability: every entry must be at least 0")
    sums = rows.sum(-1, dtype=np.float64)
    wrong = np.argwhere(~(np.abs(sums - 1) <= tolerance))
    if len(wrong):
        place, value = ", ".join([*map(str, wrong[0]), ":"]), sums[tuple(wrong[0])]
        raise ValueError(
            f"{name}[{place}] sums to {value:.15g} and probabilities must sum to 1 within {tolerance:g}: mend that row"
        )


def can_end(transitions: Array | np.ndarray, terminal: Array | np.ndarray) -> np.ndarray:
    """From which states a path of positive probability leads to a terminal one: `[..., S]` for chains `[..., S, S]`."""
    possible = np.asarray(transitions) > 0
    ends = np.broadcast_to(np.asarray(terminal), possible.shape[:-1])
    for _ in range(possible.shape[-1]):
        ends = ends | (possible & ends[..., None, :]).any(-1)
    return ends


class MDP(eqx.Module):
    """A validated Markov decision process in arrays (items 1.1 and 1.9). Build it outside compiled code.

    - `transitions`: P, rows sum to 1 within 1e-12.
    - `rewards`: r(s, a). Given as r(s, a, s') they are reduced to r(s, a) = Σ_s' P(s' | s, a) r(s, a, s'), which
      leaves every value as it was, and kept in `outcome_rewards` too, for the environment to give.
    - `initial`: p_0, or the one state that episodes start in. Terminal states cannot be started in.
    - `discount`: γ in [0, 1]. 1 needs a horizon or, from every state, a way to a terminal one.
    - `terminal`: which states end the episode when they are entered. They are stored as absorbing with reward 0,
      whatever the arrays say of them, so that V(terminal) = 0 needs no special case.
    - `horizon`: T, the number of actions, or `None`.

    The leaves are NumPy arrays: float32 stays float32, all else becomes float64. Raises `ValueError` for anything
    that is not such a process.
    """

    transitions: Float[Array | np.ndarray, "S A S"]
    rewards: Float[Array | np.ndarray, "S A"]
    initial: Float[Array | np.ndarray, "S"]
    discount: Float[Array | np.ndarray, ""]
    terminal: Bool[Array | np.ndarray, "S"]
    outcome_rewards: Float[Array | np.ndarray, "S A S"] | None
    horizon: int | None = eqx.field(static=True)

    def __init__(
        self,
        transitions: Table,
        rewards: Table,
        initial: Table | int = 0,
        discount: float | np.floating | Array | np.ndarray = 1.0,
        terminal: Table | None = None,
        horizon: int | None = None,
    ) -> None:
        self.transitions = as_floats(transitions)
        if (
            self.transitions.ndim != 3
            or self.transitions.shape[0] != self.transitions.shape[2]
            or not self.transitions.size
        ):
            raise ValueError(
                f"transitions has shape {self.transitions.shape}, and it must be [S, A, S]: "
                "for each state and action a distribution over the next states"
            )
        states, actions, _ = self.transitions.shape
        self.terminal = np.array([False] * states if terminal is None else terminal, bool)
        if self.terminal.shape != (states,):
            raise ValueError(
                f"terminal has shape {self.terminal.shape} for {states} states: give one flag for each state"
            )
        given = as_floats(rewards)
        if given.shape not in ((states, actions), (states, actions, states)):
            raise ValueError(
                f"rewards has shape {given.shape} and the transitions want [{states}, {actions}] or "
                f"[{states}, {actions}, {states}]: give r(s, a) or r(s, a, s')"
            )
        if not np.all(np.isfinite(given)):
            raise ValueError(
                "rewards has an entry that is not finite, so no value is defined: use a finite penalty instead"
            )
        self.transitions[self.terminal] = np.eye(states, dtype=self.transitions.dtype)[self.terminal][:, None]
        given[self.terminal] = 0
        self.outcome_rewards = given if given.ndim == 3 else None
        self.rewards = given if given.ndim == 2 else (self.transitions * given).sum(-1)
        self.initial = initial_distribution(initial, self.terminal)
        self.discount = np.asarray(discount, np.float64)
        self.horizon = horizon
        check_distributions("transitions", self.transitions)
        self._check_ends()

    def _check_ends(self) -> None:
        check_discount(self.discount)
        if self.horizon is not None and (type(self.horizon) is not int or self.horizon < 1):
            raise ValueError(
                f"horizon is {self.horizon} and must be a number of actions, at least 1, or None for no end"
            )
        if self.discount < 1 or self.horizon is not None:
            return
        stuck = np.flatnonzero(~can_end(self.transitions.mean(1), self.terminal))
        if len(stuck):
            raise ValueError(
                f"discount 1 without a horizon gives endless sums, because no terminal state can be reached from state "
                f"{stuck[0]}: lower the discount, set a horizon or mark a terminal state"
            )

    @property
    def num_states(self) -> int:
        """S."""
        return self.transitions.shape[-1]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.transitions.shape[-2]

    @property
    def continuation(self) -> Float[Array | np.ndarray, "S A S"]:
        """P(s' | s, a) (1 - terminal(s')): the part of the next state that there is a value to bootstrap from."""
        return self.transitions * (1 - self.terminal.astype(self.transitions.dtype))[None, None]


def check_discount(discount: np.ndarray | Array) -> None:
    """Raise `ValueError` unless it is one number in [0, 1]."""
    if discount.ndim or not 0 <= discount <= 1:
        raise ValueError(f"discount is {discount} and must be one number in [0, 1]")


def initial_distribution(initial: Table | int, terminal: np.ndarray) -> np.ndarray:
    """p_0 from probabilities, or from the one state that episodes start in; nothing starts in a terminal state."""
    states = len(terminal)
    if isinstance(initial, (int, np.integer)):
        if not 0 <= initial < states:
            raise ValueError(f"initial is state {initial} and there are {states}: give a state from 0 to {states - 1}")
        start = np.zeros(states)
        start[initial] = 1.0
    else:
        start = as_floats(initial)
    if start.shape != (states,):
        raise ValueError(f"initial has shape {start.shape} for {states} states: give one probability for each state")
    check_distributions("initial", start)
    if start[terminal].any():
        state = np.flatnonzero(terminal & (start > 0))[0]
        raise ValueError(
            f"initial gives probability {start[state]:g} to the terminal state {state}, where nothing can be done: "
            "start in a state that is not terminal"
        )
    return start


class POMDP(eqx.Module):
    """An MDP whose states are hidden: O(z | s) = `emissions[s, z]` is what is seen in their place (item 1.2).

    Raises `ValueError` unless there is one distribution for each state.
    """

    mdp: MDP
    emissions: Float[Array | np.ndarray, "S Z"]

    def __init__(self, mdp: MDP, emissions: Table) -> None:
        self.mdp = mdp
        self.emissions = as_floats(emissions)
        if self.emissions.ndim != 2 or len(self.emissions) != mdp.num_states or not self.emissions.size:
            raise ValueError(
                f"emissions has shape {self.emissions.shape} for {mdp.num_states} states: "
                "give [S, Z], for each state a distribution over the observations"
            )
        check_distributions("emissions", self.emissions)

    @property
    def num_observations(self) -> int:
        """Z."""
        return self.emissions.shape[-1]


def cumulative(probabilities: Array | np.ndarray) -> Array:
    """Running sums, added up in the precision given and kept in float32, for `draw`."""
    return jnp.asarray(probabilities.cumsum(-1), jnp.float32)


def draw(cumulative: Float[Array, "K"], uniform: Float[Array, ""]) -> Int[Array, ""]:
    """A sample by the inverse distribution function: one uniform number in place of K Gumbel ones.

    Scaling by the last running sum keeps rounding from ever choosing an outcome of probability 0.
    """
    return (cumulative <= uniform * cumulative[-1]).sum().astype(jnp.int32)


class TabularState(eqx.Module):
    """The hidden state of a `TabularEnv`, and how many actions were taken."""

    state: Int[Array, ""]
    time: Int[Array, ""]


class TabularEnv(Environment):
    """The environment of an `MDP` (observes the state) or a `POMDP` (observes o ~ O(· | s)); item 1.3.

    Rewards are r(s, a), or r(s, a, s') where the MDP was built from those. `terminated` marks a terminal state or the
    horizon, `truncated` is never set, and there are no extras. With O the identity a POMDP gives, bit for bit, what
    its MDP gives.
    """

    problem: MDP | POMDP
    start_table: Float[Array, "S"]
    next_table: Float[Array, "S A S"]
    emission_table: Float[Array, "S Z"] | None

    def __init__(self, problem: MDP | POMDP) -> None:
        self.problem = problem
        self.start_table = cumulative(self.mdp.initial)
        self.next_table = cumulative(self.mdp.transitions)
        self.emission_table = cumulative(problem.emissions) if isinstance(problem, POMDP) else None

    @property
    def mdp(self) -> MDP:
        """The process underneath."""
        return self.problem.mdp if isinstance(self.problem, POMDP) else self.problem

    @property
    def observation_space(self) -> spaces.Discrete:
        problem = self.problem
        return spaces.Discrete(problem.num_observations if isinstance(problem, POMDP) else problem.num_states)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(self.mdp.num_actions)

    def reset(self, key: PRNGKey) -> tuple[TabularState, Int[Array, ""]]:
        # Two numbers even where nothing is emitted: the same states with and without observations, at no cost
        # (threefry makes two at a time).
        uniform = jax.random.uniform(key, (2,), jnp.float32)
        state = draw(self.start_table, uniform[0])
        return TabularState(state, jnp.zeros((), jnp.int32)), self._observe(state, uniform[1])

    def step(self, state: TabularState, action: Int[Array, ""], key: PRNGKey) -> tuple[TabularState, Timestep]:
        uniform = jax.random.uniform(key, (2,), jnp.float32)
        following = draw(self.next_table[state.state, action], uniform[0])
        time = state.time + 1
        terminated = jnp.asarray(self.mdp.terminal)[following]
        if self.mdp.horizon is not None:
            terminated = terminated | (time >= self.mdp.horizon)
        observation = self._observe(following, uniform[1])
        reward = _reward(self.mdp, state.state, action, following)
        timestep = Timestep(observation, reward, terminated, jnp.zeros((), bool), observation, {})
        return TabularState(following, time), timestep

    def _observe(self, state: Array, uniform: Array) -> Array:
        return state if self.emission_table is None else draw(self.emission_table[state], uniform)


def _reward(mdp: MDP, state: Array, action: Array, following: Array) -> Array:
    if mdp.outcome_rewards is None:
        return jnp.asarray(mdp.rewards, jnp.float32)[state, action]
    return jnp.asarray(mdp.outcome_rewards, jnp.float32)[state, action, following]


class TabularModel(Model):
    """p(s' | s, a) of an MDP as a model to plan with: sample, probability, reward, end (item 1.7).

    States are their indices. The horizon is not part of it: a planner counts its own steps.
    """

    mdp: MDP
    next_table: Float[Array, "S A S"]

    def __init__(self, mdp: MDP) -> None:
        self.mdp = mdp
        self.next_table = cumulative(mdp.transitions)

    def encode(self, observation: Int[Array, ""]) -> Int[Array, ""]:
        return jnp.asarray(observation, jnp.int32)

    def transition(self, state: Int[Array, ""], action: Int[Array, ""], key: PRNGKey) -> Int[Array, ""]:
        return draw(self.next_table[state, action], jax.random.uniform(key, (), jnp.float32))

    def reward(self, state: Int[Array, ""], action: Int[Array, ""], next_state: Int[Array, ""]) -> Float[Array, ""]:
        return _reward(self.mdp, state, action, next_state)

    def terminal(self, state: Int[Array, ""]) -> Bool[Array, ""]:
        return jnp.asarray(self.mdp.terminal)[state]

    def probabilities(self, state: Int[Array, ""], action: Int[Array, ""]) -> Float[Array, "S"]:
        """p(· | s, a), which is also the mean of the next state written as a one-hot vector."""
        return jnp.asarray(self.mdp.transitions)[state, action]

    def log_prob(self, state: Int[Array, ""], action: Int[Array, ""], next_state: Int[Array, ""]) -> Float[Array, ""]:
        """The logarithm of p(s' | s, a); -inf where it cannot happen."""
        return jnp.log(self.probabilities(state, action)[next_state])
