"""How would it go on robots? The scenario in a physics simulator: motors, wheels, noise and delay."""

from sidestep.bridges.twin.contacts import Contacts, Watch
from sidestep.bridges.twin.episode import TwinEpisode, run_twin, settings_for, twin_episode
from sidestep.bridges.twin.library import TwinError
from sidestep.bridges.twin.options import PURSUER_SEES, TwinOptions, bounded_errors
from sidestep.bridges.twin.robots import BASES
from sidestep.bridges.twin.sensors import SENSORS, Measurement, Sensors, changed_sensors, make_sensors
from sidestep.bridges.twin.twin import Twin
from sidestep.bridges.twin.video import frames_of, write_video

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
