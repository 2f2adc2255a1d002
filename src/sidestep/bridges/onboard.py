"""The old name of `sidestep.robot`."""

from sidestep._moved import moved_module

__getattr__ = moved_module(__name__, "sidestep.robot")
