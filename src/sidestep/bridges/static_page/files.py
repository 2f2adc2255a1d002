"""The folder of the page: the live page's own files, its engine, and what answers in the server's place."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sidestep
from sidestep.bridges.export.wasm_code import IMPORTED
from sidestep.bridges.static_page.engine import Engine, packed
from sidestep.loop.policies import as_policy
from sidestep.loop.step import decision_steps_of
from sidestep.safety.certificate.situation import plain
from sidestep.safety.clearance import ClearanceTable
from sidestep.safety.filter.status import Status
from sidestep.store.files import OutputError, make_folder, write_bytes
from sidestep.store.outputs import try_outputs
from sidestep.views.play.control import STRATEGIES
from sidestep.views.play.greeting import greeting
from sidestep.views.play.rules import PATIENCE
from sidestep.views.play.server import STATIC, Hosting, check_hosting, endless
from sidestep.views.play.sliders import SLIDERS, numbers_of
from sidestep.views.play.verdict import verdict
from sidestep.world import Scenario

BROWSER = Path(__file__).with_name("browser")
_MARK = Path("static") / "page.json"
"""The file by which a folder is known as one of these."""
_FOR_EVER = (
    "By its clearance table alone, without the look-ahead of the installed package: about 1 of 100 test "
    "chases ended at the obstacle."
)
_FOR_A_WHILE = (
    "By its clearance table alone, which is for {seconds:.0f} s, without the look-ahead of the installed "
    "package: whoever keeps circling leads it into the obstacle."
)
_NO_TABLE = "Here joint goes by clearance tables alone, and there is none for these numbers."


@dataclass(frozen=True)
class Written:
    """What was written: the folder, the size of all files (bytes), and the shield that the page begins with:
    `game` in place of `joint` where no clearance table serves the scenario."""

    folder: Path
    size: int
    shield: str


def write_page(
    folder: str | Path, hosting: Hosting, *, progress: Callable[[str], None] | None = None
) -> Written:
    """Write the page of `hosting` as a folder that any web server can serve, below any path.

    A folder that holds such a page is written over. `progress(text)` is called before the long part.

    **Raises** `ValueError` for an unknown shield or pursuer and for custom robots, `NotTranslatable` (a
    `ValueError`) for a policy that cannot be translated, and `OutputError` for a folder that cannot be
    written or holds something else, all before anything is written.
    """
    folder = Path(folder)
    check_hosting(hosting)
    hosting.scenario.check_built_in("the page", "make a video instead, sidestep evaluate --video")
    try_outputs(folders=[folder])
    if folder.is_dir() and any(folder.iterdir()) and not (folder / _MARK).exists():
        raise OutputError(folder, f"{folder} holds other files; give a new folder for the page")
    if progress is not None:
        progress("Translating shields, physics and policy to WebAssembly, about half a minute ...")
    files = _files(hosting)
    make_folder(folder / "static")
    for name, content in files.items():
        write_bytes(folder / name, content)
    shield = json.loads(files["static/page.json"])["shield"]
    return Written(folder, sum(map(len, files.values())), shield)


def _files(hosting: Hosting) -> dict[str, bytes]:
    """Contents by name, the page itself last."""
    scenario = endless(hosting.scenario)
    policy = as_policy(hosting.policy, scenario)
    engine = Engine(scenario, policy)
    files = {f"static/{path.name}": path.read_bytes() for path in sorted(STATIC.iterdir())}
    page = files.pop("static/index.html")
    files |= {f"static/{path.name}": path.read_bytes() for path in sorted(BROWSER.iterdir())}
    about = _about(hosting, scenario, engine, decision_steps_of(policy))
    files["static/page.json"] = json.dumps(about, indent=1, allow_nan=False).encode()
    files["static/engine.bin"] = gzip.compress(engine.binary(), 9, mtime=0)
    return files | {"index.html": page}


def _about(hosting: Hosting, scenario: Scenario, engine: Engine, decision_steps: int) -> dict[str, Any]:
    """What the browser has to know."""
    numbers, period = numbers_of(scenario), plain(scenario.control_period)
    serves = any(not table.game.refuses(scenario) for table in engine.tables)
    return {
        "sidestep": sidestep.__version__,
        "hello": greeting(scenario, hosting.policy, formats=[]),
        "shield": "game" if hosting.shield == "joint" and not serves else hosting.shield,
        "pursuer": hosting.pursuer,
        "decision_steps": decision_steps,
        "patience": PATIENCE,
        "verdict": verdict(numbers, period, scenario.pursuer_count).to_dict(),
        "statuses": list(Status.NAMES),
        "strategies": list(STRATEGIES),
        "numbers": [slider.name for slider in SLIDERS],
        "tables": [{"words": _words(table, period)} for table in engine.tables],
        "no_table": _NO_TABLE,
        "imports": list(IMPORTED),
        "areas": packed(engine.areas),
    }


def _words(table: ClearanceTable, period: float) -> str:
    """What the page says of `joint` by this table."""
    return _FOR_EVER if table.periods is None else _FOR_A_WHILE.format(seconds=table.periods * period)
