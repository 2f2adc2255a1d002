"""The live page: a visitor drives the pursuer and tries to capture the shielded robot.

Needs the extra `[play]`, which is imported only by `serve` and `make_app`.
"""

from sidestep.views.play.limits import Limits
from sidestep.views.play.server import Hosting, make_app, serve

__all__ = ["Hosting", "Limits", "make_app", "serve"]
