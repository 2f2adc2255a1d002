"""The study of noise and delay on the twin: does it count right, go on where it stopped, and judge fairly?"""

import json
import sys

import pytest

import twin as study


@pytest.mark.slow
def test_an_interrupted_study_goes_on_where_it_stopped(tmp_path, monkeypatch, capsys):
    out, whole_block, calls = tmp_path / "twin.json", study.run_block, []

    def interrupted(job):
        calls.append(job)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return whole_block(job)

    # The certificate has tests of its own.
    said = {"errors": {}, "guaranteed": True, "guaranteed_clearance": 0.16}
    monkeypatch.setattr(study, "verdict", lambda s, n, d: {"scenario": s, "noise": n, "delay": d, **said})
    monkeypatch.setattr(study, "run_block", interrupted)

    def run(*options):
        arguments = [
            "twin", "--out", str(out), "--scenarios", "roomy", "--noises", "0.002", "--delays", "0", "0.05",
            "--blocks", "1", "--block", "2", "--steps", "15", "--shield", "none", *options,
        ]  # fmt: skip
        monkeypatch.setattr(sys, "argv", arguments)
        study.main()
        return json.loads(out.read_text())

    first = run()
    assert len(first["blocks"]) == 1
    assert "goes on after the 1 blocks" in capsys.readouterr().out
    second = run()
    assert [job[3] for job in calls] == [0.0, 0.05, 0.05]
    assert second["blocks"][0] == first["blocks"][0]
    assert [cell["episodes"] for cell in second["cells"]] == [2, 2]
    # Random starts are 0.6 m apart, and 0.75 s are not enough to come close.
    assert all(0.3 < cell["least_pursuer_distance"] < 5.0 for cell in second["cells"])
    assert "0 cells in which the certificate was too optimistic" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="other settings"):
        run("--seed", "1")


def test_a_guarantee_that_was_broken_shows():
    block = {
        "scenario": "roomy", "base": "servo", "noise": 0.0, "delay": 0.0, "block": 0, "episodes": 10,
        "captured": 0, "collided": 1, "reached": 9, "timed_out": 0, "cut": 0,
        "least_pursuer_distance": 0.16, "least_obstacle_distance": 0.19,
    }  # fmt: skip
    lost = {**block, "block": 1, "captured": 2, "reached": 7, "least_pursuer_distance": 0.1499}
    said = [
        {"scenario": "roomy", "noise": 0.0, "delay": 0.0, "guaranteed": True, "guaranteed_clearance": 0.17}
    ]
    assert not study.summary([block], said)[0]["optimistic"]
    (cell,) = study.summary([block, lost], said)
    assert cell["optimistic"]
    assert (cell["episodes"], cell["captured"], cell["collided"], cell["reached"]) == (20, 2, 2, 16)
    assert cell["captured_rate_low"] < 0.1 < cell["captured_rate_high"]


def test_a_cell_is_measured_with_the_errors_it_names():
    options = study._options("omniwheels", 0.004, 0.05)
    assert options.base == "omniwheels"
    assert options.sensors.position_noise == 0.004
    # One degree at 4 mm, as motion capture has half a degree at 2 mm.
    assert options.sensors.heading_noise == pytest.approx(0.0174533, rel=1e-4)
    assert options.sensors.delay == 0.05
    assert options.sensors.synchronised
    assert float(study._scenario("roomy").capture_distance) == pytest.approx(0.15)
