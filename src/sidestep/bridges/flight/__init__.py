"""How would it go in the air? A quadrotor and its autopilot in a physics simulator, hunted by an aircraft."""

from sidestep.bridges.flight.airframe import Airframe
from sidestep.bridges.flight.autopilot import Attitude, Autopilot, Gains, Setpoint
from sidestep.bridges.flight.episode import FlightEpisode, Pilot, certificate_of, fly
from sidestep.bridges.flight.flight import Flight
from sidestep.bridges.flight.options import ROOM_SENSORS, FlightOptions, budget_of, errors_of
from sidestep.bridges.flight.video import frames_of, write_video

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
