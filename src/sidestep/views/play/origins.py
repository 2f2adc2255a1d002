"""Check that requests come from this server's page."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable, Mapping
from urllib.parse import urlsplit


def host_name(host: str | None) -> str | None:
    """The name or address in a `Host` header, without the port, in lower case; None if invalid."""
    if not host or any(character in host for character in "/@?#\\ "):
        return None
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def is_known_host(host: str | None, allowed: Iterable[str]) -> bool:
    """Whether a request was addressed to this machine by a trusted name: an address, `localhost`, this
    machine's name, or one of `allowed`. This protects against DNS rebinding, in which another site's name
    points to this machine."""
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
    """Whether a socket is opened by this server's page, or by a program that sends no origin."""
    origin = headers.get("origin")
    if origin is None:
        return True
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == headers.get("host", "").lower()
