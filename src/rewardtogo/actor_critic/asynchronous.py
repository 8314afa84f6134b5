"""Asynchronous actor-critic (notes 4.7, figure 4.2; Mnih et al. 2016): workers that act with parameters of different ages.

W workers act, each in environments of its own and with the parameters it fetched when it last delivered. In every iteration one
worker, in turn or drawn at random, delivers its rollout to the server, which updates the parameters, and takes the new ones with it.
In turn, each rollout is made by parameters that are W - 1 updates old. Time is counted in updates and everything happens in
one compiled program, so that a run repeats to the bit.

Deviations from A3C: the server computes the update at its current parameters from what the worker saw (as IMPALA does), rather than
adding a gradient that the worker computed at old ones; a learner that corrects for the age of the data (`returns="vtrace"`) can.
"""

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..core import (
    Actor,
    Algorithm,
    Configured,
    EnvSpec,
    Episodes,
    Learner,
    Policy,
    PRNGKey,
    Rollout,
    State,
    VectorEnv,
    env_spec,
    fix_horizon,
    setting,
)
from ..loops.collect import begin, collect


class AsynchronousState(eqx.Module):
    """The server's learner; and of each worker, along the first axis, where it stands, what it acts with, and since which update."""

    learner: State
    actors: Actor
    acting: State
    fetched: Int[Array, "W"]
    updates: Int[Array, ""]


class Delivery(eqx.Module):
    """A rollout, and the worker that it comes from."""

    rollout: Rollout
    worker: Int[Array, ""]


class Asynchronous(Algorithm, Configured):
    """Workers with lagged parameters around one learner of rollouts. `env` is what one worker acts in.

    Raises `ValueError` where the learner wants anything else than a rollout.
    """

    env: VectorEnv
    learner: Learner
    workers: int = setting(8, "W: workers, each with environments of its own", at_least=1)
    unroll: int = setting(20, "steps in each environment between two visits to the server", at_least=1)
    order: Literal["in_turn", "random"] = setting(
        "in_turn", "which worker delivers next", choices=("in_turn", "random")
    )

    def __check_init__(self) -> None:
        if self.learner.batch != "rollout":
            raise ValueError(
                f"{type(self.learner).__name__} learns from {self.learner.batch}, and asynchronous workers deliver rollouts: use OffPolicy"
            )

    @staticmethod
    def default_num_envs() -> int:
        """Environments of one worker where nobody says how many."""
        return 1

    @property
    def spec(self) -> EnvSpec:
        return env_spec(self.env)

    @property
    def steps_per_iteration(self) -> int:
        return self.unroll * self.env.num_envs

    @property
    def initial_steps(self) -> int:
        return 0

    def with_horizon(self, iterations: int) -> "Asynchronous":
        return dataclasses.replace(self, learner=fix_horizon(self.learner, iterations))

    def init(self, key: PRNGKey) -> AsynchronousState:
        learner_key, actor_key = jax.random.split(key)
        learner = self.learner.init(self.spec, learner_key)
        policy = self.learner.policy(learner, explore=True)
        actors = jax.vmap(lambda key: begin(self.env, policy, key))(jax.random.split(actor_key, self.workers))
        acting = jax.tree.map(lambda x: jnp.broadcast_to(x, (self.workers, *x.shape)), policy)
        zero = jnp.zeros((), jnp.int32)
        return AsynchronousState(learner, actors, acting, jnp.zeros(self.workers, jnp.int32), zero)

    def step(
        self, state: AsynchronousState, key: PRNGKey
    ) -> tuple[AsynchronousState, tuple[dict[str, jax.Array], Episodes]]:
        act_key, learn_key = jax.random.split(key)
        state, delivery, episodes = self.act(state, act_key)
        state, metrics = self.learn(state, delivery, learn_key)
        return state, (metrics, episodes)

    def act(self, state: AsynchronousState, key: PRNGKey) -> tuple[AsynchronousState, Delivery, Episodes]:
        """The first half of an iteration: the next worker's rollout, with the parameters that it has."""
        choice_key, collect_key = jax.random.split(key)
        if self.order == "in_turn":
            worker = state.updates % self.workers
        else:
            worker = jax.random.randint(choice_key, (), 0, self.workers)
        actor, policy = jax.tree.map(lambda x: x[worker], (state.actors, state.acting))
        actor, rollout, episodes = collect(self.env, policy, actor, collect_key, self.unroll)
        actors = jax.tree.map(lambda all, one: all.at[worker].set(one), state.actors, actor)
        return dataclasses.replace(state, actors=actors), Delivery(rollout, worker), episodes

    def learn(
        self, state: AsynchronousState, delivery: Delivery, key: PRNGKey
    ) -> tuple[AsynchronousState, dict[str, jax.Array]]:
        """The second half: the server learns from it, and the worker fetches the new parameters."""
        worker = delivery.worker
        learner, metrics, _ = self.learner.update(state.learner, delivery.rollout, key)
        updates, fresh = state.updates + 1, self.learner.policy(learner, explore=True)
        acting = jax.tree.map(lambda all, one: all.at[worker].set(one), state.acting, fresh)
        metrics = metrics | {"lag": (state.updates - state.fetched[worker]).astype(jnp.float32)}
        fetched = state.fetched.at[worker].set(updates)
        return AsynchronousState(learner, state.actors, acting, fetched, updates), metrics

    def learned(self, state: AsynchronousState) -> State:
        return state.learner

    def policy(self, state: AsynchronousState, explore: bool = False) -> Policy:
        return self.learner.policy(state.learner, explore)
