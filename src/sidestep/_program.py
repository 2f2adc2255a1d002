"""The command lines in advice, so that they work when pasted."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path


def command(*words: object) -> str:
    """A `sidestep` command line for a POSIX shell: `command("report", "my run")`.

    **Arguments:** `words` after the program's name, which are quoted if necessary.
    """
    return " ".join([*program(), *(shlex.quote(str(word)) for word in words)])


def program() -> list[str]:
    """The quoted words that start `sidestep` in this process's shell and folder.

    The bare name if the PATH leads to this environment's script, else that script's path, else this Python
    with `-m sidestep`.
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
    # Compare paths and not files, because all environments link to one file.
    if found is not None and Path(found).parent.resolve() == running.parent.resolve():
        return "python"
    return shlex.quote(_seen_from_here(running))


def _seen_from_here(path: Path) -> str:
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, FileNotFoundError):
        return str(path)
