"""MCAP logs with ROS 2 messages, from simulation, twin, node and robot."""

from sidestep.bridges.logs.episode import Log, load_log, save_log
from sidestep.bridges.logs.reader import Record, read_log
from sidestep.bridges.logs.writer import LogWriter

__all__ = ["Log", "LogWriter", "Record", "load_log", "read_log", "save_log"]
