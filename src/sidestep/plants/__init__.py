"""Plants: one interface for the simulation, ground robots and a quadrotor in MuJoCo, and one host loop."""

from sidestep.plants.contacts import Contacts, Watch
from sidestep.plants.plant import Plant
from sidestep.plants.play import Robot, play
from sidestep.plants.record import PlantEpisode
from sidestep.plants.sensors import Measurement
from sidestep.plants.simulation import Simulation

__all__ = ["Contacts", "Measurement", "Plant", "PlantEpisode", "Robot", "Simulation", "Watch", "play"]
