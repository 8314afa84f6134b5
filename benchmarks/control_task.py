"""What is controlled in the `control` group, by this library and by its peers: the same dynamics, costs, horizons and numbers.

Dynamics are written for any module of functions `m` (`jax.numpy`, `numpy`, `sympy`) on lists of scalars. The cost of a step is
dt / 2 (sum q_i (x_i - x*_i)^2 + sum r_j u_j^2), that of the end 1/2 sum p_i (x_i - x*_i)^2. No library but the standard one is needed here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Vector = list[Any]


@dataclass(frozen=True)
class Task:
    """x' = f(m, x, u), from `start` to `target` in `horizon` steps of `dt`."""

    f: Callable[[Any, Vector, Vector], Vector]
    start: tuple[float, ...]
    target: tuple[float, ...]
    q: tuple[float, ...]
    r: tuple[float, ...]
    p: tuple[float, ...]
    dt: float
    horizon: int


def pendulum(m: Any, x: Vector, u: Vector) -> Vector:
    """Angle from upright and speed; a rod of one metre and one kilogram."""
    speed = x[1] + 0.05 * (15.0 * m.sin(x[0]) + 3.0 * u[0])
    return [x[0] + 0.05 * speed, speed]


def cartpole(m: Any, x: Vector, u: Vector) -> Vector:
    """Position, angle from upright, and their speeds; Barto, Sutton and Anderson's cart (1 kg) and pole (0.1 kg, 0.5 m to its centre)."""
    dt, g, mc, mp, half = 0.02, 9.8, 1.0, 0.1, 0.5
    sin, cos = m.sin(x[1]), m.cos(x[1])
    push = (u[0] + mp * half * x[3] * x[3] * sin) / (mc + mp)
    turn = (g * sin - cos * push) / (half * (4.0 / 3.0 - mp * cos * cos / (mc + mp)))
    run = push - mp * half * turn * cos / (mc + mp)
    return [x[0] + dt * x[2], x[1] + dt * x[3], x[2] + dt * run, x[3] + dt * turn]


def quadrotor(m: Any, x: Vector, u: Vector) -> Vector:
    """Position, Euler angles (roll, pitch, yaw), velocity, body rates; u is thrust beyond hovering, and three torques."""
    dt, g, mass, ix, iy, iz = 0.02, 9.81, 0.5, 0.0023, 0.0028, 0.0046
    roll, pitch, yaw = x[3], x[4], x[5]
    p, q, r = x[9], x[10], x[11]
    sr, cr, sp, cp, sy, cy = m.sin(roll), m.cos(roll), m.sin(pitch), m.cos(pitch), m.sin(yaw), m.cos(yaw)
    lift = (mass * g + u[0]) / mass
    change = [
        x[6],
        x[7],
        x[8],
        p + (q * sr + r * cr) * sp / cp,
        q * cr - r * sr,
        (q * sr + r * cr) / cp,
        lift * (cr * sp * cy + sr * sy),
        lift * (cr * sp * sy - sr * cy),
        lift * cr * cp - g,
        ((iy - iz) * q * r + 0.01 * u[1]) / ix,
        ((iz - ix) * p * r + 0.01 * u[2]) / iy,
        ((ix - iy) * p * q + 0.01 * u[3]) / iz,
    ]
    return [a + dt * b for a, b in zip(x, change, strict=True)]


def unicycle(m: Any, x: Vector, u: Vector) -> Vector:
    """Position and heading; forward and turning speed. That of crocoddyl's own ActionModelUnicycle."""
    return [x[0] + 0.1 * m.cos(x[2]) * u[0], x[1] + 0.1 * m.sin(x[2]) * u[0], x[2] + 0.1 * u[1]]


TASKS = {
    "pendulum": Task(pendulum, (2.5, 0.0), (0.0, 0.0), (1.0, 0.1), (0.01,), (50.0, 5.0), 0.05, 60),
    "cartpole": Task(
        cartpole,
        (0.0, 0.3, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0),
        (1.0, 5.0, 0.1, 0.1),
        (1.0,),
        (50.0, 50.0, 5.0, 5.0),
        0.02,
        50,
    ),
    "quadrotor": Task(
        quadrotor,
        (1.0, -1.0, 0.5, 0.3, -0.2, 0.5, *6 * (0.0,)),
        12 * (0.0,),
        (*3 * (5.0,), *3 * (1.0,), *3 * (0.5,), *3 * (0.1,)),
        (0.1, 0.1, 0.1, 0.1),
        (*3 * (50.0,), *3 * (10.0,), *3 * (5.0,), *3 * (1.0,)),
        0.02,
        100,
    ),
    # Weights 10 and 1 a step, as in crocoddyl, which multiplies by no dt; its last model pays for the state once more.
    "unicycle": Task(unicycle, (-1.0, -1.0, 1.0), (0.0, 0.0, 0.0), 3 * (1000.0,), 2 * (10.0,), 3 * (100.0,), 0.1, 40),
}
BATCH = 64
"""Problems side by side."""
LQR_STATES, LQR_ACTIONS, LQR_HORIZON, LQR_BATCH = 12, 4, 100, 1000
MEMBERS, WIDTH, CANDIDATES, ELITES, PLAN, ROUNDS = 5, 200, 500, 50, 25, 5
"""The planning by CEM through an ensemble: members, units of their two layers, samples, elites, horizon, iterations."""
OBSERVATION, ACTION = 3, 1
"""Of Pendulum, whose model is planned in."""
