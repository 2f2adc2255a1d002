"""Peers are optional: importing one that is not installed says how to install it."""

from __future__ import annotations

import importlib
from typing import Any

from sidestep._packages import TORCH, install, install_extra


class MissingPeer(Exception):
    """A package that a case needs is not installed."""


def peer(module: str) -> Any:
    """The module of a peer. **Raises** `MissingPeer` naming what to install."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingPeer(
            f"{module} needs {error.name}, which is not installed; in an environment of its own: "
            f"{install(TORCH)} && {install_extra('bench')}"
        ) from error
