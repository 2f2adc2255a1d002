"""What can be promised against a pursuer, from where, and what would have to change?"""

from sidestep.safety.certificate.certificate import Certificate, certify

__all__ = ["Certificate", "certify"]
