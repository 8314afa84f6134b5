"""Systems that several tests plan for."""

import jax
import jax.numpy as jnp

from rewardtogo.planning import FunctionProblem, box

DT = 0.05


def pendulum(x: jax.Array, u: jax.Array) -> jax.Array:
    """An angle from upright and its speed, under a torque."""
    spin = x[1] + DT * (15 * jnp.sin(x[0]) + 3 * u[0])
    return jnp.stack([x[0] + DT * spin, spin])


def swing_cost(x: jax.Array, u: jax.Array) -> jax.Array:
    return DT * ((1 - jnp.cos(x[0])) + 0.1 * x[1] ** 2 + 0.01 * u[0] ** 2)


def swing_end(x: jax.Array) -> jax.Array:
    return 20 * (1 - jnp.cos(x[0])) + x[1] ** 2


def swing_up(horizon: int = 100, most: float = jnp.inf) -> FunctionProblem:
    """Swing up and rest there."""
    return FunctionProblem(pendulum, swing_cost, horizon, box(1, -most, most), swing_end)


def cart_pole(x: jax.Array, u: jax.Array) -> jax.Array:
    """Position, speed, angle from upright, spin, under a force of 10 u; Gymnasium's constants, 0.02 s."""
    push = (10 * u[0] + 0.05 * x[3] ** 2 * jnp.sin(x[2])) / 1.1
    turn = (9.8 * jnp.sin(x[2]) - jnp.cos(x[2]) * push) / (0.5 * (4 / 3 - 0.1 * jnp.cos(x[2]) ** 2 / 1.1))
    run = push - 0.05 * turn * jnp.cos(x[2]) / 1.1
    return x + 0.02 * jnp.stack([x[1], run, x[3], turn])


def balance_cost(x: jax.Array, u: jax.Array) -> jax.Array:
    return x[0] ** 2 + 0.1 * x[1] ** 2 + 10 * x[2] ** 2 + 0.1 * x[3] ** 2 + 0.1 * u[0] ** 2


def quadratic(size: int, most: float = 5.0) -> tuple[FunctionProblem, jax.Array]:
    """One action, and the distance of its entries from where they ought to be."""
    target = jnp.linspace(-1.0, 1.0, size)
    return FunctionProblem(lambda x, u: x, lambda x, u: ((u - target) ** 2).sum(), 1, box(size, -most, most)), target
