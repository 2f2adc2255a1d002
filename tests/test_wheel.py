"""The wheel outside the clone: with each extra, in a fresh environment, as whoever is sent the file has it.

Each extra is first left out: the error must name a line that, when pasted, installs what is missing.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
import urllib.request
from pathlib import Path

import pytest

pytestmark = pytest.mark.wheel
ROOT = Path(__file__).parents[1]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
NOT_FOR_USERS = {"dev", "docs", "bench"}
"""Of the clone: `make test`, `make docs` and `make bench` use them."""

BRIEF = "--shield none --episodes 1"
COMMANDS = {
    "clearance": "python table.py",
    "cluster": "sidestep campaign grid.toml --workers 1 --out grid",
    "export": "sidestep export run --out robot.onnx",
    "gym": "python step.py",
    "logs": f"sidestep evaluate goal-seeking {BRIEF} --log chase.mcap",
    "play": "sidestep play --shield none --port 0",
    "twin": "sidestep twin --shield none --steps 3",
    "video": f"sidestep evaluate goal-seeking {BRIEF} --video chase.mp4 --video-width 160 --video-rate 2",
}
"""The smallest real command of each extra."""
FILES = {
    "grid.toml": 'kind = "evaluate"\n[grid]\nseed = [0]\nshield = ["none"]\n[settings]\nepisodes = 1\n',
    "table.py": (
        "import sidestep\n"
        "from sidestep.safety.clearance import ClearanceGame, Resolution, clearance_table\n"
        "game = ClearanceGame.of(sidestep.load_scenario('paper', capture_distance=0.1))\n"
        "few = Resolution(height=0.01, growth=1.5, share=0.1, bearings=4, angles=32, headings=12, turns=2)\n"
        "print(clearance_table(game, few, periods=5).farthest)\n"
    ),
    "step.py": (
        "import sidestep.bridges.gym\n"
        "import gymnasium\n"
        "env = gymnasium.make('sidestep/Pursued-v0', shield='none')\n"
        "env.reset(seed=0)\n"
        "print(env.step(env.action_space.sample())[1])\n"
    ),
}


class Place:
    """An environment outside the clone, made by uv: hard links to its cache, so in a second."""

    def __init__(self, folder, wheel, cache, pip):
        self.folder = folder / "a place"
        self.folder.mkdir()
        for name, text in FILES.items():
            (self.folder / name).write_text(text)
        tools = folder / "tools"
        tools.mkdir()
        uv = shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
        assert uv is not None
        (tools / "uv").symlink_to(uv)
        pins = folder / "pins.txt"
        lines = re.findall(r"^[\w.-]+==[^\\\n]+", (ROOT / "requirements-dev.lock").read_text(), re.MULTILINE)
        pins.write_text("\n".join(lines))
        kept = {
            key: value
            for key, value in os.environ.items()
            if not key.startswith(("PYTEST", "PYTHON", "VIRTUAL_ENV"))
        }
        self.environment = kept | {
            "PATH": f"{folder / 'env/bin'}{os.pathsep}{tools}{os.pathsep}/usr/bin{os.pathsep}/bin",
            "UV_CONSTRAINT": str(pins), "PIP_CONSTRAINT": str(pins), "UV_LINK_MODE": "hardlink",
            "SIDESTEP_CACHE": str(cache), "PYTHONUNBUFFERED": "1",
        }  # fmt: skip
        self.ok(f"uv venv --quiet --python {sys.executable} '{folder / 'env'}'")
        self.ok(f"uv pip install --quiet --python '{folder / 'env'}' '{wheel}' {'pip' if pip else ''}")

    def run(self, line):
        return subprocess.run(
            ["sh", "-c", line],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=900,
        )

    def ok(self, line):
        done = self.run(line)
        assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
        return done.stdout

    def serves(self, line):
        """Starts the live page, asks for it, ends it as Ctrl-C does."""
        process = subprocess.Popen(
            ["sh", "-c", f"exec {line}"], cwd=self.folder, env=self.environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        told = ""
        try:
            while not (found := re.search(r"http://[\w.:]+/", told)):
                line = process.stdout.readline()
                assert line, told
                told += line
            with urllib.request.urlopen(found[0], timeout=60) as page:
                assert b"<title>" in page.read()
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)


@pytest.fixture(scope="session")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("a wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=ROOT, check=True, capture_output=True,
    )  # fmt: skip
    return next(folder.glob("*.whl"))


@pytest.fixture
def place(tmp_path, wheel, tmp_path_factory):
    return lambda pip=False: Place(tmp_path, wheel, tmp_path_factory.getbasetemp() / "compiled", pip)


def test_every_extra_for_users_has_a_command():
    assert set(COMMANDS) == set(EXTRAS) - NOT_FOR_USERS


@pytest.mark.parametrize("extra", sorted(COMMANDS))
def test_an_extra_that_is_missing_is_installed_by_the_line_that_the_error_names(extra, place):
    here = place(pip=extra == "logs")
    if extra == "export":
        here.ok(f"sidestep train --out run {BRIEF}")
    missing = here.run(COMMANDS[extra])
    assert missing.returncode != 0
    advice = re.search(r"install it with: (.+)", missing.stdout + missing.stderr)
    assert advice, missing.stdout + missing.stderr
    assert advice[1].startswith("python -m pip install " if extra == "logs" else "uv pip install --python ")
    assert f".whl[{extra}]" in advice[1]
    here.ok(advice[1])
    if extra == "play":
        here.serves(COMMANDS[extra])
    else:
        here.ok(COMMANDS[extra])


def test_the_wheel_alone_trains_and_says_how_it_went(place):
    here = place()
    here.ok(f"sidestep train --out 'my run' {BRIEF} && sidestep report 'my run' --episodes 1")
    assert (here.folder / "my run/report.html").is_file()
