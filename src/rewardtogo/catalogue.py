"""The one table of names: what `rtg train` and `rtg list` know. Strings only, so that reading it imports no JAX."""

import dataclasses
import difflib
from collections.abc import Iterable


@dataclasses.dataclass(frozen=True)
class Row:
    """One algorithm: where its learner lives, which loop runs it, where the notes have it, and what it can act in."""

    name: str
    path: str
    loop: str
    chapter: str
    number: str
    actions: tuple[str, ...]
    summary: str


ANY = ("discrete", "multi_discrete", "multi_binary", "box")

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
            "reinforce",
            "rewardtogo.policy_gradient.reinforce:REINFORCE",
            "on_policy",
            "3",
            "Alg 2",
            ANY,
            "Monte-Carlo policy gradient with reward-to-go and a learned baseline",
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
            "dqn",
            "rewardtogo.value.dqn:DQN",
            "off_policy",
            "6",
            "Alg 13",
            ("discrete",),
            "deep Q-learning with replay and target network, double or plain",
        ),
    )
}

LOOPS = {
    "on_policy": "rewardtogo.loops.on_policy:OnPolicy",
    "off_policy": "rewardtogo.loops.off_policy:OffPolicy",
    "offline": "rewardtogo.loops.offline:Offline",
}

ENVIRONMENTS: dict[str, str] = {
    "CartPole-v1": "twin of Gymnasium's: balance a pole on a cart",
    "CartPoleNoVel-v1": "CartPole without velocities in the observation: needs a memory",
    "Acrobot-v1": "twin of Gymnasium's: swing up a double pendulum",
    "MountainCar-v0": "twin of Gymnasium's: drive an under-powered car up a hill",
    "MountainCarContinuous-v0": "twin of Gymnasium's, continuous actions",
    "Pendulum-v1": "twin of Gymnasium's: swing up a pendulum",
    "PendulumNoVel-v1": "Pendulum without the angular velocity: needs a memory",
    "OneStep": "probe: one step, reward 1; V = 1",
    "TruncatedLoop": "probe: reward 1 for ever, cut after 10 steps; V = 1/(1 - gamma)",
    "RecallProbe": "probe: repeat a cue shown at the start; needs a memory",
}
"""Environments that are compiled with the learner. Every Gymnasium id works besides, through one door."""


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint for a misspelt name: the nearest known ones, or all of them where none is near."""
    known = list(known)
    lower = {k.lower(): k for k in known}
    close = [lower[k] for k in difflib.get_close_matches(name.lower(), list(lower), n=3, cutoff=0.5)]
    if close:
        return f"did you mean {' or '.join(close)}?"
    return f"known are {', '.join(sorted(known))}" if len(known) <= 12 else "see `rtg list`"


def algorithm_row(name: str) -> Row:
    """The row of an algorithm. Raises `ValueError` with the nearest names where there is none."""
    if name not in ALGORITHMS:
        raise ValueError(
            f"there is no algorithm {name!r}: {nearest(name, ALGORITHMS)} Your own is written module:Class."
        )
    return ALGORITHMS[name]
