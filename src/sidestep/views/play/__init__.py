"""The live page: a person drives the pursuer and tries to catch the shielded robot.

Needs the extra `[play]`; nothing of it is imported before `serve` or `make_app` is called.
"""

from sidestep.views.play.limits import Limits
from sidestep.views.play.server import Hosting, make_app, serve

__all__ = ["Hosting", "Limits", "make_app", "serve"]
