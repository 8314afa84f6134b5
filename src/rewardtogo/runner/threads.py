"""How many threads of the CPU a compiled program computes with.

XLA hands the steps of a program to a pool of threads. Those of small networks take microseconds, less than handing them over: with one
thread an update of SAC is two to four times as fast on two cores, one of DQN by a tenth, and all the more where other programs run
beside it. Products of large matrices gain from more.
"""

import os

VARIABLE = "NPROC"
"""The environment variable that XLA reads when JAX computes for the first time in a process."""
MANY_SEEDS = 16
"""Seeds in one program from which its products are worth several threads."""
LARGE = ("planning", "model_based")
"""Rooms whose algorithms evaluate many plans at once."""
PICTURES = ("ALE/",)


def use_threads(number: int) -> None:
    """Let compiled programs of this process compute with `number` threads of the CPU; without effect once JAX has computed anything.

    `rtg train` does it by itself. In Python it comes first: `rtg.use_threads(1)` where networks are small, nothing where they are large.
    Sums of floats depend on the number of threads. Raises `ValueError` where `number` is no whole number of at least 1.
    """
    if isinstance(number, bool) or not isinstance(number, int) or number < 1:
        raise ValueError(f"the number of threads must be a whole number of at least 1, not {number!r}")
    os.environ[VARIABLE] = str(number)


def used_threads() -> int | None:
    """What `use_threads` or the user's environment has set; None where XLA takes as many as there are cores."""
    text = os.environ.get(VARIABLE, "")
    return int(text) if text.isdecimal() and int(text) else None


def threads_for(path: str, env: str | None, num_seeds: int) -> int | None:
    """The number of threads that is fastest for a learner at `path` (`module:Class`), as far as one can tell before; None for all."""
    large = any(f".{room}." in path for room in LARGE)
    return None if large or num_seeds >= MANY_SEEDS or (env or "").startswith(PICTURES) else 1
