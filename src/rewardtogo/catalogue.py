"""The one table of names: what `rtg train` and `rtg list` know. Strings only, so that reading it imports no JAX."""

import dataclasses
import difflib
from collections.abc import Iterable
from typing import Any


@dataclasses.dataclass(frozen=True)
class Row:
    """One algorithm: where its learner lives, which loop runs it, where the notes have it, and what it can act in.

    Several algorithms may be settings of one learner: `learner`, `loop_options` and `num_envs` are what a row sets, unless the user does.
    `eval_episodes`: of an evaluation, where the usual number would take longer than the training (policies that plan), or where
    acting is the least of the training, whatever it acts in (DAgger).
    """

    name: str
    path: str
    loop: str
    chapter: str
    number: str
    actions: tuple[str, ...]
    summary: str
    learner: dict[str, Any] = dataclasses.field(default_factory=dict)
    loop_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    num_envs: int | None = None
    eval_episodes: int | None = None


ANY = ("discrete", "multi_discrete", "multi_binary", "box")
_VANILLA = "rewardtogo.policy_gradient.vanilla:PolicyGradient"
_DQN = "rewardtogo.value.dqn:DQN"
_ONE_STEP = {"returns": "n_step", "n_steps": 1, "value_first": True}
_ONE_MODEL = {
    "members": 1,
    "probabilistic": False,
    "posterior": {"class": "bootstrap", "resample": False},
    "propagation": "mean",
}
_EVERY_STEP = {"unroll": 1, "batch_size": 256, "replay": {"capacity": 1_000_000}}

ALGORITHMS: dict[str, Row] = {
    row.name: row
    for row in (
        Row(
            "bc",
            "rewardtogo.imitation.bc:BC",
            "offline",
            "2",
            "2",
            ANY,
            "behavioural cloning: maximum likelihood of an expert's actions",
        ),
        Row(
            "dagger",
            "rewardtogo.imitation.bc:BC",
            "dagger",
            "2",
            "Alg 1",
            ANY,
            "dataset aggregation: an expert labels the states that the learner comes to",
            eval_episodes=20,
        ),
        Row(
            "dart",
            "rewardtogo.imitation.bc:BC",
            "dagger",
            "2",
            "2.2",
            ANY,
            "an expert who drives with as much noise as the learner has error, so that it shows the way back",
            {},
            {"beta": 1.0, "noise": 0.1, "adapt_noise": True},
            eval_episodes=20,
        ),
        Row(
            "reinforce",
            _VANILLA,
            "on_policy",
            "3",
            "Alg 2",
            ANY,
            "Monte-Carlo policy gradient with reward-to-go and a learned baseline",
        ),
        Row(
            "vpg",
            _VANILLA,
            "on_policy",
            "3",
            "3.7",
            ANY,
            "policy gradient with any returns, baseline and discounting; GAE unless told otherwise",
            {"returns": "gae"},
        ),
        Row(
            "offpolicy_pg",
            "rewardtogo.policy_gradient.off_policy:OffPolicyPG",
            "off_policy",
            "3",
            "3.9",
            ANY,
            "policy gradient from older policies' actions, by importance sampling",
            {},
            {"unroll": 64, "updates": 8, "batch_size": 32, "length": 32, "warm_up": 1, "replay": {"capacity": 4096}},
            8,
        ),
        Row(
            "batch_ac",
            _VANILLA,
            "on_policy",
            "4",
            "Alg 3, 4",
            ANY,
            "batch actor-critic: fit V, then one step on r + gamma V(s') - V(s)",
            _ONE_STEP,
        ),
        Row(
            "online_ac",
            _VANILLA,
            "on_policy",
            "4",
            "Alg 5",
            ANY,
            "online actor-critic: an update for every step, of one environment or of several side by side",
            _ONE_STEP
            | {
                "value_target": "td",
                "value_updates": 1,
                "learning_rate": 3e-4,
                "value_learning_rate": 1e-3,
                "normalise_advantages": False,
            },
            {"unroll": 1},
            8,
        ),
        Row(
            "a2c",
            _VANILLA,
            "on_policy",
            "4",
            "4.7",
            ANY,
            "synchronous advantage actor-critic: short rollouts of several environments",
            {
                "optimiser": "rmsprop",
                "learning_rate": 7e-4,
                "value_learning_rate": 7e-4,
                "value_updates": 1,
                "max_grad_norm": 0.5,
                "normalise_advantages": False,
            },
            {"unroll": 5},
            8,
        ),
        Row(
            "async_ac",
            _VANILLA,
            "asynchronous",
            "4",
            "4.7",
            ANY,
            "asynchronous actor-critic: workers with parameters of different ages, corrected by V-trace",
            {
                "returns": "vtrace",
                "gae_lambda": 1.0,
                "value_updates": 1,
                "learning_rate": 3e-4,
                "value_learning_rate": 1e-3,
            }
            | {"normalise_advantages": False, "max_grad_norm": 0.5},
        ),
        *(
            Row(
                name,
                "rewardtogo.model_based.mbrl:ModelBased",
                "off_policy",
                "8",
                number,
                ("discrete", "multi_discrete", "box"),
                summary,
                learner,
                {"unroll": 50, "updates": 200, "batch_size": 128, "warm_up": 200, "replay": {"capacity": 100_000}}
                | loop,
                1,
                2,
            )
            for name, number, summary, learner, loop in (
                (
                    "mbrl_v05",
                    "Alg 19",
                    "fit a model to random data once and for all, plan through it",
                    _ONE_MODEL | {"acting": "random", "every": 15},
                    {},
                ),
                (
                    "mbrl_v1",
                    "Alg 20",
                    "fit a model, carry out whole plans, fit it again to what happened",
                    _ONE_MODEL | {"every": 15},
                    {},
                ),
                (
                    "mbrl_v15",
                    "Alg 21",
                    "fit a model, replan at every step, fit it again every N steps",
                    _ONE_MODEL,
                    {},
                ),
                (
                    "pets",
                    "8.3.3",
                    "replanning through an ensemble of probabilistic models, by sampled trajectories",
                    {},
                    {},
                ),
            )
        ),
        Row(
            "latent_mbrl",
            "rewardtogo.model_based.latent:LatentMBRL",
            "off_policy",
            "8",
            "Alg 22",
            ("discrete", "multi_discrete", "box"),
            "learn a latent state of pictures, with its dynamics and rewards, and replan in it at every step",
            {},
            {
                "unroll": 50,
                "updates": 100,
                "batch_size": 64,
                "length": 6,
                "warm_up": 400,
                "replay": {"capacity": 50_000},
            },
            1,
            2,
        ),
        Row(
            "planet",
            "rewardtogo.model_based.planet:PlaNet",
            "off_policy",
            "8",
            "8.3.4",
            ("discrete", "multi_discrete", "box"),
            "PlaNet: a latent model with a memory, that filters single pictures, and replanning in it",
            {},
            {
                "unroll": 50,
                "updates": 50,
                "batch_size": 32,
                "length": 20,
                "warm_up": 400,
                "replay": {"capacity": 50_000},
            },
            1,
            2,
        ),
        Row(
            "e2c",
            "rewardtogo.model_based.e2c:E2C",
            "off_policy",
            "8",
            "8.3.4",
            ("box",),
            "embed to control: latent states with locally linear dynamics, and regulators towards the goal's",
            {},
            {
                "unroll": 50,
                "updates": 200,
                "batch_size": 128,
                "warm_up": 4000,
                "replay": {"capacity": 50_000},
            },
            1,
            2,
        ),
        Row(
            "solar",
            "rewardtogo.model_based.solar:SOLAR",
            "on_policy",
            "8",
            "8.3.4",
            ("box",),
            "SOLAR: latent states with linear dynamics and quadratic costs, and regulators improved near the data",
            {},
            {"unroll": 15},
            64,
        ),
        Row(
            "npg",
            "rewardtogo.policy_gradient.npg:NPG",
            "on_policy",
            "7",
            "7.24",
            ANY,
            "natural policy gradient: conjugate gradients with Fisher-vector products",
        ),
        Row(
            "trpo",
            "rewardtogo.policy_gradient.trpo:TRPO",
            "on_policy",
            "7",
            "7.26",
            ANY,
            "trust region policy optimisation: natural direction, line search on the KL divergence",
        ),
        Row(
            "ppo",
            "rewardtogo.policy_gradient.ppo:PPO",
            "on_policy",
            "7",
            "7.27",
            ANY,
            "proximal policy optimisation, clipped surrogate and GAE",
        ),
        Row(
            "fqi",
            "rewardtogo.value.dqn:DQN",
            "offline",
            "5",
            "Alg 9",
            ("discrete",),
            "fitted Q-iteration on a dataset: regressions, one after the other, on targets that stay meanwhile",
            {"target_period": 500, "huber": 1e6, "learning_rate": 1e-3},
        ),
        Row(
            "fvi",
            "rewardtogo.value.fvi:FVI",
            "off_policy",
            "5",
            "Alg 8",
            ("discrete",),
            "fitted value iteration: every action tried in a simulator, V fitted to the best; known dynamics",
            {},
            {"updates": 4, "unroll": 1},
            num_envs=4,
        ),
        Row(
            "q_learning",
            "rewardtogo.value.tabular_q:QLearning",
            "on_policy",
            "5",
            "Alg 10",
            ("discrete",),
            "Q-learning with a table, online, nothing stored; discrete observations",
            {},
            {"unroll": 1},
            1,
        ),
        Row(
            "double_q_learning",
            "rewardtogo.value.tabular_q:QLearning",
            "on_policy",
            "6",
            "6.3",
            ("discrete",),
            "Q-learning with two tables: one chooses the next action, the other values it",
            {"double": True},
            {"unroll": 1},
            1,
        ),
        Row(
            "dqn",
            _DQN,
            "off_policy",
            "6",
            "Alg 13",
            ("discrete",),
            "deep Q-learning with replay and target network, double or plain",
        ),
        Row(
            "q_replay",
            _DQN,
            "off_policy",
            "6",
            "Alg 11",
            ("discrete",),
            "Q-learning with a replay and no target network",
            {"target_period": 1},
        ),
        Row(
            "target_q",
            _DQN,
            "off_policy",
            "6",
            "Alg 12",
            ("discrete",),
            "Q-learning with replay and target network, several updates for each step",
            {"target_period": 256},
            {"unroll": 1, "updates": 4},
        ),
        Row(
            "double_dqn",
            _DQN,
            "off_policy",
            "6",
            "6.3.1",
            ("discrete",),
            "DQN whose online network chooses the action that the target network values",
            {"double": True},
        ),
        Row(
            "dueling_dqn",
            _DQN,
            "off_policy",
            "6",
            "6.28",
            ("discrete",),
            "double DQN with streams for the value of the state and the advantages of actions",
            {"dueling": True, "double": True, "network": {"class": "mlp", "sizes": [64], "activation": "relu"}}
            | {"head_sizes": [64]},
        ),
        Row(
            "noisy_dqn",
            _DQN,
            "off_policy",
            "6",
            "6.28",
            ("discrete",),
            "double DQN that explores by learned noise in its weights",
            {"noisy": True, "epsilon": 0.0, "double": True, "head_sizes": [64]}
            | {"network": {"class": "mlp", "sizes": [64], "activation": "relu"}},
        ),
        Row(
            "c51",
            _DQN,
            "off_policy",
            "6",
            "6.28",
            ("discrete",),
            "distributional Q-learning: probabilities of fixed returns",
            {"outputs": {"class": "c51"}},
        ),
        Row(
            "qr_dqn",
            _DQN,
            "off_policy",
            "6",
            "6.28",
            ("discrete",),
            "distributional Q-learning: quantiles of the return",
            {"outputs": {"class": "quantiles"}},
        ),
        Row(
            "r2d2",
            _DQN,
            "off_policy",
            "6",
            "6.28",
            ("discrete",),
            "double DQN with a memory: stored states, burn-in, rescaled values",
            {"network": {"class": "lstm"}, "burn_in": 4, "n_step": 3, "double": True, "dueling": True}
            | {"outputs": {"class": "expectation", "rescale": True}},
        ),
        Row(
            "retrace_q",
            _DQN,
            "off_policy",
            "6",
            "6.19",
            ("discrete",),
            "Q-learning from whole sequences of older policies' actions, by Retrace(lambda)",
            {"traces": "retrace"},
        ),
        Row(
            "per_dqn",
            _DQN,
            "off_policy",
            "6",
            "6.28",
            ("discrete",),
            "deep Q-learning that replays steps with large errors more often",
            {},
            {"replay": {"class": "prioritised"}},
        ),
        Row(
            "cem_q",
            "rewardtogo.value.cem_q:CEMQ",
            "off_policy",
            "6",
            "6.3.3",
            ("box",),
            "Q-learning with continuous actions: the best one is searched for, by samples, ascent or cross-entropy",
            {},
            _EVERY_STEP,
        ),
        Row(
            "naf",
            "rewardtogo.value.naf:NAF",
            "off_policy",
            "6",
            "6.3.3",
            ("box",),
            "normalised advantage functions: a Q that is quadratic in the action, so that its maximum is known",
            {},
            _EVERY_STEP,
        ),
        Row(
            "ddpg",
            "rewardtogo.value.ddpg:DDPG",
            "off_policy",
            "6",
            "Alg 14",
            ("box",),
            "deep deterministic policy gradient: deep Q-learning with a learned argmax",
            {},
            _EVERY_STEP,
        ),
        Row(
            "td3",
            "rewardtogo.value.td3:TD3",
            "off_policy",
            "6",
            "6.28",
            ("box",),
            "DDPG with two critics, smoothed targets and a delayed actor",
            {},
            _EVERY_STEP,
        ),
        Row(
            "sac",
            "rewardtogo.value.sac:SAC",
            "off_policy",
            "6",
            "6.28",
            ("box",),
            "soft actor-critic: two critics, a squashed Gaussian and a learned temperature",
            {},
            _EVERY_STEP,
        ),
        Row(
            "mcts_distill",
            "rewardtogo.imitation.bc:BC",
            "distill",
            "8",
            "8.25",
            ("discrete",),
            "a network learns what Monte Carlo tree search would do in the states that it comes to",
            {"network": {"class": "mlp", "sizes": [128, 128], "activation": "relu"}},
        ),
        Row(
            "alphazero",
            "rewardtogo.planning.self_play:AlphaZero",
            "self_play",
            "8",
            "8.25",
            ("discrete",),
            "games against itself: a network guides a search, and learns from what the search made of it",
        ),
    )
}

LOOPS = {
    "on_policy": "rewardtogo.loops.on_policy:OnPolicy",
    "off_policy": "rewardtogo.loops.off_policy:OffPolicy",
    "offline": "rewardtogo.loops.offline:Offline",
    "dagger": "rewardtogo.imitation.dagger:DAgger",
    "asynchronous": "rewardtogo.actor_critic.asynchronous:Asynchronous",
    "distill": "rewardtogo.planning.distill:Distill",
    "self_play": "rewardtogo.planning.self_play:SelfPlay",
}

ENVIRONMENTS: dict[str, str] = {
    "CartPole-v1": "twin of Gymnasium's: balance a pole on a cart",
    "CartPoleNoVel-v1": "CartPole without velocities in the observation: needs a memory",
    "Acrobot-v1": "twin of Gymnasium's: swing up a double pendulum",
    "MountainCar-v0": "twin of Gymnasium's: drive an under-powered car up a hill",
    "MountainCarContinuous-v0": "twin of Gymnasium's, continuous actions",
    "Pendulum-v1": "twin of Gymnasium's: swing up a pendulum",
    "PendulumNoVel-v1": "Pendulum without the angular velocity: needs a memory",
    "FrozenLake-v1": "twin of Gymnasium's: cross the ice to the goal; takes its arguments (--env.is_slippery false)",
    "FrozenLake8x8-v1": "the same on the larger lake",
    "CliffWalking-v1": "twin of Gymnasium's: along the cliff and not over it; cut after 1,000 steps",
    "CliffWalkingSlippery-v1": "the same on slippery ground",
    "Taxi-v4": "twin of Gymnasium's: fetch a passenger and bring them to their hotel; tells which actions do anything",
    "OneStep": "probe: one step, reward 1; V = 1",
    "TruncatedLoop": "probe: reward 1 for ever, cut after 10 steps; V = 1/(1 - gamma)",
    "RecallProbe": "probe: repeat a cue shown at the start; needs a memory",
    "Catch": "pictures of 10 x 5 pixels: catch a falling ball; the optimum is 1",
    "Steering": "keep a car in its lane by pictures of 16 x 16 pixels: left, straight, right; the optimum is 1000",
    "Lane": "the same on a winding road, by three numbers and a steering angle; the optimum is 200",
    "BrakeLight": "brake for obstacles, with a light that shows the last action: causal confusion; the optimum is 100",
    "LastTwo": "answer the XOR of the last two observations: needs a memory; the optimum is 20",
    "Drone": "pass a tree left or right: a Gaussian goes in between; the optimum is 1",
    "Tightrope": "two states: the worst problem for a copy of an expert; the optimum is 50",
    "PixelPendulum": "Pendulum as pictures of 16 x 16 pixels, the last two",
    "PixelPendulumOneFrame": "the same with the last picture alone: needs a memory",
    "PixelDoubleIntegrator": "a mass pushed in the plane, on the last two pictures of 16 x 16 pixels; to the middle, 15 steps",
    "PlanarNavigation": "an agent among round obstacles on pictures of 16 x 16 pixels; to a corner, 40 steps",
    "CartPoleSwingUp": "a pole that hangs from a cart is to stand on it, by continuous forces; the reward of PETS, 100 steps",
    "Obstacles": "a point on its way to a goal, the straight way walled up; minus the distance, 100 steps",
    "Reacher": "an arm of two links, by torques, and a target; minus the distance, 50 steps",
    "TicTacToe": "tic-tac-toe against random moves, either side begins; tells which moves are allowed",
    "TicTacToePerfect": "the same against a player without a mistake: the optimum is 0",
    "ConnectFour": "Connect Four against random moves",
    "ConnectFour5x5": "the same on 5 rows and 5 columns",
}
"""Environments that are compiled with the learner. Every Gymnasium id works besides, through one door."""


def nearest(name: str, known: Iterable[str], where: str = "rtg list") -> str:
    """A hint for a misspelt name: the nearest known ones, or where none is near all of them, or of many the command that lists them."""
    known = list(known)
    lower = {k.lower(): k for k in known}
    close = [lower[k] for k in difflib.get_close_matches(name.lower(), list(lower), n=3, cutoff=0.5)]
    if close:
        return f"did you mean {' or '.join(close)}?"
    return f"known are {', '.join(sorted(known))}" if len(known) <= 12 else f"see `{where}`"


def algorithm_row(name: str) -> Row:
    """The row of an algorithm. Raises `ValueError` with the nearest names where there is none."""
    if name not in ALGORITHMS:
        raise ValueError(
            f"there is no algorithm {name!r}: {nearest(name, ALGORITHMS)} Your own is written module:Class."
        )
    return ALGORITHMS[name]
