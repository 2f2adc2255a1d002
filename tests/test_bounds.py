"""Hazard: a number that nobody checks because nobody said what it may be."""

import dataclasses
import math

import numpy as np
import pytest

from sidestep._bounds import SEED, Bound, allowed, bounded, check, did_you_mean, one_of, taken
from sidestep.cli import _RUN
from sidestep.commands.video import Video
from sidestep.learning import TD3, TrainingOptions
from sidestep.plants.air import FlightOptions
from sidestep.plants.air.airframe import Airframe
from sidestep.plants.air.autopilot import Gains
from sidestep.plants.ground import Sensors, TwinOptions
from sidestep.robot import OnboardSettings
from sidestep.safety import Budget
from sidestep.safety.clearance import ClearanceGame, Resolution
from sidestep.trials.falsification import Plan
from sidestep.views.play import Hosting, Limits
from sidestep.views.play.sliders import SLIDERS
from sidestep.world import Scenario
from sidestep.world.flyers import Aircraft, Quadrotor

CLASSES = [
    Scenario, Quadrotor, Aircraft, TD3, TrainingOptions, Budget, Sensors, TwinOptions, FlightOptions,
    Airframe, Gains, OnboardSettings, Plan, Hosting, Limits, Video, ClearanceGame, Resolution, *_RUN,
]  # fmt: skip


@pytest.mark.parametrize("owner", CLASSES, ids=lambda owner: owner.__name__)
def test_every_number_of_every_class_says_what_it_may_be(owner):
    for field in dataclasses.fields(owner):
        rule = allowed(owner)[field.name]
        if isinstance(rule, Bound) and field.default not in (None, dataclasses.MISSING):
            rule(field.default)
        if isinstance(rule, Bound):
            for value in (math.nan, -math.inf, "1", True, {}):
                with pytest.raises(ValueError, match=f"^{field.name} = .*: it must be .*number"):
                    check(owner, {field.name: value})


@pytest.mark.parametrize("kind", ["int", "float | None", "Scalar", "tuple[float, ...]", 'Float[Array, "2"]'])
def test_number_without_a_bound_does_not_pass(kind):
    forgetful = dataclasses.make_dataclass("Forgetful", [("seconds", kind, dataclasses.field(default=None))])
    for checked in (lambda: check(forgetful()), lambda: check(forgetful, {"seconds": 1.0})):
        with pytest.raises(TypeError, match=r"'seconds' of .*Forgetful.* declares no bound"):
            checked()


@dataclasses.dataclass
class Settings:
    speed: float = bounded(1.0, above=0.0, unit="m/s")
    share: float = bounded(0.5, least=0.0, below=1.0)
    count: int = bounded(3, least=1)
    most: int | None = bounded(None, least=1, most=9, whole=True)
    mode: str = bounded("slow", one_of("slow", "fast"))
    place: tuple[float, float] = bounded((0.0, 0.0), shape=(2,), unit="m")
    paths: tuple[tuple[float, float], ...] = bounded((), shape=(None, 2), least=-1.0, empty=True)
    limit: float = bounded(math.inf, above=0.0, infinite=True)
    strict: bool = False
    name: str = "x"


COUNTS = "it must be a whole number of at least 1 and at most 2^31 - 1"


@pytest.mark.parametrize(
    "values, words",
    [
        ({"speed": 0}, "speed = 0: it must be a finite number, greater than 0 m/s"),
        ({"speed": 1e-60}, "speed = 1e-60: it must be a finite number, greater than 0 m/s"),
        ({"speed": 1e60}, "speed = 1e+60: it must be a finite number, greater than 0 m/s"),
        ({"share": np.float64(1.0)}, "share = 1.0: it must be a finite number, 0 or more and less than 1"),
        ({"count": 2.0}, f"count = 2.0: {COUNTS}"),
        ({"count": 10**30}, f"count = {10**30}: {COUNTS}"),
        ({"count": None}, f"count = None: {COUNTS}"),
        ({"most": 10}, "most = 10: it must be a whole number from 1 to 9"),
        ({"mode": "Fast"}, "mode = 'Fast': it must be one of 'slow', 'fast'"),
        ({"place": [1.0]}, "place = [1.0]: it must be 2 finite numbers"),
        ({"place": [[1.0], [2.0, 3.0]]}, "place = [[1.0], [2.0, 3.0]]: it must be 2 finite numbers"),
        ({"place": [1.0, math.nan]}, "place = [1.0, nan]: it must be 2 finite numbers"),
        ({"paths": [[0.0, -2.0]]}, "paths = [[0.0, -2.0]]: it must be n x 2 finite numbers, each -1 or more"),
        ({"limit": -math.inf}, "limit = -inf: it must be a number, greater than 0"),
        ({"strict": 1}, "strict = 1: it must be true or false"),
        ({"name": 1}, "name = 1: it must be text"),
        (
            {"count": 0, "speed": -1.0},
            f"count = 0: {COUNTS}; speed = -1.0: it must be a finite number, greater than 0 m/s",
        ),
    ],
)  # fmt: skip
def test_refusal_names_the_field_its_value_and_what_is_allowed(values, words):
    with pytest.raises(ValueError, match="it must be") as refused:
        check(Settings, values)
    assert str(refused.value) == words


def test_good_values_come_back_as_they_are_used():
    used = check(Settings, {"count": np.int32(4), "speed": np.float32(0.5), "most": None, "paths": []})
    assert (used["count"], used["speed"], used["most"], used["paths"].shape) == (4, 0.5, None, (0, 2))
    assert (type(used["count"]), type(used["speed"])) == (int, float)
    assert check(Settings()) == dataclasses.asdict(Settings()) | {"place": pytest.approx([0.0, 0.0])} | {
        "paths": pytest.approx(np.zeros((0, 2)))
    }


def test_seeds_and_names_have_words_of_their_own():
    with pytest.raises(ValueError, match=r"a whole number from 0 to 2\^32 - 1, 4294967295$"):
        taken("seed", 2**32, SEED)
    assert did_you_mean("sped", ["speed", "share"]) == "; did you mean 'speed'?"
    assert did_you_mean("zzz", ["speed"]) == "."


@pytest.mark.parametrize("slider", SLIDERS, ids=lambda slider: slider.name)
def test_a_slider_offers_only_what_its_field_allows(slider):
    fields = allowed(Scenario)
    values = (slider.low, slider.high)
    for value in [(0.0, value) for value in values] if slider.name == "obstacle_speed" else values:
        name = "obstacle_velocity" if slider.name == "obstacle_speed" else slider.name
        taken(name, value, fields[name])
        assert slider.unit == fields[name].unit
