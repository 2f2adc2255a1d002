"""A quadrotor with its autopilot in MuJoCo, pursued by an aircraft."""

from sidestep.plants.air.airframe import Airframe
from sidestep.plants.air.autopilot import Attitude, Autopilot, Gains, Setpoint
from sidestep.plants.air.episode import FlightEpisode, Pilot, certificate_of, fly
from sidestep.plants.air.flight import Flight
from sidestep.plants.air.options import ROOM_SENSORS, FlightOptions, budget_of, errors_of
from sidestep.plants.video import frames_of, write_video

__all__ = [
    "ROOM_SENSORS",
    "Airframe",
    "Attitude",
    "Autopilot",
    "Flight",
    "FlightEpisode",
    "FlightOptions",
    "Gains",
    "Pilot",
    "Setpoint",
    "budget_of",
    "certificate_of",
    "errors_of",
    "fly",
    "frames_of",
    "write_video",
]
