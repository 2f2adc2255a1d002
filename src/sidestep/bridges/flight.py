"""The old name of `sidestep.plants.air`."""

from sidestep._moved import moved_module

__getattr__ = moved_module(__name__, "sidestep.plants.air")
