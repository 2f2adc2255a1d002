"""How is this program called, from where the user is? For advice that works when it is pasted."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path


def command(*words: object) -> str:
    """A `sidestep` command line to paste into a POSIX shell: `command("report", "my run")`.

    **Arguments:** `words` what follows the program's name; each is quoted where a shell needs it.
    """
    return " ".join([*program(), *(shlex.quote(str(word)) for word in words)])


def program() -> list[str]:
    """The quoted words that start `sidestep` in the shell and folder this process was started from.

    The bare name where the PATH leads to this environment's script, else that script's path, else this
    Python with `-m sidestep`.
    """
    script = Path(sys.executable).parent / "sidestep"
    found = shutil.which("sidestep")
    if found is not None and os.path.realpath(found) == os.path.realpath(script):
        return ["sidestep"]
    if script.is_file():
        return [shlex.quote(_seen_from_here(script))]
    return [python(), "-m", "sidestep"]


def python() -> str:
    """The running Python, quoted for a POSIX shell: `python` where the PATH leads to it, else its path."""
    running = Path(sys.executable)
    found = shutil.which("python")
    # Not the files themselves: those of all environments are links to one.
    if found is not None and Path(found).parent.resolve() == running.parent.resolve():
        return "python"
    return shlex.quote(_seen_from_here(running))


def _seen_from_here(path: Path) -> str:
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, FileNotFoundError):
        return str(path)
