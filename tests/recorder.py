"""A learner that learns nothing and keeps what it was given, to look at what loops do."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rewardtogo.core import EnvSpec, Learner, Number, Policy, number, setting


class Counting(Policy):
    """Always action 1; says how many updates were done, and whether it explores. Its memory counts steps."""

    updates: jax.Array
    explore: bool = eqx.field(static=True)
    memory: bool = eqx.field(static=True)

    def init(self, key: jax.Array) -> Any:
        del key
        return jnp.zeros((), jnp.int32) if self.memory else ()

    def __call__(self, carry: Any, observation: Any, key: jax.Array) -> Any:
        del observation, key
        extras = {"updates": self.updates, "explore": jnp.asarray(self.explore, jnp.int32)}
        return carry + 1 if self.memory else (), jnp.asarray(1, jnp.int32), extras

    def inspect(self, carry: Any, observation: Any) -> dict[str, jax.Array]:
        return {}


class Recorder(Learner):
    """`kind` is the batch it asks for. Its state counts updates and adds up the rows that it was given."""

    kind: str = setting("rollout", "what it wants to be given")
    rate: Number = number(0.5, "nothing", at_least=0)

    @property
    def batch(self) -> Any:
        return self.kind

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete",)

    def init(self, spec: EnvSpec, key: jax.Array) -> Any:
        del spec, key
        return {"updates": jnp.zeros((), jnp.int32)}

    def policy(self, state: Any, explore: bool) -> Policy:
        return Counting(state["updates"], explore, self.kind == "sequences")

    def update(self, state: Any, batch: Any, key: jax.Array) -> Any:
        """The batch comes out as metrics, which a loop hands on when it makes one update."""
        del key
        updates = state["updates"] + 1
        return {"updates": updates}, {"updates": updates, "batch": batch}, ()
