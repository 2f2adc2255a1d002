"""Which velocity that keeps every row is closest to the nominal one? Exact in the plane, with a status."""

from sidestep.safety.filter.projection import Projection, project, tolerance
from sidestep.safety.filter.status import Status

__all__ = ["Projection", "Status", "project", "tolerance"]
