"""The whole loop, robot to node to robot, live: nothing late may go unreported."""

import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from conftest import Spinner, wait_until
from sidestep_ros.recorder import Recorder, values_of
from sidestep_ros.twin_node import TwinNode

from sidestep.bridges.logs import load_log
from sidestep.world import load_scenario

SECONDS = 10.0


@pytest.mark.parametrize("rate", [20, 50])
def test_loop_with_the_twin_reports_every_late_command(middleware, start, report, rate, tmp_path):
    common = ("command.type:=twist_stamped", f"scenario_overrides:=[control_period={1 / rate}]")
    node = start("policy_node", *common, "diagnostics_period:=0.0", f"log:={tmp_path / 'loop.mcap'}")
    twin = start("twin_node", *common)
    recorder = Recorder("sidestep_policy")
    with Spinner(recorder):
        node.wait_ready()
        twin.wait_ready()
        wait_until(lambda: len(recorder.latencies()) > rate, "commands that follow poses")
        recorder.forget()
        time.sleep(SECONDS)
        summary = recorder.summary()
        assert node.stop() == 0, node.said
        twin_says = values_of(wait_until(lambda: recorder.others.get("sidestep_twin: robots"), "the twin"))
        last = list(recorder.velocities.values())[-1]
    report(
        f"loop at {rate} Hz: {summary['commands']} commands, pose to command p50 "
        f"{1e3 * summary['latency p50']:.1f} ms, p99 {1e3 * summary['latency p99']:.1f} ms, worst "
        f"{1e3 * summary['latency worst']:.1f} ms, {summary['late commands']} late, "
        f"{summary['late commands not reported']} of them not reported, levels {summary['levels']}"
    )
    assert summary["late commands not reported"] == 0
    assert summary["with latency"] > 0.3 * rate * SECONDS
    # Poses of different sweeps in one decision would make nearly all of them "degraded".
    assert summary["levels"].get("normal", 0) > 0.25 * summary["commands"]
    assert float(twin_says["commands"]) > 0
    # The last word of a node that is told to end is a stop.
    assert last == (0.0, 0.0)
    assert twin.stop() == 0, twin.said
    log = load_log(tmp_path / "loop.mcap")
    assert log.complete
    assert float(log.scenario.control_period) == pytest.approx(1 / rate)
    assert log.trajectory.length >= summary["commands"]
    assert log.about["shield"] == "joint"


def test_a_pursuer_that_draws_draws_anew_every_time():
    node = SimpleNamespace(values={"seed": 0}, scenario=load_scenario("paper"))
    wheels_for = TwinNode._make_pursuer(node, "random")
    world = node.scenario.reset(jax.random.key(0))
    drawn = [wheels_for(world) for _ in range(4)]
    assert len({wheels.tobytes() for wheels in drawn}) == 4
    np.testing.assert_array_less(np.abs(drawn), 0.2 + 1e-6)
