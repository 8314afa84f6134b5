"""Markov decision processes with few successors: lists of them in place of rows over all states, checks, and the environment.

    P(s' | s, a) = Σ_k probabilities[s, a, k] 1{successors[s, a, k] = s'},   K outcomes for each state and action.

An outcome may *end* the episode wherever it leads (`ends[s, a, k]`), as in Gymnasium's toy environments, where the same square can be
reached with and without an end; then nothing is worth anything after it. A million states with four outcomes each are 50 MB an action
where the full matrix would be eight terabytes.

Source: notes, section 5.2.2 (dynamic programming with a known p(s' | s, a)).
"""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..core import MASK, Observation, Observed, PRNGKey, Timestep
from .tabular import MDP, Table, check_discount, check_distributions, cumulative, draw, initial_distribution


class SparseMDP(eqx.Module):
    """A validated Markov decision process in lists of outcomes. Build it outside compiled code.

    - `successors`: s' of each outcome, `[S, A, K]`. Outcomes that cannot happen are there with probability 0.
    - `probabilities`: of each outcome; they sum to 1 within 1e-12.
    - `rewards`: r(s, a). Given by outcome, `[S, A, K]`, they are reduced to their mean, which leaves every value as it was, and
      kept in `outcome_rewards` too, for the environment to give.
    - `initial`: p_0, or the one state that episodes start in.
    - `discount`: γ in [0, 1]. 1 needs, from every state, a way to an end.
    - `terminal`: states that end the episode when they are entered, stored as absorbing with reward 0, so that V(terminal) = 0.
    - `ends`: outcomes that end the episode besides those that enter a terminal state.

    The leaves are NumPy arrays in float64. Raises `ValueError` for anything that is not such a process.
    """

    successors: Int[np.ndarray, "S A K"]
    probabilities: Float[np.ndarray, "S A K"]
    rewards: Float[np.ndarray, "S A"]
    initial: Float[np.ndarray, "S"]
    discount: Float[np.ndarray, ""]
    terminal: Bool[np.ndarray, "S"]
    ends: Bool[np.ndarray, "S A K"]
    outcome_rewards: Float[np.ndarray, "S A K"] | None

    def __init__(
        self,
        successors: Table,
        probabilities: Table,
        rewards: Table,
        initial: Table | int = 0,
        discount: float | np.floating | Array | np.ndarray = 1.0,
        terminal: Table | None = None,
        ends: Table | None = None,
    ) -> None:
        self.successors = _states(successors)
        shape = self.successors.shape
        self.probabilities = _shaped("probabilities", probabilities, shape)
        given = np.asarray(rewards, np.float64)
        if given.shape not in (shape, shape[:2]):
            raise ValueError(
                f"rewards has shape {given.shape} and the successors want {list(shape[:2])} or {list(shape)}: "
                "give r(s, a), or the reward of each outcome"
            )
        if not np.all(np.isfinite(given)):
            raise ValueError(
                "rewards has an entry that is not finite, so no value is defined: use a finite penalty instead"
            )
        self.terminal = np.zeros(shape[0], bool) if terminal is None else np.array(terminal, bool)
        if self.terminal.shape != shape[:1]:
            raise ValueError(
                f"terminal has shape {self.terminal.shape} for {shape[0]} states: give one flag for each state"
            )
        self.ends = np.zeros(shape, bool) if ends is None else np.array(ends, bool)
        if self.ends.shape != shape:
            raise ValueError(f"ends has shape {self.ends.shape} and must be {list(shape)}: one flag for each outcome")
        if self.terminal.any():
            given = given.copy()
            given[self.terminal] = 0.0
            self.successors[self.terminal] = np.flatnonzero(self.terminal)[:, None, None]
            self.ends |= self.terminal[self.successors]
        self.outcome_rewards = given if given.ndim == 3 else None
        self.rewards = given if given.ndim == 2 else (self.probabilities * given).sum(-1)
        self.initial = initial_distribution(initial, self.terminal)
        self.discount = np.asarray(discount, np.float64)
        check_distributions("probabilities", self.probabilities)
        check_discount(self.discount)
        if self.discount == 1:
            stuck = np.flatnonzero(~self.can_end())
            if len(stuck):
                raise ValueError(
                    f"discount 1 gives endless sums, because no end can be reached from state {stuck[0]}: "
                    "lower the discount, or mark a terminal state"
                )

    @property
    def num_states(self) -> int:
        """S."""
        return self.successors.shape[0]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.successors.shape[1]

    @property
    def continuation(self) -> Float[np.ndarray, "S A K"]:
        """The probability of each outcome that goes on: the part of it that there is a value to bootstrap from."""
        return self.probabilities * ~self.ends

    def predecessors(self) -> tuple[Int[np.ndarray, "S1"], Int[np.ndarray, "N"]]:
        """Which states may lead to s: `sources[offsets[s] : offsets[s + 1]]`; outcomes that end lead nowhere. A source may come twice."""
        possible = (self.probabilities > 0) & ~self.ends
        source, target = np.nonzero(possible)[0].astype(np.int32), self.successors[possible]
        order = np.argsort(target, kind="stable")
        offsets = np.concatenate([[0], np.cumsum(np.bincount(target, minlength=self.num_states))])
        return offsets, source[order]

    def can_end(self) -> Bool[np.ndarray, "S"]:
        """From which states a path of positive probability leads to an end: breadth first, backwards."""
        found = self.terminal | ((self.probabilities > 0) & self.ends).any((1, 2))
        lists, front = self.predecessors(), np.flatnonzero(found)
        while len(front):
            reached = before(lists, front)
            front = reached[~found[reached]]
            found[front] = True
        return found

    def with_discount(self, discount: float) -> "SparseMDP":
        """The same process with another discount; raises as the constructor does."""
        rewards = self.rewards if self.outcome_rewards is None else self.outcome_rewards
        given = (self.successors, self.probabilities, rewards, self.initial, discount, self.terminal, self.ends)
        return SparseMDP(*given)

    def to_dense(self) -> MDP:
        """The same process as full matrices. Outcomes that end lead to one more state, the last, which is terminal.

        Without such outcomes (beside the terminal states' own) the states stay as they are. Raises `ValueError` where the
        matrices would not fit.
        """
        states, actions = self.num_states, self.num_actions
        extra = bool((self.ends & ~self.terminal[self.successors]).any())
        size = states + extra
        if 8 * size * size * actions > MOST_BYTES:
            raise ValueError(
                f"full matrices of {states:,} states and {actions} actions take {8e-9 * size * size * actions:,.0f} GB: "
                "keep the lists, which sweeps (value iteration, modified policy iteration) work with"
            )
        where = np.where(self.ends & ~self.terminal[self.successors], states, self.successors)
        transitions = np.zeros((size, actions, size))
        s, a, _ = np.indices(where.shape)
        np.add.at(transitions, (s, a, where), self.probabilities)
        transitions[states:, :, -1] = 1.0
        pad = lambda x: np.concatenate([x, np.zeros((size - states, *x.shape[1:]), x.dtype)])  # noqa: E731
        terminal = np.logical_or(pad(self.terminal), np.arange(size) >= states)
        return MDP(transitions, pad(self.rewards), pad(self.initial), self.discount, terminal)


MOST_BYTES = 4e9
"""The largest matrices that are made without being asked for them by name."""


def before(
    lists: tuple[Int[np.ndarray, "S1"], Int[np.ndarray, "N"]], states: Int[np.ndarray, "M"]
) -> Int[np.ndarray, "L"]:
    """The predecessors of some states, from the lists of `SparseMDP.predecessors`, each once."""
    offsets, sources = lists
    counts = offsets[states + 1] - offsets[states]
    # The positions of all of them, as one range with jumps.
    jumps = np.repeat(offsets[states] - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
    return np.unique(sources[jumps + np.arange(counts.sum())])


def _states(successors: Table) -> Int[np.ndarray, "S A K"]:
    given = np.asarray(successors)
    if given.ndim != 3 or not given.size or given.dtype.kind not in "iu":
        raise ValueError(
            f"successors has shape {given.shape} and type {given.dtype}, and must be whole numbers [S, A, K]: "
            "for each state and action the states it may lead to"
        )
    wrong = np.argwhere((given < 0) | (given >= len(given)))
    if len(wrong):
        place = ", ".join(map(str, wrong[0]))
        raise ValueError(
            f"successors[{place}] is {given[tuple(wrong[0])]} and there are {len(given)} states: "
            f"give states from 0 to {len(given) - 1}"
        )
    return given.astype(np.int32)


def _shaped(name: str, values: Table, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(values, np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape} and must be {list(shape)}: one number for each successor")
    return array


def sparse_of(mdp: MDP) -> SparseMDP:
    """The lists of a process in full matrices; K is the largest number of successors that any state and action has.

    Raises `ValueError` for a finite horizon, which lists do not have.
    """
    if mdp.horizon is not None:
        raise ValueError(
            f"the problem has a horizon of {mdp.horizon} actions, and a sparse one has none: use the full matrices"
        )
    table = np.asarray(mdp.transitions, np.float64)
    width = int((table > 0).sum(-1).max())
    successors = np.argsort(-table, axis=-1, kind="stable")[..., :width]
    probabilities = np.take_along_axis(table, successors, -1)
    rewards = np.asarray(mdp.rewards if mdp.outcome_rewards is None else mdp.outcome_rewards, np.float64)
    if rewards.ndim == 3:
        rewards = np.take_along_axis(rewards, successors, -1)
    initial = np.asarray(mdp.initial, np.float64)
    return SparseMDP(successors, probabilities, rewards, initial, mdp.discount, mdp.terminal)


class SparseEnv(Observed):
    """The environment of a `SparseMDP`: observes the state, draws an outcome, gives its reward.

    With `masks` the observation is a dictionary of the state and of which actions are allowed in it, as Gymnasium's door makes one of
    an environment that tells its mask in `info`.
    """

    start_table: Float[Array, "S"]
    outcome_table: Float[Array, "S A K"]
    successors: Int[Array, "S A K"]
    rewards: Float[Array, "S A K"]
    ends: Bool[Array, "S A K"]
    masks: Array | None

    def __init__(self, problem: SparseMDP, masks: np.ndarray | None = None) -> None:
        self.start_table, self.outcome_table = cumulative(problem.initial), cumulative(problem.probabilities)
        rewards = problem.rewards[..., None] if problem.outcome_rewards is None else problem.outcome_rewards
        self.rewards = jnp.asarray(np.broadcast_to(rewards, problem.successors.shape), jnp.float32)
        self.successors, self.ends = jnp.asarray(problem.successors), jnp.asarray(problem.ends)
        self.masks = None if masks is None else jnp.asarray(masks, jnp.int8)

    @property
    def observation_space(self) -> spaces.Space:
        states = spaces.Discrete(self.successors.shape[0])
        if self.masks is None:
            return states
        return spaces.Dict({"observation": states, MASK: spaces.MultiBinary(self.successors.shape[1])})

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(self.successors.shape[1])

    def reset(self, key: PRNGKey) -> tuple[Int[Array, ""], Observation]:
        state = draw(self.start_table, jax.random.uniform(key, (), jnp.float32))
        return state, self._observe(state)

    def state_of(self, observation: Observation) -> Int[Array, ""]:
        return jnp.asarray(observation if self.masks is None else observation["observation"], jnp.int32)

    def step(self, state: Int[Array, ""], action: Int[Array, ""], key: PRNGKey) -> tuple[Int[Array, ""], Timestep]:
        outcome = draw(self.outcome_table[state, action], jax.random.uniform(key, (), jnp.float32))
        at = (state, action, outcome)
        following = self.successors[at]
        observation = self._observe(following)
        timestep = Timestep(observation, self.rewards[at], self.ends[at], jnp.zeros((), bool), observation, {})
        return following, timestep

    def _observe(self, state: Int[Array, ""]) -> Observation:
        return state if self.masks is None else {"observation": state, MASK: self.masks[state]}
