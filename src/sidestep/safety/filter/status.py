"""What a filter or shield says about its answer."""

from typing import Final


class Status:
    """Comparable with traced integers; the larger one wins where two apply.

    - `OK` the nominal action, unchanged: it keeps every row and the speed limit.
    - `CORRECTED` the closest action that does.
    - `INFEASIBLE` no action does; the answer violates least, leading rows first.
    - `INVALID` something that came in was not a finite number (or the speed limit was negative); the
      answer is finite and keeps what could be understood.
    """

    OK: Final = 0
    CORRECTED: Final = 1
    INFEASIBLE: Final = 2
    INVALID: Final = 3

    NAMES: Final = ("ok", "corrected", "infeasible", "invalid")
