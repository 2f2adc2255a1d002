"""Chases to the end: does either side do better, or worse, than the game of time promises?"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import CaptureGame, make_pursuer
from sidestep.world import Scenario, World, load_scenario
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.robots import drive

# Evader and wheel speed, half axle, capture distance; with l < b the pursuer also backs off.
WIDE = (0.1574, 0.2, 0.2, 0.3)
SLOW = (0.06, 0.2, 0.3, 0.05)
PAPER = (0.1574, 0.2, 0.2, 0.2)

CHASES = ["nash", "turn-then-drive", "pure-pursuit", "interceptor"]
FLIGHTS = ["optimal", "to and fro", "radial", "around", "barrier"]


def flights(game: CaptureGame, z):
    """Directions in which an evader may flee, in the order of FLIGHTS."""
    best, away = game.play(z).direction, z / jnp.hypot(z[0], z[1])
    to_and_fro = best * jnp.array([1.0, -1.0])
    return jnp.stack([best, to_and_fro, away, jnp.stack([-away[1], away[0]]), game.barrier(z)[1]])


@jax.jit
def capture_times(scenario: Scenario, chase, flight, z, longest):
    """All chases and flights in one program, which compiles once."""
    game = CaptureGame.of(scenario)
    period = scenario.control_period

    def episode(start):
        def go_on(carry):
            evader, pose, time = carry
            return (jnp.hypot(*(evader - pose[:2])) > game.capture_distance) & (time < longest)

        def move(carry):
            evader, pose, time = carry
            ahead = flights(game, to_pursuer_frame(evader, pose))[flight]
            cosine, sine = jnp.cos(pose[2]), jnp.sin(pose[2])
            turned = jnp.stack([cosine * ahead[0] - sine * ahead[1], sine * ahead[0] + cosine * ahead[1]])
            world = World(evader, pose[None], jnp.zeros((0, 4)), jnp.zeros(2))
            wheels = jnp.stack([make_pursuer(name)(scenario, world, jax.random.key(0)) for name in CHASES])[
                chase
            ]
            moved = drive(pose, wheels, scenario.pursuer_half_axle, period)
            return evader + game.evader_speed * turned * period, moved, time + period

        return jax.lax.while_loop(go_on, move, (start, jnp.zeros(3), jnp.zeros(())))[2]

    return jax.vmap(episode)(z)


def simulate(parameters, chase: str, flight: str, z, longest: float) -> np.ndarray:
    """Times (s) at which the pursuer, from the origin heading along x, catches evaders that start at z."""
    names = ("evader_speed", "pursuer_speed", "pursuer_half_axle", "capture_distance")
    scenario = load_scenario("paper", **dict(zip(names, parameters, strict=True)), control_period=0.01)
    numbers = jnp.asarray(CHASES.index(chase)), jnp.asarray(FLIGHTS.index(flight))
    return np.asarray(capture_times(scenario, *numbers, jnp.asarray(z, float), jnp.asarray(longest)))


play = jax.jit(jax.vmap(lambda game, z: (game.time_to_capture(z), game.barrier(z)[0]), in_axes=(None, 0)))


def starts(
    parameters, seed: int, count: int = 40, reach: float = 2.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evaders outside the capture circle, the time promised to them, and the barrier's value.

    None is so near the barrier's inside that a pursuer which decides only every 0.01 s is too late to strike.
    """
    draw, size = np.random.default_rng(seed), parameters[3]
    distance = size * np.sqrt(draw.uniform(1.0, reach**2, count))
    bearing = draw.uniform(-np.pi, np.pi, count)
    z = distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    time, h = map(np.asarray, play(CaptureGame(*parameters), jnp.asarray(z, float)))
    kept = (h > 0.0) | (h < -0.003)
    return z[kept], time[kept], h[kept]


@pytest.mark.parametrize("flight", FLIGHTS)
@pytest.mark.parametrize("parameters", [WIDE, SLOW], ids=["wide", "slow"])
def test_nash_needs_no_longer_than_promised(parameters, flight):
    """However the evader flees, and just as long when it flees as well as it can, but for sampling."""
    z, promised, _ = starts(parameters, seed=4)
    late = simulate(parameters, "nash", flight, z, 30.0) - promised
    assert late.max() < 0.08
    if flight == "optimal":
        assert late.min() > -0.03


@pytest.mark.parametrize("chase", CHASES[1:])
@pytest.mark.parametrize("parameters", [WIDE, SLOW], ids=["wide", "slow"])
def test_no_other_pursuer_is_quicker_against_the_optimal_evader(parameters, chase):
    z, promised, _ = starts(parameters, seed=5)
    early = promised - simulate(parameters, chase, "optimal", z, 30.0)
    assert early.max() < 0.03


def test_inside_the_capture_set_nash_catches_an_evader_that_could_escape_outside_it():
    z, promised, h = starts(PAPER, seed=6, count=400, reach=1.3)
    inside = h < 0.0
    assert inside.sum() > 20
    taken = simulate(PAPER, "nash", "optimal", z[inside], 5.0)
    np.testing.assert_allclose(taken, promised[inside], atol=0.03)
