"""Collect, learn, forget: the loop of every learner that wants fresh data from its own policy (figure 1.2, chapters 3, 4, 7)."""

import dataclasses

import equinox as eqx
import jax

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
from .collect import begin, collect


class OnPolicyState(eqx.Module):
    """The learner's state and where the environments stand."""

    learner: State
    actor: Actor


class OnPolicy(Algorithm, Configured):
    """Each iteration takes `unroll` steps in each environment with the current policy and learns from them once.

    Raises `ValueError` where the learner wants anything else than a rollout.
    """

    env: VectorEnv
    learner: Learner
    unroll: int = setting(128, "steps in each environment between two updates", at_least=1)

    def __check_init__(self) -> None:
        if self.learner.batch != "rollout":
            raise ValueError(
                f"{type(self.learner).__name__} learns from {self.learner.batch}, not from fresh rollouts: "
                "use OffPolicy (with environments) or Offline (with a dataset)"
            )

    @staticmethod
    def default_num_envs() -> int:
        """Environments side by side where nobody says how many."""
        return 8

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
    def uses_per_sample(self) -> float:
        """How often a step is handed to the learner (item 3.26)."""
        return 1.0

    def with_horizon(self, iterations: int) -> "OnPolicy":
        return dataclasses.replace(self, learner=fix_horizon(self.learner, iterations))

    def init(self, key: PRNGKey) -> OnPolicyState:
        learner_key, actor_key = jax.random.split(key)
        learner = self.learner.init(self.spec, learner_key)
        return OnPolicyState(learner, begin(self.env, self.learner.policy(learner, explore=True), actor_key))

    def step(self, state: OnPolicyState, key: PRNGKey) -> tuple[OnPolicyState, tuple[dict[str, jax.Array], Episodes]]:
        act_key, learn_key = jax.random.split(key)
        state, rollout, episodes = self.act(state, act_key)
        state, metrics = self.learn(state, rollout, learn_key)
        return state, (metrics, episodes)

    def act(self, state: OnPolicyState, key: PRNGKey) -> tuple[OnPolicyState, Rollout, Episodes]:
        """The first half of an iteration: a rollout of the current policy."""
        policy = self.learner.policy(state.learner, explore=True)
        actor, rollout, episodes = collect(self.env, policy, state.actor, key, self.unroll)
        return OnPolicyState(state.learner, actor), rollout, episodes

    def learn(self, state: OnPolicyState, rollout: Rollout, key: PRNGKey) -> tuple[OnPolicyState, dict[str, jax.Array]]:
        """The second half: one update from it."""
        learner, metrics, _ = self.learner.update(state.learner, rollout, key)
        return OnPolicyState(learner, state.actor), metrics

    def learned(self, state: OnPolicyState) -> State:
        return state.learner

    def policy(self, state: OnPolicyState, explore: bool = False) -> Policy:
        return self.learner.policy(state.learner, explore)
