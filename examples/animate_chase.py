"""A chase with a custom robot, as an animation: python examples/animate_chase.py unicycle chase.webp"""

import sys
import tempfile
from pathlib import Path

from accelerating_evader import Accelerating
from car_pursuer import Car
from unicycle_evader import Unicycle

import sidestep
from sidestep.views import animate

# Changes to the paper's test scene, the pursuer's strategy, and the playback speed (times real speed).
CHASES = {
    "car": ({"pursuer_model": Car(), "capture_distance": 0.15}, "chauffeur", 3.0),
    "unicycle": ({"evader_model": Unicycle(), "capture_distance": 0.17}, "nash", 9.0),
    "mass": ({"evader_model": Accelerating(), "capture_distance": 0.18}, "nash", 12.0),
}

name = sys.argv[1] if len(sys.argv) > 1 else "car"
path = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(tempfile.mkdtemp()) / f"{name}.webp"
fields, pursuer, speed = CHASES[name]
scenario = sidestep.load_scenario("paper-test", **fields)
chase = sidestep.rollout(scenario, sidestep.goal_seeking, "joint", pursuer, 0)
animate(scenario, chase, path, shield="joint", speed=speed, rate=12, width=480, levels=())
print(f"{chase.outcome} after {chase.length * float(scenario.control_period):.1f} s: {path}")
