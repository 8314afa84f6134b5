"""The table of algorithms that generic tests run over. A new algorithm adds a row."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import rewardtogo as rtg
from rewardtogo.core import MASK, Algorithm, Environment, Timestep, Transition, env_spec
from rewardtogo.data import Dataset
from rewardtogo.envs.board_games import TicTacToe
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.opponents import RandomOpponent, Versus
from rewardtogo.envs.pendulum import Pendulum
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.loops import RandomPolicy, begin
from rewardtogo.model_based import Dropout, MeanField
from rewardtogo.planning import ILQR, AlphaZero, CrossEntropy, Distill, RandomShooting, SelfPlay
from rewardtogo.value.exploration import Boltzmann
from rewardtogo.value.tabular_q import QLearning

NUM_ENVS = 4
QUICK = {"xla_backend_optimization_level": 0}
"""Options for programs that run a few times only: most of a test's time is compilation."""


def jit(function: Callable, **options: Any) -> Any:
    """`jax.jit`, compiled without optimisation."""
    return jax.jit(function, compiler_options=QUICK, **options)


def small_env() -> Environment:
    """CartPole cut after 16 steps: random episodes end both ways."""
    return TimeLimit(CartPole(), 16)


def on_policy(learner: Any, **options: Any) -> Algorithm:
    return rtg.OnPolicy(rtg.vectorize(small_env(), NUM_ENVS), learner, **{"unroll": 8, **options})


def off_policy(learner: Any, replay: Any = rtg.UniformReplay(256), **options: Any) -> Algorithm:
    options = {"unroll": 2, "updates": 2, "batch_size": 8, "warm_up": 32, "length": 4} | options
    return rtg.OffPolicy(rtg.vectorize(small_env(), NUM_ENVS), learner, replay, **options)


def continuous(learner: Any, **options: Any) -> Algorithm:
    """Off-policy with continuous actions: Pendulum, cut after 16 steps."""
    options = {"unroll": 2, "updates": 2, "batch_size": 8, "warm_up": 32, "length": 4} | options
    return rtg.OffPolicy(rtg.vectorize(TimeLimit(Pendulum(), 16), NUM_ENVS), learner, rtg.UniformReplay(256), **options)


@functools.cache
def demonstrations() -> Dataset:
    """48 steps of random play."""
    env = rtg.vectorize(small_env(), 1)
    policy = RandomPolicy(env_spec(env))
    collect = jit(lambda key: rtg.collect(env, policy, begin(env, policy, key), key, 48)[1].transitions)
    fields = {k: v for k, v in vars(jax.device_get(collect(jax.random.key(3)))).items() if k != "extras"}
    fields = jax.tree.map(lambda x: np.array(x[:, 0]), fields)
    fields["truncated"][-1] = not fields["terminated"][-1]
    fields = jax.tree.map(jnp.asarray, fields)
    return Dataset.of(Transition(**fields, extras={}), env_spec(env))


def offline(learner: Any, **options: Any) -> Algorithm:
    return rtg.Offline(demonstrations(), learner, **{"batch_size": 8, "updates": 2, "length": 4, **options})


def first_gradient(optimiser: Any, parameters: Any) -> Any:
    """The gradient that reached Adam at its first step, ten times its first moment, in the shape of the parameters."""
    flat, unravel = ravel_pytree(parameters)
    moment = 10.0 * ravel_pytree(optimiser[1][0].mu)[0]
    assert moment.shape == flat.shape
    return unravel(moment)


small, gru, lstm = rtg.MLP(8), rtg.GRU(6, rtg.MLP(5)), rtg.LSTM(6, rtg.MLP(5))

ALGORITHMS_UNDER_TEST: dict[str, Callable[[], Algorithm]] = {
    "ppo": lambda: on_policy(rtg.PPO(network=small, epochs=2, minibatches=2, normalise_observations=True)),
    "ppo-gru": lambda: on_policy(rtg.PPO(network=gru, epochs=2, minibatches=2)),
    "ppo-lstm": lambda: on_policy(rtg.PPO(network=lstm, epochs=1, minibatches=2)),
    "reinforce": lambda: on_policy(rtg.PolicyGradient(network=small, value_updates=2, normalise_observations=True)),
    "vpg-optimal": lambda: on_policy(rtg.PolicyGradient(network=small, baseline="optimal", discount_states=True)),
    "a2c-shared-gru": lambda: on_policy(rtg.PolicyGradient(network=gru, returns="n_step", shared=True)),
    "npg": lambda: on_policy(rtg.NPG(network=small, value_epochs=1, minibatches=2, normalise_observations=True)),
    "trpo-lstm": lambda: on_policy(rtg.TRPO(network=lstm, value_epochs=1, minibatches=2, cg_iterations=3)),
    "offpolicy-pg": lambda: off_policy(rtg.OffPolicyPG(network=small, value_updates=1, normalise_observations=True)),
    "async-vtrace": lambda: rtg.Asynchronous(
        rtg.vectorize(small_env(), 2),
        rtg.PolicyGradient(network=small, returns="vtrace", value_updates=1),
        3,
        8,
        "random",
    ),
    "dqn": lambda: off_policy(rtg.DQN(network=small, target_period=2, normalise_observations=True)),
    "per-dqn": lambda: off_policy(rtg.DQN(network=small, target_period=2), rtg.PrioritisedReplay(256)),
    "per-dqn-lstm": lambda: off_policy(rtg.DQN(network=lstm, target_period=2), rtg.PrioritisedReplay(256)),
    "dqn-n-step": lambda: off_policy(rtg.DQN(network=small, n_step=3, target_period=2)),
    "c51-dueling-noisy": lambda: off_policy(
        rtg.DQN(
            network=small, outputs=rtg.C51(5), head_sizes=(6,), dueling=True, noisy=True, epsilon=0.1, target_period=2
        )
    ),
    "qr-dqn": lambda: off_policy(rtg.DQN(network=small, outputs=rtg.Quantiles(5), target_period=2)),
    "retrace-q": lambda: off_policy(rtg.DQN(network=small, traces="retrace", target_period=2)),
    "r2d2": lambda: off_policy(
        rtg.DQN(network=lstm, burn_in=1, n_step=2, double=True, outputs=rtg.Expectation(rescale=True), target_period=2)
    ),
    "dqn-lstm": lambda: off_policy(rtg.DQN(network=lstm, double=True, target_period=1, target_rate=0.1)),
    "cem-q": lambda: continuous(rtg.CEMQ(network=small, maximiser=rtg.CEM(2, 8, 2), normalise_observations=True)),
    "naf": lambda: continuous(rtg.NAF(network=small, n_step=3)),
    "ddpg": lambda: continuous(rtg.DDPG(network=small, noise=rtg.OU(), normalise_observations=True)),
    "td3-lstm": lambda: continuous(rtg.TD3(network=lstm, noise=rtg.OU())),
    "sac": lambda: continuous(rtg.SAC(network=small, normalise_observations=True)),
    "pets": lambda: continuous(
        rtg.ModelBased(sizes=(8,), members=2, planner=CrossEntropy(samples=6, elites=2, iterations=2), horizon=3)
    ),
    "mbrl-ts1": lambda: off_policy(
        rtg.ModelBased(sizes=(8,), members=2, planner=RandomShooting(samples=6), horizon=3, every=2, propagation="ts1")
    ),
    "mbrl-mean-field": lambda: continuous(
        rtg.ModelBased(
            sizes=(8,),
            members=2,
            posterior=MeanField(),
            planner=RandomShooting(samples=6),
            horizon=3,
            objective="quantile",
        )
    ),
    "mbrl-dropout": lambda: continuous(
        rtg.ModelBased(
            sizes=(8,),
            members=2,
            posterior=Dropout(),
            planner=RandomShooting(samples=6),
            horizon=3,
            objective="lcb",
            patience=2,
        )
    ),
    "latent-mbrl": lambda: continuous(
        rtg.LatentMBRL(
            latent_size=3,
            encoder_sizes=(8,),
            sizes=(8,),
            planner=CrossEntropy(samples=6, elites=2, iterations=2),
            horizon=3,
        )
    ),
    "planet": lambda: continuous(
        rtg.PlaNet(
            memory_size=4,
            state_size=2,
            encoder_sizes=(8, 6),
            sizes=(8,),
            planner=CrossEntropy(samples=6, elites=2, iterations=2),
            horizon=3,
        )
    ),
    "e2c": lambda: continuous(
        rtg.E2C(encoder_sizes=(8,), sizes=(8,), planner=ILQR(iterations=2), horizon=3),
    ),
    "solar": lambda: rtg.OnPolicy(
        rtg.vectorize(TimeLimit(Pendulum(), 8), NUM_ENVS),
        rtg.SOLAR(
            network=small,
            latent_size=2,
            decoder_sizes=(8,),
            horizon=8,
            warm_up=1,
            pretrain=2,
            finetune=1,
            batch_size=4,
            episodes=8,
        ),
        unroll=8,
    ),
    "fvi": lambda: off_policy(
        rtg.FVI(dynamics=CartPole(), network=small, target_period=2, normalise_observations=True)
    ),
    "q-learning": lambda: rtg.OnPolicy(rtg.make("CliffWalking-v1", NUM_ENVS), QLearning(gamma=0.9), unroll=4),
    "double-q-learning": lambda: rtg.OnPolicy(
        rtg.make("Taxi-v4", NUM_ENVS), QLearning(double=True, exploration=Boltzmann(0.5), initial=1.0), unroll=4
    ),
    "mcts-distill": lambda: Distill(
        rtg.vectorize(Versus(TicTacToe(), RandomOpponent()), NUM_ENVS),
        rtg.BC(network=small, normalise_observations=True),
        TicTacToe(),
        rtg.UniformReplay(64),
        simulations=4,
        horizon=9,
        unroll=2,
        updates=2,
        batch_size=8,
    ),
    "alphazero": lambda: SelfPlay(
        rtg.vectorize(Versus(TicTacToe(), RandomOpponent()), NUM_ENVS),
        AlphaZero(network=small),
        TicTacToe(),
        rtg.UniformReplay(64),
        simulations=4,
        max_plies=6,
        updates=2,
        batch_size=8,
    ),
    "bc": lambda: offline(rtg.BC(network=small, normalise_observations=True)),
    "bc-gru": lambda: offline(rtg.BC(network=gru)),
}


class MaskedProbe(Environment):
    """Three actions of which one or two are allowed, others from step to step; a forbidden one costs 100. Cut after 5 steps."""

    @property
    def observation_space(self) -> spaces.Dict:
        return spaces.Dict({"x": spaces.Box(-1, 1, (1,), np.float32), MASK: spaces.MultiBinary(3)})

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(3)

    def reset(self, key: jax.Array) -> tuple[Any, Any]:
        del key
        return (jnp.zeros((), jnp.int32), self._mask(jnp.zeros((), jnp.int32))), self._observe(jnp.zeros((), jnp.int32))

    def step(self, state: Any, action: Any, key: jax.Array) -> tuple[Any, Timestep]:
        del key
        taken, mask = state
        reward = jnp.where(mask[action] > 0, 1.0, -100.0)
        taken = taken + 1
        observation = self._observe(taken)
        truncated = taken >= 5
        return (taken, self._mask(taken)), Timestep(
            observation, reward, jnp.zeros((), bool), truncated, observation, {}
        )

    def _mask(self, taken: jax.Array) -> jax.Array:
        masks = jnp.asarray([[1, 0, 0], [0, 1, 1], [0, 0, 1]], jnp.int8)
        return masks[taken % 3]

    def _observe(self, taken: jax.Array) -> dict[str, jax.Array]:
        return {"x": jnp.ones(1), MASK: self._mask(taken)}
