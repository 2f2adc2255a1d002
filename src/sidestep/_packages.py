"""Missing packages of an extra, and the command that installs them.

`sidestep` is not on a public index, so `sidestep[extra]` cannot be installed by name. The advice names the
source from which this `sidestep` was installed, and the Python that runs it.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import shlex
import shutil
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from sidestep import _program

TORCH = "torch==2.13.0"
"""Must be installed first, in this exact version, see benchmarks/README.md."""


def needed(name: str, extra: str, what: str, error: type[Exception] = ValueError) -> Any:
    """The module `name`, which `what` (such as `logs need`) uses and the extra `extra` installs.

    **Raises** `error` with the command to type when it cannot be imported.
    """
    try:
        return importlib.import_module(name)
    except ImportError as missing:
        raise error(
            f"{what} the package '{name.partition('.')[0]}', which cannot be imported ({missing}); "
            f"install it with: {install_extra(extra)}"
        ) from missing


def install_extra(extra: str) -> str:
    """A line for a POSIX shell that installs the extra `extra` into this environment.

    It uses the clone, folder, wheel file or address from which `sidestep` was installed. If that is gone or
    not recorded, it names the packages of the extra, which are on the public index.
    """
    source = _source(extra)
    return install(*source) if source else install(*_packages_of(extra))


def install(*requirements: str) -> str:
    """A line for a POSIX shell that installs the requirements into this environment.

    With pip, else with uv (an environment made by uv has no pip), else with pip after ensurepip.
    """
    python = _program.python()
    words = " ".join(shlex.quote(word) for word in requirements)
    if importlib.util.find_spec("pip") is not None:
        return f"{python} -m pip install {words}"
    if shutil.which("uv") is not None:
        return f"uv pip install --python {python} {words}"
    return f"{python} -m ensurepip && {python} -m pip install {words}"


def _source(extra: str) -> list[str]:
    """pip's arguments that install this `sidestep` with the extra; empty if unknown."""
    try:
        text = importlib.metadata.distribution("sidestep").read_text("direct_url.json")
    except importlib.metadata.PackageNotFoundError:
        # Not installed: run from a clone by PYTHONPATH.
        clone = Path(__file__).absolute().parents[2]
        return ["-e", f"{clone}[{extra}]"] if (clone / "pyproject.toml").is_file() else []
    origin = json.loads(text) if text else {}
    url = origin.get("url", "")
    if not url.startswith("file:"):
        vcs = origin.get("vcs_info")
        if vcs:
            return [f"sidestep[{extra}] @ {vcs['vcs']}+{url}@{vcs['commit_id']}"]
        return [f"sidestep[{extra}] @ {url}"] if url else []
    path = Path(unquote(urlsplit(url).path))
    if not path.exists():
        return []
    editable = origin.get("dir_info", {}).get("editable", False)
    return [*(["-e"] if editable else []), f"{path}[{extra}]"]


def _packages_of(extra: str) -> list[str]:
    try:
        lines = importlib.metadata.requires("sidestep") or []
    except importlib.metadata.PackageNotFoundError:
        lines = []
    # As hatchling and every other backend writes it: name>=1,<2; extra == 'gym'
    parts = [line.partition(";") for line in lines]
    found = [
        spec.strip() for spec, _, marker in parts if marker.strip().replace('"', "'") == f"extra == '{extra}'"
    ]
    return found or [f"sidestep[{extra}]"]
