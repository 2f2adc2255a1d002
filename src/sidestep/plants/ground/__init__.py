"""The twin: the scenario's robots in MuJoCo, with motors, wheels, sensor noise and delay."""

from sidestep.plants.contacts import Contacts, Watch
from sidestep.plants.ground.episode import TwinEpisode, run_twin, settings_for, twin_episode
from sidestep.plants.ground.options import TwinOptions, bounded_errors
from sidestep.plants.ground.robots import BASES
from sidestep.plants.ground.twin import Twin
from sidestep.plants.library import TwinError
from sidestep.plants.options import PURSUER_SEES
from sidestep.plants.sensors import SENSORS, Measurement, Sensors, changed_sensors, make_sensors
from sidestep.plants.video import frames_of, write_video

__all__ = [
    "BASES",
    "PURSUER_SEES",
    "SENSORS",
    "Contacts",
    "Measurement",
    "Sensors",
    "Twin",
    "TwinEpisode",
    "TwinError",
    "TwinOptions",
    "Watch",
    "bounded_errors",
    "changed_sensors",
    "frames_of",
    "make_sensors",
    "run_twin",
    "settings_for",
    "twin_episode",
    "write_video",
]
