"""A step costs the same whatever the replay holds: the compiled chunk of a run writes a row of it and copies nothing."""

import re

import jax
import pytest

from rewardtogo.runner.engine import Program
from rewardtogo.runner.plan import plan

NETWORK = {"network": {"sizes": [8]}}
ROWS = 300_000


@pytest.mark.parametrize(
    ("algorithm", "env", "backend"),
    [
        ("td3", "Pendulum-v1", "jax"),
        ("td3", "Pendulum-v1", "gymnasium"),
        ("dqn", "CartPole-v1", "jax"),
        ("retrace_q", "CartPole-v1", "jax"),
    ],
)
def test_one_update_of_an_iteration_copies_nothing(algorithm: str, env: str, backend: str) -> None:
    """Where the only batch of an iteration was read next to the writing, XLA fused the two and needed the whole ring twice."""
    loop = {"warm_up": 64, "unroll": 1, "updates": 1, "replay": {"capacity": ROWS}}
    options = {"num_envs": 1, "steps": 1000, "preset": "none", "learner": NETWORK, "loop": loop}
    made = plan(algorithm, env, backend=backend, **options)  # type: ignore[arg-type]
    program = Program(made.algorithm, jax.random.key(0), 10)
    state = program.shapes()
    text = program._compile_advance(state, program.fresh_sums(state)).as_text()
    assert f"f32[{ROWS},1," in text
    # A chunk copies once what is too small to be donated; what matters is inside the loop.
    assert not [line for line in re.findall(rf"= \w+\[{ROWS},[^=]* copy\(.*", text) if "copy(%small" not in line]
