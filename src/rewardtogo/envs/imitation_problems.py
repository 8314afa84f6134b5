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

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep
from .tabular_problems import TIGHTROPE_EXPERT

SIDE, WIDTH, SPREAD = 0.5, 0.3, 0.05
"""Of `Drone`: where the expert flies beside the tree's middle, half the tree, and how much the expert's headings vary."""
SIZE = 16
"""Pixels of a side of the picture that `Lane` shows."""


def _ended(observation: Observation, reward: Array, terminated: Array) -> Timestep:
    return Timestep(observation, reward, terminated, jnp.zeros((), bool), observation, {})


class Drone(Environment):
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
        return place, place

    def step(self, state: Array, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        hit = self.hits(state, jnp.asarray(action))
        return state, _ended(state, jnp.where(hit, -1.0, 1.0), jnp.ones((), bool))

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


class Lane(Environment):
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


class Braking(Environment):
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
        return (obstacle, jnp.zeros((), jnp.int32)), self._observe(obstacle, jnp.zeros(()), sensor_key)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        obstacle, time = state
        change_key, sensor_key = jax.random.split(key)
        right = jnp.asarray(action) == obstacle.astype(jnp.int32)
        obstacle = jnp.where(jax.random.bernoulli(change_key, 0.01), 1.0 - obstacle, obstacle)
        observation = self._observe(obstacle, jnp.asarray(action, jnp.float32), sensor_key)
        return (obstacle, time + 1), _ended(observation, right.astype(jnp.float32), time + 1 >= 100)

    def expert(self, observation: Float[Array, "3"]) -> Int[Array, ""]:
        """Brakes for obstacles, which it sees."""
        return observation[2].astype(jnp.int32)

    def _observe(self, obstacle: Array, last: Array, key: Array) -> Array:
        sensor = jnp.where(jax.random.bernoulli(key, 0.02), 1.0 - obstacle, obstacle)
        return jnp.stack([sensor, last if self.light else jnp.zeros(()), obstacle])


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
