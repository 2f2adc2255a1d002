"""What can be promised against a pursuer, from where, and what would have to change?"""

from sidestep.safety.certificate.certificate import Certificate
from sidestep.safety.certificate.guarantee import certify, start_margin

__all__ = ["Certificate", "certify", "start_margin"]
