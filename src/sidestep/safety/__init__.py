"""What keeps the evader free: the exact filter, barriers and their rows, shields and their status."""

from sidestep.safety.filter import Projection, project, tolerance
from sidestep.safety.status import Status

__all__ = ["Projection", "Status", "project", "tolerance"]
