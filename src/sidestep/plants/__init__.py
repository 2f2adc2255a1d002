"""In which physics? One interface for the plain simulation, robots on the ground and in the air; one loop."""

from sidestep.plants.contacts import Contacts, Watch
from sidestep.plants.plant import Plant
from sidestep.plants.play import Robot, play
from sidestep.plants.record import PlantEpisode
from sidestep.plants.sensors import Measurement
from sidestep.plants.simulation import Simulation

__all__ = ["Contacts", "Measurement", "Plant", "PlantEpisode", "Robot", "Simulation", "Watch", "play"]
