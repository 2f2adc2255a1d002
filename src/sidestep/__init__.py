"""sidestep: safe reinforcement learning for a robot that is being pursued."""

__version__ = "0.1.0"
