"""Runs a command in a network of its own that has a loopback and nothing else.

    python ros2/private_network.py COMMAND [ARGUMENT ...]

Middleware announces the machine's addresses to whoever listens; tests should not, and should not hear
others'. Where the system does not permit it, the command keeps to this machine by request only
(ROS_AUTOMATIC_DISCOVERY_RANGE), and this says so; in CI it fails instead. Linux only.
"""

import ctypes
import fcntl
import os
import socket
import struct
import sys

_NEW_USER, _NEW_NETWORK = 0x10000000, 0x40000000
_GET_FLAGS, _SET_FLAGS = 0x8913, 0x8914
_UP = 0x1
_REQUEST = "16sH14x"


def enter() -> None:
    """Move this process to a new network, as root of a new user space if need be.

    **Raises** `OSError` where the system does not permit it.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    user, group = os.getuid(), os.getgid()
    if libc.unshare(_NEW_NETWORK) != 0:
        if libc.unshare(_NEW_USER | _NEW_NETWORK) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        for name, text in (("setgroups", "deny"), ("uid_map", f"0 {user} 1"), ("gid_map", f"0 {group} 1")):
            with open(f"/proc/self/{name}", "w", encoding="ascii") as file:
                file.write(text)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as request:
        answer = fcntl.ioctl(request, _GET_FLAGS, struct.pack(_REQUEST, b"lo", 0))
        flags = struct.unpack(_REQUEST, answer)[1]
        fcntl.ioctl(request, _SET_FLAGS, struct.pack(_REQUEST, b"lo", flags | _UP))


def main(command: list[str]) -> int:
    """Run `command`; returns only if it cannot be run."""
    try:
        enter()
    except OSError as error:
        print(f"private_network: no network of one's own is permitted here ({error})", file=sys.stderr)
        if os.environ.get("CI"):
            print("private_network: CI needs one: run it as root, or permit user namespaces", file=sys.stderr)
            return 1
        print("private_network: going on with discovery restricted to this machine", file=sys.stderr)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.pop("ROS_STATIC_PEERS", None)
    # Shared memory knows no networks: two runs at a time keep apart by their domain.
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.execvp(command[0], command)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
