r"""Q-learning in general (figure 6.2): three processes beside each other, each at a rate of its own.

1. *Collect* steps into a replay, and evict old ones: `OffPolicy.unroll` steps of each environment, `replay.capacity` kept.
2. *Move the target* towards the network: every `target_period` updates.
3. *Regress* Q on the targets: `OffPolicy.updates` batches after every collection.

Every Q-learning algorithm of chapters 5 and 6 is a choice of these rates for one learner, `DQN`, and one loop, `OffPolicy`:

| | collect | keep | regress | move the target |
|---|---|---|---|---|
| `fitted_q_iteration`, Algorithm 9 | a data set | that data set | K times S updates | every S updates |
| `online_q_learning`, Algorithm 10 | 1 step | that step | 1 update on it | every update |
| `replay_q_learning`, Algorithm 11 | M steps | many | K updates | every update |
| `target_q_learning`, Algorithm 12 | M steps | many | K updates | every N K updates |
| `deep_q_learning`, Algorithm 13 | 1 step | many | 1 update | every N updates |

The lag of a target is counted in updates: Algorithm 12 moves it after N K of them, Algorithm 13 after N (erratum E6.9); with K = 1 and
M = 1 they are the same. A fitted regression takes S gradient steps on random batches of the data set.
"""

import dataclasses

import equinox as eqx

from ..core import VectorEnv
from ..data.replay import UniformReplay
from ..loops.off_policy import OffPolicy
from .dqn import DQN


class Rates(eqx.Module):
    """The rates of the three processes of an algorithm.

    - `collect`: environment steps between two visits to the replay; `keep`: how many the replay holds.
    - `updates`: batches learnt from in a visit; `batch`: their size.
    - `move`: updates between two moves of the target; `part`: how far it moves, 1 for a copy.
    """

    collect: int
    keep: int
    updates: int
    batch: int
    move: int
    part: float

    @staticmethod
    def of(algorithm: OffPolicy) -> "Rates":
        """Read from a loop. Raises `ValueError` where its learner is not one of the DQN family."""
        learner = algorithm.learner
        if not isinstance(learner, DQN):
            raise ValueError(
                f"{type(learner).__name__} has no target network that moves at a rate of its own: give an algorithm whose learner is DQN"
            )
        return Rates(
            algorithm.steps_per_iteration,
            algorithm.replay.size,
            algorithm.updates,
            algorithm.batch_size,
            learner.target_period,
            float(learner.target_rate),
        )

    @property
    def steps_per_update(self) -> float:
        """Environment steps for each batch: the speed of process 1 in units of process 3."""
        return self.collect / self.updates

    @property
    def steps_per_move(self) -> float:
        """Environment steps between two moves of the target."""
        return self.move * self.steps_per_update

    @property
    def mean_lag(self) -> float:
        """Updates that the target is behind on average, (N - 1) / 2 for copies and p / (1 - p) for averages of a kept part p (item 6.8)."""
        kept = 1.0 - self.part
        return self.move * kept / (1.0 - kept) + (self.move - 1) / 2


def fitted_q_iteration(
    env: VectorEnv, learner: DQN, *, data: int, iterations: int, gradient_steps: int, batch_size: int = 64
) -> OffPolicy:
    """Algorithm 9: collect `data` steps of each environment; `iterations` times set the targets, and regress `gradient_steps` times."""
    return OffPolicy(
        env,
        dataclasses.replace(learner, target_period=gradient_steps, target_rate=1.0),
        UniformReplay(data * env.num_envs),
        unroll=data,
        updates=iterations * gradient_steps,
        batch_size=batch_size,
        warm_up=1,
    )


def online_q_learning(env: VectorEnv, learner: DQN) -> OffPolicy:
    """Algorithm 10: learn from each step once, when it is taken. One environment; else it would be learned from in random order."""
    if env.num_envs != 1:
        raise ValueError(
            f"online Q-learning learns from each step as it comes, and {env.num_envs} environments give that many at once: use one, "
            "or replay_q_learning"
        )
    learner = dataclasses.replace(learner, target_period=1, target_rate=1.0)
    return OffPolicy(env, learner, UniformReplay(1), unroll=1, updates=1, batch_size=1, warm_up=1)


def replay_q_learning(
    env: VectorEnv,
    learner: DQN,
    *,
    capacity: int,
    collect: int = 1,
    updates: int = 1,
    batch_size: int = 64,
    warm_up: int = 1000,
) -> OffPolicy:
    """Algorithm 11: a replay, and the network itself as its target."""
    return target_q_learning(
        env,
        learner,
        capacity=capacity,
        visits=0,
        collect=collect,
        updates=updates,
        batch_size=batch_size,
        warm_up=warm_up,
    )


def target_q_learning(
    env: VectorEnv,
    learner: DQN,
    *,
    capacity: int,
    visits: int,
    collect: int = 1,
    updates: int = 1,
    batch_size: int = 64,
    warm_up: int = 1000,
) -> OffPolicy:
    """Algorithm 12: the target is copied after `visits` (N) times `updates` (K) updates."""
    learner = dataclasses.replace(learner, target_period=max(1, visits * updates), target_rate=1.0)
    return OffPolicy(
        env, learner, UniformReplay(capacity), unroll=collect, updates=updates, batch_size=batch_size, warm_up=warm_up
    )


def deep_q_learning(
    env: VectorEnv, learner: DQN, *, capacity: int, period: int, batch_size: int = 64, warm_up: int = 1000
) -> OffPolicy:
    """Algorithm 13: one step, one update, and a copy every `period` updates."""
    learner = dataclasses.replace(learner, target_period=period, target_rate=1.0)
    return OffPolicy(env, learner, UniformReplay(capacity), unroll=1, updates=1, batch_size=batch_size, warm_up=warm_up)
