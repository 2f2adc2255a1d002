"""The packages of an extra: imported when a bridge is used, named when they are not there."""

from __future__ import annotations

import importlib
from typing import Any


def needed(name: str, extra: str, what: str) -> Any:
    """The module `name`, which `what` (such as `logs need`) uses and the extra `extra` installs.

    **Raises** `ValueError` with the command to type when it cannot be imported.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ValueError(
            f"{what} the package '{name.partition('.')[0]}', which cannot be imported ({error}); "
            f"install it with: pip install 'sidestep[{extra}]'"
        ) from error
