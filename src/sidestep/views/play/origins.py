"""Which requests come from our own page, and not from someone else's?"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable, Mapping
from urllib.parse import urlsplit


def host_name(host: str | None) -> str | None:
    """The name or address in a `Host` header, without the port, in lower case; None if it is none."""
    if not host or any(character in host for character in "/@?#\\ "):
        return None
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def is_known_host(host: str | None, allowed: Iterable[str]) -> bool:
    """Whether a request was addressed to this machine under a name that can only mean it.

    An address, `localhost`, this machine's own name, or one that was `allowed`. A page of someone else who
    makes a name of theirs point here (DNS rebinding) would come with that name.
    """
    name = host_name(host)
    if name is None:
        return False
    if name == "localhost" or name == socket.gethostname().lower() or name in set(allowed):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_own_origin(headers: Mapping[str, str]) -> bool:
    """Whether a socket is opened by our own page, or by a program that is no browser and says no origin."""
    origin = headers.get("origin")
    if origin is None:
        return True
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == headers.get("host", "").lower()
