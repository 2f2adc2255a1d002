"""MkDocs hook: writes the page of `sidestep play --static` beside the pages, where play.md embeds it. With
NO_LIVE_PAGE set, as in `make check`, it does not: that takes half a minute, and the tests write the page."""

import functools
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from sidestep.bridges.static_page import write_page
from sidestep.learning import PRETRAINED_SCENARIO, load_policy
from sidestep.views.play import Hosting
from sidestep.world import load_scenario


@functools.cache
def _written() -> Path:
    """The page, once for all times that `mkdocs serve` builds."""
    folder = Path(tempfile.mkdtemp(prefix="sidestep-page-"))
    scenario = load_scenario("paper", observation=PRETRAINED_SCENARIO["observation"])
    write_page(folder, Hosting(scenario, load_policy("pretrained"), shield="none"))
    return folder


def on_post_build(config: Any) -> None:
    """Copy the page to `catch/` of the site."""
    if os.environ.get("NO_LIVE_PAGE"):
        return
    shutil.copytree(_written(), Path(config["site_dir"]) / "catch", dirs_exist_ok=True)
