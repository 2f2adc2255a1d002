"""Messages of the live page's visitors: nothing that is not exactly one gets through."""

import json

import pytest

pytest.importorskip("msgspec")

from sidestep.views.play import messages
from sidestep.views.play.messages import MessageError, Reader
from sidestep.views.play.sliders import numbers_of, sliders_for, with_numbers
from sidestep.views.play.verdict import quick_verdict, verdict
from sidestep.world import Scenario

READER = Reader(sliders_for(Scenario()), pursuers=1, obstacles=1, longest=4096)
SCENE = {"evader": [[0, 0]], "target": [[1, 1]], "pursuers": [[1, 0, 3.1]], "obstacles": [[2, 2, 0.02, 0]]}


def read(**message):
    return READER.read(json.dumps(message))


@pytest.mark.parametrize(
    "message, expected",
    [
        ({"type": "drive", "wheels": [1, -0.5]}, messages.Drive(wheels=(1.0, -0.5))),
        ({"type": "drive", "toward": [2, -3.5]}, messages.Drive(toward=(2.0, -3.5))),
        ({"type": "drive"}, messages.Drive()),
        ({"type": "seen", "frame": 7}, messages.Seen(7)),
        ({"type": "pause", "paused": True}, messages.Pause(True)),
        ({"type": "pace", "pace": 0.25}, messages.Pace(0.25)),
        ({"type": "reset", "again": True}, messages.Reset(True)),
        ({"type": "pick", "shield": "joint"}, messages.Pick("joint", None)),
        ({"type": "set", "values": {"evader_speed": 0.2}}, messages.Numbers({"evader_speed": 0.2}, False)),
        (
            {"type": "move", "what": "pursuer", "to": [1, 2], "heading": 0.5},
            messages.Move("pursuer", (1.0, 2.0), 0, 0.5),
        ),
        ({"type": "show", "rows": True, "plan": False}, messages.Show(True, False)),
    ],
)
def test_every_kind_of_message_is_read(message, expected):
    assert read(**message) == expected


def test_a_link_is_read_whole():
    message = read(
        type="restore", shield="paper", pursuer="you", values={"capture_distance": 0.3}, scene=SCENE
    )
    assert (message.shield, message.pursuer) == ("paper", "you")
    assert message.values == {"capture_distance": 0.3}
    assert message.scene.pursuers == ((1.0, 0.0, 3.1),)


@pytest.mark.parametrize(
    "text",
    [
        None, b"{}", "", "null", "[]", "7", "{", '{"type":"reset"}}', '{"type":null}', '{"type":["reset"]}',
        '{"type":"fly"}', '{"type":"reset","extra":1}', '{"type":"reset","again":1}',
        '{"type":"drive","wheels":[NaN,0]}', '{"type":"drive","wheels":[Infinity,0]}',
        '{"type":"drive","wheels":[1e999,0]}', '{"type":"drive","wheels":[1.01,0]}',
        '{"type":"drive","wheels":[1]}', '{"type":"drive","wheels":"11"}',
        '{"type":"drive","wheels":[true,0]}',
        '{"type":"drive","toward":[51,0]}', '{"type":"drive","toward":{"x":1}}',
        '{"type":"seen","frame":-1}', '{"type":"seen","frame":1.5}', '{"type":"seen","frame":1e400}',
        '{"type":"pause"}', '{"type":"pause","paused":"yes"}', '{"type":"pace","pace":0}',
        '{"type":"pick","shield":"armour"}', '{"type":"pick","pursuer":["nash"]}',
        '{"type":"set","values":{"evader_speed":9}}', '{"type":"set","values":{"control_period":1}}',
        '{"type":"set","values":[1]}', '{"type":"set","values":{"__class__":1}}',
        '{"type":"move","what":"floor","to":[0,0]}', '{"type":"move","what":"obstacle","index":1,"to":[0,0]}',
        '{"type":"move","what":"evader","to":[0,"0"]}',
        '{"type":"move","what":"pursuer","to":[0,0],"heading":9}',
        '{"type":"restore","scene":{}}', '{"type":"restore","scene":7}',
        "[" * 4000, '{"a":' * 600, '{"type":"reset","again":' + "1" * 4000 + "}", "é" * 3000,
        '{"type":"seen","frame":' + "9" * 400 + "}", '{"type":"pace","pace":' + "9" * 400 + "}",
    ],
)  # fmt: skip
def test_garbage_is_refused_with_words(text):
    with pytest.raises(MessageError, match=r"\w+"):
        READER.read(text)


@pytest.mark.parametrize(
    "name, robots",
    [
        ("pursuers", []),
        ("pursuers", [[0, 0, 0], [1, 1, 1]]),
        ("obstacles", [[0, 0, 5, 0]]),
        ("evader", [[0, None]]),
        ("evader", [[1e9, 0]]),
    ],
)
def test_a_scene_that_does_not_fit_is_refused(name, robots):
    with pytest.raises(MessageError):
        read(type="restore", scene={**SCENE, name: robots})


def test_sliders_reach_the_scenario_and_nothing_else_changes():
    scenario = Scenario()
    numbers = {**numbers_of(scenario), "capture_distance": 0.4, "obstacle_speed": 0.05}
    changed = with_numbers(scenario, numbers)
    assert numbers_of(changed) == pytest.approx(numbers)
    assert float(changed.control_period) == float(scenario.control_period)
    # Nobody starts caught: the set's tip is farther out now.
    assert float(changed.initial_separation) > 0.4 / 0.787


@pytest.mark.parametrize(
    "change, kind",
    [
        ({"capture_distance": 0.21}, "caught"),
        ({"evader_speed": 0.15}, "caught"),
        ({}, "open"),
        ({"capture_distance": 0.15}, "held"),
        ({"evader_speed": 0.25}, "held"),
    ],
)
def test_verdict_is_that_of_the_game_and_of_the_certificate(change, kind):
    numbers = {**numbers_of(Scenario()), **change}
    assert verdict(numbers, 0.05, pursuers=1).kind == kind
    assert quick_verdict(numbers, 0.05).kind == ("caught" if kind == "caught" else "unsure")


def test_nothing_is_certified_against_two_pursuers():
    numbers = {**numbers_of(Scenario()), "capture_distance": 0.1}
    assert verdict(numbers, 0.05, pursuers=2).kind == "open"
