r"""A search as the teacher of a policy that answers at once (item 8.25; Guo et al. 2014; in the form of DAgger, Ross et al. 2011).

The student acts, the search says for each state that it came to what it would have done there, and the student learns from all the
answers so far:

    s ~ d^{pi_theta},   a*(s) = mcts(s),   theta <- argmin_theta  sum_{D} -log pi_theta(a* | s),   D <- D with (s, a*).

The states are the student's own, so that what it learns is right where it goes, and errors do not add up along an episode (chapter 2).
What it acts with afterwards is one pass of a network in place of hundreds of simulations.

Deviations: Guo et al. distil into a classifier of pictures and, at first, act by the search; here the student acts from the start, sampling
its actions, and the answers are kept in a memory of fixed size.
"""

import dataclasses
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..core import (
    Actor,
    Algorithm,
    Choices,
    Configured,
    EnvSpec,
    Episodes,
    Learner,
    Number,
    Observation,
    Policy,
    PRNGKey,
    State,
    Transition,
    VectorEnv,
    env_spec,
    fix_horizon,
    number,
    part,
    require_action,
    setting,
)
from ..data.noise import EXPERT
from ..data.replay import Replay, ReplayState, UniformReplay
from ..loops.collect import begin, collect
from .guides import Rollouts
from .tree_policies import UCT
from .tree_search import SearchPolicy, TreeSearch, mcts


class DistillState(eqx.Module):
    """The student, where its environments stand, and the answers so far."""

    learner: State
    actor: Actor
    replay: ReplayState


class Distill(Algorithm, Configured):
    """Each iteration takes `unroll` steps of the student in each environment, asks a search by UCT in `model` about every state on the
    way, and learns from `updates` batches of all the answers.

    `model` is what the environment is a view of, a game or a model with numbered actions, and its `encode` reads the environment's
    observations. Raises `ValueError` where the learner wants anything else than transitions, and for other actions than the model's.
    """

    env: VectorEnv
    learner: Learner
    model: Choices
    replay: Replay = part(UniformReplay(), "the memory of answers")
    simulations: int = setting(100, "simulations for each answer", at_least=1)
    exploration: Number = number(0.5**0.5, "C: weight of the confidence bound of UCT", at_least=0)
    horizon: int = setting(100, "steps after which a rollout is cut", at_least=1)
    discount: Number = number(1.0, "gamma of the search", at_least=0, at_most=1)
    outcomes: int = setting(1, "next states told apart after one action; 1 for deterministic models", at_least=1)
    unroll: int = setting(4, "steps in each environment between two visits to the memory", at_least=1)
    updates: int = setting(8, "batches learnt from in each iteration", at_least=1)
    batch_size: int = setting(64, "answers in a batch", at_least=1)

    def __check_init__(self) -> None:
        if self.learner.batch != "transitions":
            raise ValueError(
                f"{type(self.learner).__name__} learns from {self.learner.batch}, and a search answers for single states: "
                "give a learner of transitions, such as BC with a network without a memory"
            )
        require_action("a search", self.spec, ("discrete",))
        if self.spec.action.counts != (self.model.num_actions,):
            raise ValueError(
                f"the model has {self.model.num_actions} actions and the environment {self.spec.action.counts[0]}: "
                "give the model of this environment"
            )

    @staticmethod
    def default_num_envs() -> int:
        """Environments side by side where nobody says how many."""
        return 16

    @property
    def spec(self) -> EnvSpec:
        return env_spec(self.env)

    @property
    def steps_per_iteration(self) -> int:
        return self.unroll * self.env.num_envs

    @property
    def initial_steps(self) -> int:
        return 0

    @property
    def search(self) -> TreeSearch:
        """The teacher."""
        return TreeSearch(
            simulations=self.simulations,
            rule=UCT(exploration=self.exploration),
            guide=Rollouts(horizon=self.horizon),
            discount=self.discount,
            outcomes=self.outcomes,
        )

    def teacher(self) -> SearchPolicy:
        """The search as a policy, to be measured beside its student."""
        return SearchPolicy(self.model, self.search)

    def with_horizon(self, iterations: int) -> "Distill":
        horizon = iterations * self.updates
        learner, replay = fix_horizon(self.learner, horizon), fix_horizon(self.replay, horizon)
        return dataclasses.replace(self, learner=learner, replay=replay)

    def init(self, key: PRNGKey) -> DistillState:
        learner_key, actor_key = jax.random.split(key)
        learner = self.learner.init(self.spec, learner_key)
        policy = self.learner.policy(learner, explore=True)
        actor = begin(self.env, policy, actor_key)
        example = jax.eval_shape(lambda a, k: self._visit(policy, a, k)[1], actor, actor_key)
        return DistillState(learner, actor, self.replay.init(example, self.unroll))

    def step(self, state: DistillState, key: PRNGKey) -> tuple[DistillState, tuple[dict[str, Array], Episodes]]:
        visit_key, label_key, learn_key = jax.random.split(key, 3)
        policy = self.learner.policy(state.learner, explore=True)
        actor, visited, episodes = self._visit(policy, state.actor, visit_key)
        labels = self.answers(visited.observation, label_key)
        agreement = (labels == visited.action).astype(jnp.float32).mean()
        answered = dataclasses.replace(visited, extras={EXPERT: labels})
        replay = self.replay.add(state.replay, answered)

        def update(learner: State, keys: Array) -> tuple[State, dict[str, Array]]:
            batch = self.replay.sample(replay, keys[0], self.batch_size)
            learner, metrics, _ = self.learner.update(learner, batch, keys[1])
            return learner, metrics

        learner, metrics = jax.lax.scan(update, state.learner, jax.random.split(learn_key, (self.updates, 2)))
        metrics = jax.tree.map(jnp.mean, metrics) | {"agreement": agreement}
        return DistillState(learner, actor, replay), (metrics, episodes)

    def answers(self, observation: Observation, key: PRNGKey) -> Int[Array, "T B"]:
        """What the search would do in each of the states that were seen, `[T, B]` of them, all in one program."""
        keys = jax.random.split(key, (self.unroll, self.env.num_envs))
        search = self.search

        def answer(observation: Observation, key: PRNGKey) -> Array:
            return mcts(self.model, self.model.encode(observation), key, search).value.action

        return jax.vmap(jax.vmap(answer))(observation, keys)

    def _visit(self, policy: Policy, actor: Actor, key: PRNGKey) -> tuple[Actor, Transition, Episodes]:
        """Where the student comes to `[T, B]`, with room for an answer to each state."""
        actor, rollout, episodes = collect(self.env, policy, actor, key, self.unroll)
        blank = jnp.zeros(rollout.transitions.reward.shape, jnp.int32)
        visited = dataclasses.replace(rollout.transitions, extras={EXPERT: blank})
        return actor, cast(Transition, visited), episodes

    def learned(self, state: DistillState) -> State:
        return state.learner

    def policy(self, state: DistillState, explore: bool = False) -> Policy:
        return self.learner.policy(state.learner, explore)
