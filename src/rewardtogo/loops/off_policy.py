"""Act, remember, learn from memory: the loop of every learner that can use old data (figure 6.2: collection, replay, updates)."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

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
    part,
    setting,
)
from ..data.replay import Replay, ReplayState, UniformReplay
from .collect import RandomPolicy, begin, collect


class OffPolicyState(eqx.Module):
    """The learner's state, where the environments stand, and the memory of what happened."""

    learner: State
    actor: Actor
    replay: ReplayState


class OffPolicy(Algorithm, Configured):
    """Each iteration takes `unroll` steps in each environment and then learns from `updates` batches drawn from the replay.

    The first `warm_up` steps, inside `init`, are those of a uniformly random policy, or of the learner's own where it keeps the
    probabilities of its actions. What `update` says of each sample goes back to the replay, which may draw by it. Raises
    `ValueError` where the learner wants fresh rollouts, where the replay cannot hold what is asked of it, or where it draws by what
    the learner does not say.
    """

    env: VectorEnv
    learner: Learner
    replay: Replay = part(UniformReplay(), "the memory")
    unroll: int = setting(4, "steps in each environment between two visits to the replay", at_least=1)
    updates: int = setting(1, "batches learnt from in each iteration", at_least=1)
    batch_size: int = setting(64, "transitions (or sequences) in a batch", at_least=1)
    warm_up: int = setting(1000, "environment steps before the first update, at random", at_least=1)
    length: int = setting(16, "steps of a sequence, for learners that want sequences", at_least=1)

    def __check_init__(self) -> None:
        if self.learner.batch == "rollout":
            raise ValueError(
                f"{type(self.learner).__name__} needs fresh rollouts of its own policy, which a replay cannot give: use OnPolicy"
            )
        if self._block < 1:
            return  # what is wrong with `unroll` is said by its own range
        if self.replay.size < self._block:
            raise ValueError(
                f"a replay of {self.replay.size} transitions cannot hold one block of {self.unroll} steps in {self.env.num_envs} "
                f"environments: give it a capacity of at least {self._block}"
            )
        if self.replay.size < self.batch_size < 2**31:
            raise ValueError(
                f"a replay of {self.replay.size} transitions is smaller than a batch of {self.batch_size}, which would hold most of "
                f"them twice: give it a capacity of at least {self.batch_size}, or a smaller batch_size"
            )
        if self._sequential and self.replay.size // self._block * self.unroll < self.length:
            raise ValueError(
                f"a replay of {self.replay.size} transitions holds no sequence of {self.length} steps: "
                f"give it a capacity of at least {self.length * self.env.num_envs + self._block}"
            )

    @property
    def _block(self) -> int:
        return self.unroll * self.env.num_envs

    @property
    def _sequential(self) -> bool:
        return self.learner.batch == "sequences"

    @property
    def _warm_up_blocks(self) -> int:
        wanted = -(-self.warm_up // self._block)
        return max(wanted, -(-self.length // self.unroll)) if self._sequential else wanted

    @staticmethod
    def default_num_envs() -> int:
        """Environments side by side where nobody says how many."""
        return 1

    @property
    def spec(self) -> EnvSpec:
        return env_spec(self.env)

    @property
    def steps_per_iteration(self) -> int:
        return self._block

    @property
    def initial_steps(self) -> int:
        return self._warm_up_blocks * self._block

    @property
    def uses_per_sample(self) -> float:
        """How often a step is handed to the learner, on average (item 3.26)."""
        drawn = self.updates * self.batch_size * (self.length if self._sequential else 1)
        return drawn / self._block

    def with_horizon(self, iterations: int) -> "OffPolicy":
        horizon = iterations * self.updates
        learner, replay = fix_horizon(self.learner, horizon), fix_horizon(self.replay, horizon)
        return dataclasses.replace(self, learner=learner, replay=replay)

    def init(self, key: PRNGKey) -> OffPolicyState:
        learner_key, actor_key, warm_key = jax.random.split(key, 3)
        learner = self.learner.init(self.spec, learner_key)
        policy = self.learner.policy(learner, explore=True)
        actor = begin(self.env, policy, actor_key)
        keys = jax.random.split(warm_key, self._warm_up_blocks)
        _, example, _ = jax.eval_shape(
            lambda a, k: collect(self.env, policy, a, k, self.unroll, self._sequential), actor, keys[0]
        )
        replay = self.replay.init(example.transitions, self.unroll, self.length if self._sequential else 1)
        # Where probabilities are kept, they must be those of the actions taken: then the learner's own policy warms up.
        stochastic = "log_prob" in example.transitions.extras
        warm = policy if stochastic else _Carrying(RandomPolicy(self.spec), policy)

        def block(loop: tuple[Actor, ReplayState], key: PRNGKey) -> tuple[tuple[Actor, ReplayState], None]:
            actor, replay = loop
            actor, rollout, _ = collect(self.env, warm, actor, key, self.unroll, self._sequential)
            return (actor, self.replay.add(replay, rollout.transitions)), None

        (actor, replay), _ = jax.lax.scan(block, (actor, replay), keys)
        return OffPolicyState(learner, actor, replay)

    def step(self, state: OffPolicyState, key: PRNGKey) -> tuple[OffPolicyState, tuple[dict[str, jax.Array], Episodes]]:
        act_key, learn_key = jax.random.split(key)
        state, rollout, episodes = self.act(state, act_key)
        state, metrics = self.learn(state, rollout, learn_key)
        return state, (metrics, episodes)

    def act(self, state: OffPolicyState, key: PRNGKey) -> tuple[OffPolicyState, Rollout, Episodes]:
        """The first half of an iteration: steps in the environments."""
        policy = self.learner.policy(state.learner, explore=True)
        actor, rollout, episodes = collect(self.env, policy, state.actor, key, self.unroll, self._sequential)
        return OffPolicyState(state.learner, actor, state.replay), rollout, episodes

    def learn(
        self, state: OffPolicyState, rollout: Rollout, key: PRNGKey
    ) -> tuple[OffPolicyState, dict[str, jax.Array]]:
        """The second half: the steps go into the memory, and batches from there to the learner."""
        replay = self.replay.add(state.replay, rollout.transitions)
        learner, replay, metrics = self._updates(state.learner, replay, key)
        return OffPolicyState(learner, state.actor, replay), metrics

    def _updates(
        self, learner: State, replay: ReplayState, key: PRNGKey
    ) -> tuple[State, ReplayState, dict[str, jax.Array]]:
        """The updates of one iteration: the learner, the replay, and the mean of the metrics."""
        if self.updates == 1:
            return self._update(learner, replay, key)

        def update(loop: tuple[State, State], key: PRNGKey) -> tuple[tuple[State, State], dict[str, jax.Array]]:
            # Only the order is carried: what is stored does not change here.
            learner, now, metrics = self._update(loop[0], dataclasses.replace(replay, order=loop[1]), key)
            return (learner, now.order), metrics

        keys = jax.random.split(key, self.updates)
        (learner, order), metrics = jax.lax.scan(update, (learner, replay.order), keys)
        return learner, dataclasses.replace(replay, order=order), jax.tree.map(jnp.mean, metrics)

    def _update(
        self, learner: State, replay: ReplayState, key: PRNGKey
    ) -> tuple[State, ReplayState, dict[str, jax.Array]]:
        """Draw a batch, learn from it, and tell the replay what came of it."""
        sample_key, update_key = jax.random.split(key)
        if self._sequential:
            batch = self.replay.sample_sequences(replay, sample_key, self.batch_size, self.length)
        else:
            batch = self.replay.sample(replay, sample_key, self.batch_size)
        learner, metrics, feedback = self.learner.update(learner, batch, update_key)
        return learner, self.replay.feedback(replay, batch, feedback), metrics

    def learned(self, state: OffPolicyState) -> State:
        return state.learner

    def policy(self, state: OffPolicyState, explore: bool = False) -> Policy:
        return self.learner.policy(state.learner, explore)


class _Carrying(Policy):
    """The actions of one policy, the memory and the extras of another, so that warm-up data looks like the learner's own."""

    action: Policy
    memory: Policy

    def init(self, key: PRNGKey) -> State:
        return self.memory.init(key)

    def __call__(self, carry: State, observation: State, key: PRNGKey) -> tuple[State, State, dict[str, jax.Array]]:
        action_key, memory_key = jax.random.split(key)
        _, action, _ = self.action((), observation, action_key)
        carry, like, extras = self.memory(carry, observation, memory_key)
        return carry, jax.tree.map(lambda a, b: a.astype(b.dtype), action, like), extras

    def inspect(self, carry: State, observation: State) -> dict[str, jax.Array]:
        return self.memory.inspect(carry, observation)
