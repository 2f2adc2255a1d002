"""The version of this package, below all rooms, so that they can write it down."""

__version__ = "0.1.0"
