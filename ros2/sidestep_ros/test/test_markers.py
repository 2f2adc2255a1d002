"""Markers: what RViz shows must be where the shield thinks it is."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from sidestep_ros.markers import Painter, capture_set

SCENARIO = SimpleNamespace(
    evader_speed=0.1574, pursuer_speed=0.2, capture_distance=0.2, collision_distance=0.3
)


def decide(**changes):
    world = SimpleNamespace(
        evader=np.array([0.0, 0.0]),
        pursuers=np.array([[1.0, 2.0, math.pi / 2.0]]),
        obstacles=np.array([[3.0, 4.0, 0.0, 0.0]]),
    )
    decision = {
        "world": world, "nominal": np.array([0.1, 0.0]), "velocity": np.array([0.0, 0.1]),
        "plan": np.array([[0.0, 0.0], [0.1, 0.1]]),
    }  # fmt: skip
    return SimpleNamespace(**{**decision, **changes})


def paint(decision, target=None):
    markers = Painter(SCENARIO, "map", 0.2).paint(Time(), decision, target).markers
    return {marker.ns: marker for marker in markers}


def test_capture_set_is_the_set_whose_signed_distance_is_zero():
    from sidestep.world.capture_geometry import capture_set_distance

    usable = math.acos(0.1574 / 0.2)
    for point in capture_set(0.2, 0.1574 / 0.2):
        h = capture_set_distance(np.array(point, np.float32), np.float32(usable), np.float32(0.2))
        assert float(h) == pytest.approx(0.0, abs=1e-6)
    assert max(x for x, _ in capture_set(0.2, 0.787)) == pytest.approx(0.2 / 0.787)


def test_capture_set_of_a_pursuer_that_is_not_faster_is_a_disc():
    assert all(math.hypot(x, y) == pytest.approx(0.2) for x, y in capture_set(0.2, 1.0))


def test_every_robot_is_drawn_where_it_is():
    markers = paint(decide(), target=(5.0, 6.0))
    pursuer = markers["capture set"].pose
    assert (pursuer.position.x, pursuer.position.y) == (1.0, 2.0)
    assert pursuer.orientation.z == pytest.approx(math.sin(math.pi / 4.0))
    assert markers["collision distance"].pose.position.x == 3.0
    assert markers["target"].pose.position.y == 6.0
    assert {marker.header.frame_id for marker in markers.values()} == {"map"}
    assert markers["safe"].points[1].y == pytest.approx(0.2)
    assert markers["nominal"].points[1].x == pytest.approx(0.2)
    assert len(markers["plan"].points) == 2


def test_nothing_that_is_not_finite_is_drawn():
    markers = paint(decide(nominal=np.array([math.nan, 0.0])))
    assert "nominal" not in markers
    assert "safe" in markers


def test_nothing_is_drawn_before_anything_is_known():
    assert paint(decide(world=None)) == {}
