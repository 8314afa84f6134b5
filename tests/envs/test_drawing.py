"""Pictures of compiled environments: what is where in them, by the colours at places that are known from the state."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from rewardtogo.core import MASK, from_space
from rewardtogo.envs.acrobot import Acrobot
from rewardtogo.envs.board_games import ConnectFour, TicTacToe
from rewardtogo.envs.canvas import BLUE, GREEN, INK, LONGEST, ORANGE, PAPER, STONE, VERMILION, Canvas, enlarged
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.cartpole_swing_up import CartPoleSwingUp
from rewardtogo.envs.drawing import Pictured, inside, observed, picture, picture_of
from rewardtogo.envs.grids import STANDS, Taxi, Walk
from rewardtogo.envs.imitation_problems import Braking, BrakingState, Drone, DroneState, Lane, LaneState, draw_tightrope
from rewardtogo.envs.mountain_car import MountainCar
from rewardtogo.envs.obstacles import Obstacles
from rewardtogo.envs.opponents import RandomOpponent, Versus
from rewardtogo.envs.pendulum import Pendulum
from rewardtogo.envs.reacher import Reacher, tip
from rewardtogo.envs.registry import COMPILED
from rewardtogo.envs.tabular import TabularState
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.envs.wrappers import FrameStack, MaskObservation, NoisyObservation

NOTHING = {"OneStep", "TruncatedLoop", "RecallProbe", "LastTwo"}
"""Compiled environments that are too abstract to be drawn."""


def at(shown, low, high, point):
    """The colour of a picture of the rectangle from `low` to `high` at a point."""
    height, width, _ = shown.shape
    column = int((point[0] - low[0]) / (high[0] - low[0]) * width)
    row = int((high[1] - point[1]) / (high[1] - low[1]) * height)
    return tuple(int(v) for v in shown[row, column])


def same(one, other):
    return one is not None and other is not None and np.array_equal(one, other)


def middle_of(shown, colour):
    """Where a colour is, on average, as shares of the picture (right, up)."""
    rows, columns = np.nonzero((shown == np.array(colour)).all(-1))
    assert len(rows), f"nothing of colour {colour}"
    return columns.mean() / shown.shape[1], 1.0 - rows.mean() / shown.shape[0]


def first_steps(name, count=3):
    env = COMPILED[name]()
    key = jax.random.key(0)
    state, observation = env.reset(key)
    found = [(state, observation)]
    for i in range(count):
        if isinstance(observation, dict) and MASK in observation:
            action = jnp.argmax(observation[MASK]).astype(jnp.int32)
        else:
            action = from_space(env.action_space).sample(jax.random.fold_in(key, i))
        state, timestep = env.step(state, action, key)
        observation = timestep.observation
        found.append((state, observation))
        if timestep.done:
            break
    return env, found


@pytest.mark.parametrize("name", [n for n in COMPILED if n not in ("FrozenLake8x8-v1", "CliffWalkingSlippery-v1")])
def test_every_compiled_environment_can_be_drawn_or_says_so(name):
    env, found = first_steps(name, 8 if name in ("FrozenLake-v1", "CliffWalking-v1") else 3)
    states = [state for state, _ in found]
    shown = [picture(env, state, seen, states[:i]) for i, (state, seen) in enumerate(found)]
    if name in NOTHING:
        assert shown == [None] * len(shown) and picture_of(env, found[0][1]) is None
        return
    pictures = [s for s in shown if s is not None]
    first, last = pictures[0], pictures[-1]
    assert len(pictures) == len(shown) and all(s.dtype == np.uint8 and s.shape == first.shape for s in pictures)
    assert LONGEST - 16 <= max(first.shape[:2]) <= LONGEST and first.shape[2] == 3
    assert not np.array_equal(first, last)


def test_the_canvas():
    sheet = Canvas((-1.0, 0.0), (1.0, 1.0))
    sheet.box((-1.0, 0.0), (0.0, 0.5), BLUE)
    sheet.disc((0.5, 0.75), 0.2, GREEN, 0.1)
    sheet.line([(0.2, 0.2), (0.8, 0.2)], 0.1, INK)
    shown = sheet.picture()
    assert shown.shape == (LONGEST // 2, LONGEST, 3)
    for point, colour in [
        ((-0.5, 0.25), BLUE),
        ((-0.5, 0.75), PAPER),
        ((0.5, 0.75), PAPER),
        ((0.65, 0.75), GREEN),
        ((0.5, 0.2), INK),
        ((0.5, 0.35), PAPER),
    ]:
        assert at(shown, (-1, 0), (1, 1), point) == colour
    # A disc's area, with half points at its edge.
    covered = (255.0 - shown[..., 0]).sum() / 255.0 / (LONGEST / 2) ** 2
    blue, ring, line = 0.5, np.pi * (0.04 - 0.01), 0.06 + np.pi * 0.05**2
    assert covered == pytest.approx(blue + ring + line * (255 - INK[0]) / 255, rel=0.01)


def test_small_pictures_are_enlarged_without_change():
    small = np.random.default_rng(0).integers(0, 255, (16, 12, 3), np.uint8)
    large = enlarged(small)
    scale = LONGEST // 16
    assert large.shape == (16 * scale, 12 * scale, 3) and np.array_equal(large[::scale, ::scale], small)
    stack = np.stack([small[..., 0], small[..., 1]], -1)
    assert np.array_equal(enlarged(stack)[::scale, ::scale, 0], small[..., 1])
    assert np.array_equal(enlarged(stack[..., 0])[::scale, ::scale, 2], small[..., 0])
    # Numbers between their bounds become grey.
    shown = observed(spaces.Box(-1.0, 1.0, (2, 2)), np.array([[-1.0, 0.0], [0.5, 1.0]], np.float32))
    assert shown is not None and shown[[0, 0, -1, -1], [0, -1, 0, -1], 0].tolist() == [0, 127, 191, 255]
    assert observed(spaces.Box(-1.0, 1.0, (4,)), np.zeros(4)) is None


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0, 3.0])
def test_rods_and_links_are_where_the_equations_say(angle):
    low, high = (-1.3, -1.3), (1.3, 1.3)
    shown = Pendulum().render(jnp.asarray([angle, 0.0]))
    assert at(shown, low, high, (-0.9 * np.sin(angle), 0.9 * np.cos(angle))) == BLUE
    assert at(shown, low, high, (0.9 * np.sin(angle), -0.9 * np.cos(angle))) == PAPER
    # The hanging rod of Acrobot has angle 0.
    shown = Acrobot().render(jnp.asarray([angle, 0.5, 0.0, 0.0]))
    elbow = np.array([np.sin(angle), -np.cos(angle)])
    assert at(shown, (-2.2, -2.2), (2.2, 2.2), 0.5 * elbow) == BLUE
    end = elbow + np.array([np.sin(angle + 0.5), -np.cos(angle + 0.5)])
    row = at(shown, (-2.2, -2.2), (2.2, 2.2), 0.3 * elbow + 0.7 * end)
    assert row not in (PAPER, BLUE)
    state = jnp.asarray([angle, 1.0, 0.0, 0.0, -0.5, 0.4])
    shown = Reacher().render(state)
    first = 0.5 * np.array([np.cos(angle), np.sin(angle)])
    assert at(shown, (-1.1, -1.1), (1.1, 1.1), 0.5 * first) == BLUE
    beyond = 0.2 * first + 0.8 * np.asarray(tip(state[:2]))
    assert at(shown, (-1.1, -1.1), (1.1, 1.1), beyond) not in (PAPER, BLUE)
    assert np.allclose(middle_of(shown, GREEN), [(-0.5 + 1.1) / 2.2, (0.4 + 1.1) / 2.2], atol=0.02)


def test_carts():
    for x, angle in ((1.5, 0.1), (-2.0, -0.2)):
        shown = CartPole().render(jnp.asarray([x, 0.0, angle, 0.0]))
        low, high = (-2.8, -0.5), (2.8, 1.5)
        assert at(shown, low, high, (x + 0.1, -0.1)) == INK
        assert at(shown, low, high, (x + 0.8 * np.sin(angle), 0.8 * np.cos(angle))) == BLUE
    hanging = CartPoleSwingUp().render(jnp.asarray([0.5, 0.0, np.pi, 0.0]))
    assert at(hanging, (-2.6, -1.3), (2.6, 1.4), (0.5, -0.8)) == BLUE
    assert np.allclose(middle_of(hanging, GREEN), [0.5, 2.3 / 2.7], atol=0.02)
    # A cart that runs away stays in the picture.
    for x in (5.0, -30.0):
        assert 0.05 < middle_of(CartPoleSwingUp().render(jnp.asarray([x, 0.0, np.pi, 0.0])), INK)[0] < 0.95


def test_the_car_is_on_its_hill():
    for x in (-1.0, -0.5, 0.4):
        shown = MountainCar().render(jnp.asarray([x, 0.0]))
        right, up = middle_of(shown, BLUE)
        assert right == pytest.approx((x + 1.2) / 1.8, abs=0.04)
        assert up * 1.25 == pytest.approx(0.45 * np.sin(3 * x) + 0.6, abs=0.04)


def test_the_path_among_the_walls():
    goal = [0.6, -0.6]
    way = [jnp.asarray([x, 0.5, *goal]) for x in (-0.6, -0.4, -0.2)]
    low, high = (-1.05, -1.05), (1.05, 1.05)
    shown = Obstacles().render(way[-1], way[:-1])
    assert at(shown, low, high, (-0.2, 0.5)) == BLUE and at(shown, low, high, (-0.5, 0.5)) not in (PAPER, BLUE)
    assert at(Obstacles().render(way[-1]), low, high, (-0.5, 0.5)) == PAPER
    for wall in ((-0.2, 0.15), (0.25, -0.4), (-0.35, -0.4)):
        assert at(shown, low, high, wall) == STONE
    assert np.allclose(middle_of(shown, GREEN), (np.array(goal) + 1.05) / 2.1, atol=0.01)


def test_the_flight_the_lane_the_brake_and_the_rope():
    flight = lambda heading: DroneState(jnp.asarray([0.1]), jnp.asarray([heading]), jnp.asarray(True))  # noqa: E731
    past, hit = Drone().render(flight(-0.5)), Drone().render(flight(0.3))
    assert middle_of(past, BLUE)[0] == pytest.approx(0.7 / 2.4, abs=0.01) and not (past == VERMILION).all(-1).any()
    assert middle_of(hit, VERMILION)[0] == pytest.approx(1.5 / 2.4, abs=0.01) and not (hit == BLUE).all(-1).any()
    braking = lambda obstacle, last: Braking().render(  # noqa: E731
        BrakingState(jnp.asarray(obstacle), jnp.asarray(last), jnp.asarray(1))
    )
    low, high = (-2.0, -0.3), (2.0, 1.3)
    for obstacle in (0.0, 1.0):
        for last in (0.0, 1.0):
            shown = braking(obstacle, last)
            assert (at(shown, low, high, (1.0, 0.65)) == VERMILION) == bool(obstacle)
            assert (at(shown, low, high, (-1.67, 0.4)) == VERMILION) == bool(last)
    for state, up in ((0, True), (1, False)):
        shown = draw_tightrope(TabularState(jnp.asarray(state), jnp.asarray(25)))
        assert at(shown, (-0.3, -0.25), (5.3, 2.9), (2.5, 2.1 if up else 0.6)) == (BLUE if up else VERMILION)
    lane = lambda offset: Lane().render(LaneState(jnp.asarray(offset), jnp.zeros(()), jnp.asarray(7)))  # noqa: E731
    for offset in (-0.6, 0.0, 0.8):
        assert middle_of(lane(offset), BLUE)[0] == pytest.approx((offset + 3) / 6, abs=0.01)
    assert middle_of(lane(1.1), VERMILION)[0] == pytest.approx(4.1 / 6, abs=0.01)


def test_the_lane_ahead_is_the_one_that_comes(key):
    """Who steers along it, without wind, stays on the course as it was drawn steps before."""
    env = Lane(wind=0.0)
    state = LaneState(jnp.zeros(()), jnp.zeros(()), jnp.asarray(3))
    course, _ = env._course(3)
    place, heading, now = np.zeros(2), 0.0, state
    for k in range(20):
        kappa = env._curvature(now.time)
        now, _ = env.step(now, 0.5 * kappa[None], key)
        heading += 0.05 * float(kappa)
        assert abs(float(now.offset)) < 1e-6 and abs(float(now.direction)) < 1e-6
        # The course goes on by a step, and then bends.
        place = place + 0.2 * np.array([np.sin(heading - 0.05 * float(kappa)), np.cos(heading - 0.05 * float(kappa))])
        assert np.allclose(course[10 + k + 1], place, atol=1e-5)


def test_boards_show_the_agents_stones(key):
    env = Versus(TicTacToe(), RandomOpponent())
    state: Any
    for seed in range(4):
        state, _ = env.reset(jax.random.key(seed))
        state, _ = env.step(state, jnp.asarray(4 if int(state.game.mine | state.game.theirs) != 16 else 0), key)
        shown = env.render(state)
        for square in range(9):
            x, y = square % 3 + 0.5, 2.5 - square // 3
            colour = at(shown, (-0.1, -0.1), (3.1, 3.1), (x, y)), at(shown, (-0.1, -0.1), (3.1, 3.1), (x + 0.28, y))
            own, other = (state.game.mine, state.game.theirs)
            if int(env.game.player(state.game)) != int(state.side):
                own, other = other, own
            assert (colour[0] == BLUE) == bool(int(own) >> square & 1)
            assert (colour[1] == ORANGE) == bool(int(other) >> square & 1)
    game = ConnectFour()
    own, other = np.zeros((6, 7), np.int8), np.zeros((6, 7), np.int8)
    own[0, 2] = other[1, 2] = 1
    shown = game.draw(own, other)
    assert at(shown, (0, 0), (7, 6), (2.5, 0.5)) == BLUE and at(shown, (0, 0), (7, 6), (2.5, 1.8)) == ORANGE
    assert at(shown, (0, 0), (7, 6), (2.5, 2.5)) == PAPER


def test_walks_and_taxis():
    walk = Walk(("SFH", "FCG"))
    low, high = (-0.04, -0.04), (3.04, 2.04)
    shown = walk(jnp.asarray(1), [jnp.asarray(0)])
    assert at(shown, low, high, (1.5, 1.5)) == BLUE and at(shown, low, high, (2.5, 1.5)) == INK
    assert at(shown, low, high, (1.5, 0.5)) == VERMILION and at(shown, low, high, (2.5 + 0.36, 0.5)) == GREEN
    assert at(shown, low, high, (1.0, 1.5)) not in (STONE, PAPER) and at(shown, low, high, (0.5, 0.5)) == PAPER
    env = inside(COMPILED["Taxi-v4"](), TabularState(jnp.zeros((), int), jnp.zeros((), int)))[0]
    assert isinstance(env, Pictured) and isinstance(env.drawing, Taxi)
    assert env.drawing.walls == {(0, 1), (1, 1), (3, 0), (4, 0), (3, 2), (4, 2)}
    # In the third row, fourth column, the passenger at the second stand, to the first; then aboard.
    shown = env.drawing(jnp.asarray(((2 * 5 + 3) * 5 + 1) * 4 + 0))
    low, high, place = (-0.04, -0.04), (5.04, 5.04), lambda square: (square[1] + 0.5, 4.5 - square[0])
    assert at(shown, low, high, place(STANDS[1])) == BLUE and at(shown, low, high, place((2, 3))) != BLUE
    assert np.allclose(middle_of(shown, GREEN), [0.54 / 5.08, 4.54 / 5.08], atol=0.02)
    assert at(env.drawing(jnp.asarray(((2 * 5 + 3) * 5 + 4) * 4)), low, high, place((2, 3))) == BLUE


def test_wrappers_are_seen_through(key):
    env = TimeLimit(MaskObservation(NoisyObservation(CartPole(), 0.5), (0, 2)), 10)
    state, observation = env.reset(key)
    bare, now = inside(env, state)
    assert isinstance(bare, CartPole)
    assert same(picture(env, state, observation), CartPole().render(now))
    # What is observed with noise does not tell the state; what is observed in part is drawn as far as it is seen.
    assert picture_of(env, observation) is None
    hidden = TimeLimit(MaskObservation(CartPole(), (0, 2)), 10)
    state, observation = hidden.reset(key)
    assert same(picture_of(hidden, observation), CartPole().render(inside(hidden, state)[1]))
    stacked = FrameStack(Pictured(Lane(picture=True), lambda state, earlier: None), 2)
    state, observation = stacked.reset(key)
    # A drawing that gives nothing leaves the observation's newest picture.
    assert same(picture(stacked, state, observation), enlarged(np.asarray(observation)[..., 1]))
