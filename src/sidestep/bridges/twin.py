"""The old name of `sidestep.plants.ground`."""

from sidestep._moved import moved_module

__getattr__ = moved_module(__name__, "sidestep.plants.ground")
