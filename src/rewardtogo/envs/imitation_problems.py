"""Small tasks in which imitation fails for one reason each (chapter 2), with the expert of each.

    Drone        fly past a tree: left or right, never in between                     several modes (notes 2.3.2, figure 2.3)
    Lane         keep a car in its lane: whoever never erred does not know the way back      drift (2.1, 2.2, figure 2.1)
    LastTwo      answer the XOR of the last two observations                          no Markov policy will do (2.3.1)
    Braking      brake for an obstacle, with a light that shows what was done last    causal confusion (2.3.1)

    tightrope    (in `tabular_problems`) one mistake, and nothing but mistakes ever after         the error bounds (2.4)

Their experts are functions here as well, for `--expert rewardtogo.envs.imitation_problems:steer`:

    Steering    steer_by_picture      Lane     steer      BrakeLight    brake
    Drone       pass_the_tree         Tightrope    balance

All are our own.
"""

from collections.abc import Sequence

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from ..core import Action, Drawn, Environment, Observation, PRNGKey, State, Timestep
from .canvas import BLUE, INK, MIST, PAPER, SKY, STONE, VERMILION, Canvas, enlarged
from .tabular import TabularState
from .tabular_problems import ROPE, TIGHTROPE_EXPERT

SIDE, WIDTH, SPREAD = 0.5, 0.3, 0.05
"""Of `Drone`: where the expert flies beside the tree's middle, half the tree, and how much the expert's headings vary."""
SIZE = 16
"""Pixels of a side of the picture that `Lane` shows."""


def _ended(observation: Observation, reward: Array, terminated: Array) -> Timestep:
    return Timestep(observation, reward, terminated, jnp.zeros((), bool), observation, {})


class DroneState(eqx.Module):
    """The tree's place, the heading, and whether the flight is over (before it the heading is 0)."""

    place: Float[Array, "1"]
    heading: Float[Array, "1"]
    flown: Bool[Array, ""]


class Drone(Drawn):
    """One heading, one flight: reward 1, or -1 where it ends in the tree. Observes the tree's place c in [-0.3, 0.3].

    A heading a in [-1, 1] passes the tree at a; it hits where |a - c| < 0.3. The expert flies c + 0.5 or c - 0.5, by a coin.
    """

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(-0.3, 0.3, (1,), np.float32)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        place = jax.random.uniform(key, (1,), minval=-0.3, maxval=0.3)
        return DroneState(place, jnp.zeros(1), jnp.zeros((), bool)), place

    def step(self, state: DroneState, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        over, heading = jnp.ones((), bool), jnp.asarray(action, jnp.float32)
        reward = jnp.where(self.hits(state.place, heading), -1.0, 1.0)
        return DroneState(state.place, heading, over), _ended(state.place, reward, over)

    def render(self, state: DroneState, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """From above: the tree, and the flight past it, or into it."""
        del earlier
        place, heading, sheet = float(state.place[0]), float(state.heading[0]), Canvas((-1.2, -0.2), (1.2, 1.6))
        sheet.disc((place, 0.8), WIDTH, STONE)
        hit = abs(heading - place) < WIDTH
        end = (0.0, 0.0)
        if state.flown:
            end = (heading, 0.8 - np.sqrt(WIDTH**2 - (heading - place) ** 2) if hit else 1.4)
            sheet.line([(0, 0), (heading, 0.4), end], 0.03, SKY)
        for x, y in ((-0.07, -0.07), (-0.07, 0.07), (0.07, -0.07), (0.07, 0.07)):
            sheet.disc((end[0] + x, end[1] + y), 0.05, VERMILION if state.flown and hit else BLUE)
        sheet.disc(end, 0.05, INK)
        return sheet.picture()

    def hits(self, observation: Float[Array, "1"], action: Float[Array, "1"]) -> Bool[Array, ""]:
        """Whether a heading ends in the tree."""
        return jnp.abs(action - observation)[0] < WIDTH

    def expert(self, observation: Float[Array, "1"], key: PRNGKey) -> Float[Array, "1"]:
        """A heading of the expert's."""
        coin_key, noise_key = jax.random.split(key)
        side = jnp.where(jax.random.bernoulli(coin_key), SIDE, -SIDE)
        return jnp.clip(observation + side + SPREAD * jax.random.normal(noise_key, (1,)), -1.0, 1.0)


class LaneState(eqx.Module):
    """Distance from the middle of the lane (1 is its edge), direction relative to it, and steps so far."""

    offset: Float[Array, ""]
    direction: Float[Array, ""]
    time: Int[Array, ""]


class Lane(Drawn):
    """Reward 1 for every step in the lane; leaving it terminates. Put a time limit around it.

    theta' = theta + 0.1 a - 0.05 kappa_t + wind,    y' = y + 0.2 sin theta',    wind ~ N(0, `wind`^2), kappa_t the road's curvature

    With `picture` it observes 16 x 16 pixels, the road is straight, and the actions are 0 left, 1 straight, 2 right; otherwise
    (y, theta, kappa), and a in [-1, 1] is the steering.
    """

    wind: float = eqx.field(default=0.02, static=True)
    picture: bool = eqx.field(default=False, static=True)

    @property
    def observation_space(self) -> spaces.Box:
        if self.picture:
            return spaces.Box(0, 255, (SIZE, SIZE, 1), np.uint8)
        return spaces.Box(-np.inf, np.inf, (3,), np.float32)

    @property
    def action_space(self) -> spaces.Space:
        return spaces.Discrete(3) if self.picture else spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        del key
        state = LaneState(jnp.zeros(()), jnp.zeros(()), jnp.zeros((), jnp.int32))
        return state, self._observe(state)

    def step(self, state: LaneState, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        steering = jnp.asarray(action, jnp.float32) - 1.0 if self.picture else jnp.asarray(action)[0]
        shaken = self.wind * jax.random.normal(key)
        direction = state.direction + 0.1 * steering - 0.05 * self._curvature(state.time) + shaken
        state = LaneState(state.offset + 0.2 * jnp.sin(direction), direction, state.time + 1)
        return state, _ended(self._observe(state), jnp.ones(()), jnp.abs(state.offset) > 1.0)

    def expert(self, observation: Observation) -> Action:
        """Steers back to the middle: a = kappa / 2 - 2 y - 4 theta. A picture is read first."""
        if not self.picture:
            y, theta, kappa = observation
            return jnp.clip(0.5 * kappa - 2.0 * y - 4.0 * theta, -1.0, 1.0)[None]
        y, theta = read_picture(observation)
        wish = -2.0 * y - 4.0 * theta
        return jnp.where(wish < -0.3, 0, jnp.where(wish > 0.3, 2, 1)).astype(jnp.int32)

    def render(self, state: LaneState, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """From above, the lane as it runs under the car and ahead of it; with `picture`, what is observed."""
        del earlier
        if self.picture:
            return enlarged(np.asarray(draw_road(jnp.asarray(state.offset), jnp.asarray(state.direction))))
        sheet, middle, normal = Canvas((-3.0, -1.2), (3.0, 4.8), MIST), *self._course(int(state.time))
        edges = [middle + side * normal for side in (-1.0, 1.0)]
        sheet.polygon([*edges[0], *edges[1][::-1]], PAPER)
        for edge in edges:
            sheet.line(edge, 0.06, STONE)
        for start in range(-int(state.time) % 6, len(middle) - 2, 6):
            sheet.line(middle[start : start + 3], 0.05, STONE)
        offset, direction = float(state.offset), float(state.direction)
        ahead, right = (
            np.array([np.sin(direction), np.cos(direction)]),
            np.array([np.cos(direction), -np.sin(direction)]),
        )
        place = np.array([offset, 0.0])
        shape = ((-0.45, -0.22), (-0.45, 0.22), (0.3, 0.22), (0.45, 0.12), (0.45, -0.12), (0.3, -0.22))
        sheet.polygon([place + a * ahead + b * right for a, b in shape], VERMILION if abs(offset) > 1.0 else BLUE)
        window = ((0.0, -0.16), (0.0, 0.16), (0.18, 0.13), (0.18, -0.13))
        sheet.polygon([place + a * ahead + b * right for a, b in window], PAPER)
        return sheet.picture()

    def _course(self, time: int, back: int = 10, ahead: int = 30) -> tuple[np.ndarray, np.ndarray]:
        """Points along the middle of the lane, a step apart, from those passed to those to come, and to its right there.

        The origin is beside the car, and the lane points up there.
        """
        bends = 0.05 * np.asarray(self._curvature(jnp.arange(time - back, time + ahead)))
        heading = np.concatenate([[0.0], np.cumsum(bends)])
        heading = heading - heading[back]
        steps = 0.2 * np.stack([np.sin(heading), np.cos(heading)], 1)
        points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])[: len(heading)]
        return points - points[back], np.stack([np.cos(heading), -np.sin(heading)], 1)

    def _curvature(self, time: Array) -> Array:
        return jnp.zeros(()) if self.picture else jnp.sin(2.0 * jnp.pi * time / 50.0)

    def _observe(self, state: LaneState) -> Observation:
        if self.picture:
            return draw_road(state.offset, state.direction)
        return jnp.stack([state.offset, state.direction, self._curvature(state.time)])


def draw_road(offset: Float[Array, ""], direction: Float[Array, ""]) -> UInt8[Array, "16 16 1"]:
    """The middle line of the road from above, the car at the bottom, looking up: dark ground, a bright blurred line."""
    ahead = jnp.linspace(2.0, 0.0, SIZE)
    line = (SIZE - 1) / 2 - 6.0 * (offset + ahead * direction)
    across = jnp.arange(SIZE, dtype=jnp.float32)[None, :] - line[:, None]
    return (255.0 * jnp.exp(-0.5 * jnp.square(across))).astype(jnp.uint8)[..., None]


def side_view(picture: UInt8[Array, "16 16 1"], offset: float, direction: float = 0.0) -> UInt8[Array, "16 16 1"]:
    """What a camera would see that sits `offset` further to the right of the lane, and looks `direction` further to the right.

    Each row is moved as the road would be there, in between pixels by linear interpolation; what comes into sight is dark.
    """
    ahead = jnp.linspace(2.0, 0.0, SIZE)
    source = jnp.arange(SIZE, dtype=jnp.float32)[None, :] + 6.0 * (offset + ahead * direction)[:, None]
    rows = picture[..., 0].astype(jnp.float32)
    moved = jax.vmap(lambda x, row: jnp.interp(x, jnp.arange(SIZE, dtype=jnp.float32), row, left=0.0, right=0.0))(
        source, rows
    )
    return moved.astype(jnp.uint8)[..., None]


def read_picture(picture: UInt8[Array, "16 16 1"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Offset and direction, from where the line is in the rows of a picture; right to about a hundredth where it is in sight."""
    light = picture[..., 0].astype(jnp.float32)
    total = light.sum(1)
    line = (light * jnp.arange(SIZE, dtype=jnp.float32)[None, :]).sum(1) / jnp.maximum(total, 1.0)
    seen = (total > 400.0).astype(jnp.float32)
    ahead = jnp.linspace(2.0, 0.0, SIZE)
    place = ((SIZE - 1) / 2 - line) / 6.0
    # A straight line through what is in sight, by weighted least squares.
    count = jnp.maximum(seen.sum(), 1.0)
    mean_ahead, mean_place = (seen * ahead).sum() / count, (seen * place).sum() / count
    spread = (seen * jnp.square(ahead - mean_ahead)).sum()
    slope = (seen * (ahead - mean_ahead) * (place - mean_place)).sum() / jnp.maximum(spread, 1e-3)
    return mean_place - slope * mean_ahead, slope


class LastTwo(Environment):
    """Random bits; the right answer is o_t XOR o_{t-1} (o_0 XOR o_0 at first). Reward 1 for each, 20 to an episode.

    Whoever sees only o_t is right half of the time, at best (erratum E2.9).
    """

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0.0, 1.0, (1,), np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        bit = jax.random.bernoulli(key).astype(jnp.float32)
        return (bit, bit, jnp.zeros((), jnp.int32)), bit[None]

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        last, bit, time = state
        right = jnp.asarray(action) == self.answer(last, bit)
        following = jax.random.bernoulli(key).astype(jnp.float32)
        return (bit, following, time + 1), _ended(following[None], right.astype(jnp.float32), time + 1 >= 20)

    def answer(self, last: Float[Array, ""], bit: Float[Array, ""]) -> Int[Array, ""]:
        """What the expert, who remembers, answers."""
        return (last != bit).astype(jnp.int32)


class BrakingState(eqx.Module):
    """Whether there is an obstacle, what was done last, and steps so far."""

    obstacle: Float[Array, ""]
    last: Float[Array, ""]
    time: Int[Array, ""]


class Braking(Drawn):
    """Brake (1) while there is an obstacle, drive (0) while there is none: reward 1 for each step that is right, 100 to an episode.

    Observes (sensor, light, obstacle): a sensor that is wrong in 2 % of the steps; a light on the dashboard that shows the last
    action (0 where not `light`); and the truth, for the expert alone. Obstacles come and go with probability 1 %, so that the
    expert's last action tells its next one better than the sensor does: data that teaches to do what was done last, which
    is of no use to whoever then does it (causal confusion; de Haan et al. 2019). Show a pupil the first two entries only, by the
    network `Entries((0, 1))`.
    """

    light: bool = eqx.field(default=True, static=True)

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0.0, 1.0, (3,), np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        obstacle_key, sensor_key = jax.random.split(key)
        obstacle = jax.random.bernoulli(obstacle_key).astype(jnp.float32)
        state = BrakingState(obstacle, jnp.zeros(()), jnp.zeros((), jnp.int32))
        return state, self._observe(state, sensor_key)

    def step(self, state: BrakingState, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        obstacle = state.obstacle
        change_key, sensor_key = jax.random.split(key)
        right = jnp.asarray(action) == obstacle.astype(jnp.int32)
        obstacle = jnp.where(jax.random.bernoulli(change_key, 0.01), 1.0 - obstacle, obstacle)
        state = BrakingState(obstacle, jnp.asarray(action, jnp.float32), state.time + 1)
        return state, _ended(self._observe(state, sensor_key), right.astype(jnp.float32), state.time >= 100)

    def expert(self, observation: Float[Array, "3"]) -> Int[Array, ""]:
        """Brakes for obstacles, which it sees."""
        return observation[2].astype(jnp.int32)

    def render(self, state: BrakingState, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """From the side: the barrier is the obstacle, and the car's light shows that it brakes, as it did last."""
        del earlier
        sheet = Canvas((-2.0, -0.3), (2.0, 1.3))
        sheet.line([(-2, 0), (2, 0)], 0.03, STONE)
        if state.obstacle > 0.5:
            for foot in (1.05, 1.55):
                sheet.line([(foot, 0), (foot, 0.75)], 0.06, INK)
            sheet.box((0.95, 0.4), (1.65, 0.7), VERMILION)
            for left in (1.05, 1.35):
                sheet.polygon([(left, 0.4), (left + 0.12, 0.4), (left + 0.24, 0.7), (left + 0.12, 0.7)], PAPER)
        sheet.box((-1.6, 0.15), (0.0, 0.5), BLUE)
        sheet.polygon([(-1.3, 0.5), (-1.05, 0.82), (-0.5, 0.82), (-0.25, 0.5)], BLUE)
        sheet.polygon([(-1.15, 0.52), (-1.0, 0.74), (-0.55, 0.74), (-0.38, 0.52)], MIST)
        for wheel in (-1.25, -0.35):
            sheet.disc((wheel, 0.17), 0.17, INK, 0.07, STONE)
        sheet.disc((-1.6, 0.4), 0.11 if state.last > 0.5 else 0.06, VERMILION if state.last > 0.5 else STONE)
        return sheet.picture()

    def _observe(self, state: BrakingState, key: Array) -> Array:
        sensor = jnp.where(jax.random.bernoulli(key, 0.02), 1.0 - state.obstacle, state.obstacle)
        return jnp.stack([sensor, state.last if self.light else jnp.zeros(()), state.obstacle])


def steer(observation: Float[Array, "3"]) -> Float[Array, "1"]:
    """The expert of `Lane`."""
    return Lane().expert(observation)


def steer_by_picture(observation: UInt8[Array, "16 16 1"]) -> Int[Array, ""]:
    """The expert of `Steering`, which is `Lane(picture=True)`."""
    return Lane(picture=True).expert(observation)


def brake(observation: Float[Array, "3"]) -> Int[Array, ""]:
    """The expert of `BrakeLight`, which is `Braking()`: it sees what its pupil does not."""
    return Braking().expert(observation)


def pass_the_tree(observation: Float[Array, "1"], key: PRNGKey) -> Float[Array, "1"]:
    """The expert of `Drone`."""
    return Drone().expert(observation, key)


def balance(observation: Int[Array, ""]) -> Int[Array, ""]:
    """The expert of `Tightrope`."""
    return jnp.asarray(TIGHTROPE_EXPERT, jnp.int32)[observation]


def draw_tightrope(state: TabularState, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
    """The walker of `Tightrope`, on the rope or below it, and how much of the time has passed."""
    del earlier
    sheet, done, up = Canvas((-0.3, -0.25), (5.3, 2.9)), min(float(state.time) / 50.0, 1.0), int(state.state) == ROPE
    sheet.box((-0.3, -0.25), (5.3, 0.0), MIST)
    for pole in (0.0, 5.0):
        sheet.line([(pole, 0), (pole, 1.5)], 0.1, INK)
    sheet.line([(0, 1.5), (5, 1.5)], 0.04, STONE)
    x, foot, colour = 0.3 + 4.4 * done, 1.5 if up else 0.0, BLUE if up else VERMILION
    hip, neck = foot + 0.4, foot + 0.8
    for side in (-1, 1):
        sheet.line([(x, hip), (x + 0.13 * side, foot)], 0.07, colour)
        sheet.line([(x, neck - 0.08), (x + 0.38 * side, neck - 0.02)], 0.06, colour)
    sheet.line([(x, hip), (x, neck)], 0.08, colour)
    sheet.disc((x, neck + 0.14), 0.14, colour)
    return sheet.picture()
