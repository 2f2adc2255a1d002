"""Code blocks of README and docs are tests: each runs as printed, in a folder that is like a reader's clone.

Python blocks of a page share their names, from top to bottom. Shell blocks are run by bash, in an environment
whose `sidestep` hands the words over to this process: here the real command runs, on fewer episodes. What
cannot be run is listed in `LEFT_OUT`, with the reason.
"""

import atexit
import contextlib
import gc
import io
import json
import os
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import sysconfig
import tempfile
import venv
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sybil import Document, Example, Region, Sybil
from sybil.evaluators.python import PythonEvaluator
from sybil.parsers.markdown.lexers import FencedCodeBlockLexer

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
# Most of the run is compilation, and tests compute little: so it takes a third of the time.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_llvm_disable_expensive_passes=true --xla_cpu_parallel_codegen_split_count=1",
)
# Compiling is mostly small allocations. glibc's malloc reads this when a worker or a child of one starts.
# What the Makefile preloads is better, but no sanitizer starts behind it.
os.environ.setdefault("GLIBC_TUNABLES", "glibc.malloc.tcache_count=65535")
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.pop("LD_PRELOAD", None)
# Tracing makes millions of objects that stay, and by default a fifth of the run looks for garbage in them.
gc.set_threshold(200_000, 20, 100)
# What one process compiles, the other test processes and their children load: this one starts them all.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="sidestep-tests-")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)

# What `runs` makes, for all test processes.
SHARED = "SIDESTEP_PAGES_SHARED"
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ[SHARED] = tempfile.mkdtemp(prefix="pages-")
    atexit.register(shutil.rmtree, os.environ[SHARED], ignore_errors=True)

ROOT = Path(__file__).parent

OTHER_MACHINES = "needs other machines: a scheduler, SSH hosts or a cluster"
PYTORCH = "needs PyTorch, which is in no lock"
ROS = "needs ROS 2; `make test-ros` runs the nodes"
INDEX = "installs from a package index; `make test-wheel` does the same with every extra"
LEFT_OUT = {
    ("docs/campaigns.md", "dask scheduler --host"): OTHER_MACHINES,
    ("docs/campaigns.md", "from distributed import SSHCluster"): OTHER_MACHINES,
    ("docs/campaigns.md", "from dask_jobqueue import"): OTHER_MACHINES,
    ("docs/campaigns.md", "from dask_kubernetes"): OTHER_MACHINES,
    ("docs/gymnasium.md", "python -m pip install torch"): PYTORCH,
    ("docs/gymnasium.md", "from stable_baselines3 import"): PYTORCH,
    ("docs/ros2.md", "colcon build"): ROS,
    ("docs/ros2.md", "make test-ros"): ROS,
    ("docs/ros2.md", ".venv/bin/python ros2/private_network.py"): ROS,
    ("docs/start.md", "make wheel"): INDEX,
    ("ros2/sidestep_ros/README.md", "python -m pip install -e"): ROS,
    ("ros2/sidestep_ros/README.md", "python -m sidestep_ros"): ROS,
}
"""(page, how the block begins): why it is not run."""

BRIEFLY = {
    "train": "--episodes 1",
    "evaluate": "--episodes 8",
    "reproduce": "--shields none --episodes 1 --evaluation-episodes 2",
    "twin": "--seeds 1 --steps 40",
    "fly": "--seeds 1 --steps 20",
    "campaign": "--dry-run",
    "report": "--episodes 4",
    "falsify": "--batch 16 --seconds 2",
    "export": "--states 500",
}
"""What is added to the words of a command, so that it is soon done; the last of two values counts."""

SMALL = ["--video-width", "320", "--video-rate", "2", "--video-speed", "5"]
SMALL_TWIN = ["--width", "320", "--rate", "5"]
"""Added where there is a `--video`."""

MAKES_ITS_OWN_RUNS = ("README.md", "docs/start.md", "docs/guides.md")


def python_block(example: Example) -> None:
    """Runs a block in the page's folder and names. Of a script that is included, only that it is tested."""
    included = re.fullmatch(r'--8<-- "(.+)"\n?', str(example.parsed))
    if included:
        # tests/test_project.py runs all of these.
        assert (ROOT / included[1]).parent == ROOT / "examples", included[1]
        assert (ROOT / included[1]).is_file(), included[1]
        return
    with warnings.catch_warnings(), contextlib.chdir(folder_of(example)):
        warnings.simplefilter("default")
        PythonEvaluator()(example)


def shell_block(example: Example) -> None:
    """Runs a block in bash; `sidestep` in it is answered by this process."""
    folder = folder_of(example)
    with tempfile.TemporaryDirectory(prefix="page") as near, socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"{near}/socket")
        listener.listen()
        with open(f"{near}/output", "w+") as output:
            shell = subprocess.Popen(
                ["bash", "-euo", "pipefail", "-c", str(example.parsed)],
                cwd=folder, env=environment(folder, f"{near}/socket"),
                stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True,
            )  # fmt: skip
            try:
                while shell.poll() is None:
                    if select.select([listener], [], [], 0.05)[0]:
                        answer(listener.accept()[0])
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(shell.pid, signal.SIGKILL)
                shell.wait()
            output.seek(0)
            assert shell.returncode == 0, output.read()[-4000:]


def environment(folder: Path, address: str) -> dict[str, str]:
    """The variables of a shell in which the page's environment is active."""
    ours = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST")}
    return ours | {
        # Once more in front: a page's pip writes the one in .venv/bin anew.
        "PATH": os.pathsep.join([str(folder / ".pages"), str(folder / ".venv/bin"), ours["PATH"]]),
        "VIRTUAL_ENV": str(folder / ".venv"),
        "SIDESTEP_OF_THE_PAGES": address,
        # `make test` would begin this very run again: one file of it will do.
        "PYTEST_ADDOPTS": "tests/test_program.py -p no:cacheprovider",
        # Everything is installed; pip finds that so without asking an index.
        "PIP_NO_INDEX": "1", "PIP_NO_BUILD_ISOLATION": "false",
    }  # fmt: skip


def answer(connection: socket.socket) -> None:
    """Runs the command that a page's `sidestep` was called with and sends back its status and output."""
    with connection, connection.makefile("rw") as stream:
        call = json.loads(stream.readline())
        text = io.StringIO()
        with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
            status = sidestep(call["words"], call["folder"])
        stream.write(json.dumps([status, text.getvalue()]))


def sidestep(words: list[str], folder: str | Path) -> int:
    """The real command, on fewer episodes and, where the page names no shield, without one."""
    from sidestep.cli import main

    added = BRIEFLY.get(words[0], "").split()
    if "--video" in words:
        added += SMALL_TWIN if words[0] in ("twin", "fly") else SMALL
    if words[0] in ("train", "evaluate", "twin", "fly", "play") and "--shield" not in words:
        added += ["--shield", "none"]
    if words[0] == "falsify" and "--replay" in words:
        # What a search finds depends on how long it searches: one counterexample stands for another.
        wanted = Path(folder, words[words.index("--replay") + 1])
        if not wanted.exists():
            wanted.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(runs() / "found.npz", wanted)
        added = []
    elif words[0] == "falsify":
        added += ["--minutes", "0.05"] if "--minutes" in words else ["--episodes", "16"]
        added += [] if "--attacks" in words else ["--attacks", "edge"]
    with contextlib.chdir(folder):
        if words[0] == "play":
            return play([*words, *added])
        try:
            status = main([*words, *added])
        except SystemExit as end:
            return int(end.code or 0)
        if words[0] == "reproduce" and status == 0:
            out = Path("runs/reproduce")
            for name in ("paper", "game", "joint"):
                shutil.copytree(out / "none", out / name)
        return status


def play(words: list[str]) -> int:
    """Serves the page until it has been asked for once, then ends it as Ctrl-C does; or writes it."""
    import urllib.request

    command = [sys.executable, "-m", "sidestep", *words]
    variables = os.environ | {"PYTHONPATH": str(ROOT / "src"), "PYTHONUNBUFFERED": "1"}
    if "--static" in words:
        return subprocess.run(command, env=variables, check=False).returncode
    with subprocess.Popen(
        [*command, "--port", "0"],
        env=variables,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    ) as serving:  # fmt: skip
        assert serving.stdout is not None
        told = ""
        for line in serving.stdout:
            told += line
            if found := re.search(r"http://[\w.:\[\]]+/", told):
                with urllib.request.urlopen(found[0], timeout=60) as page:
                    assert b"sidestep" in page.read()
                serving.send_signal(signal.SIGINT)
                break
        told += serving.stdout.read()
    print(told)
    return 0 if serving.returncode in (0, 130) else 1


def evaluator(example: Example) -> None:
    """Runs an example, unless it is listed as one that cannot be run."""
    page = Path(example.path).relative_to(ROOT).as_posix()
    for (other, beginning), reason in LEFT_OUT.items():
        if page == other and str(example.parsed).startswith(beginning):
            pytest.skip(reason)
    {"python": python_block, "sh": shell_block}[example.region.lexemes["language"]](example)


def blocks(document: Document) -> Iterator[Region]:
    """The blocks that run; tests/test_project.py sees to it that no other kind of code is on a page."""
    for region in FencedCodeBlockLexer("python|sh")(document):
        region.parsed, region.evaluator = region.lexemes["source"], evaluator
        yield region


def folder_of(example: Example) -> Path:
    """The page's folder: the clone, an environment, and the runs that the page takes to be there."""
    names = example.namespace
    if "_folder" not in names:
        names["_folder"] = Path(tempfile.mkdtemp(prefix="page-"))
        make_clone(names["_folder"])
        page = Path(example.path).relative_to(ROOT).as_posix()
        if page not in MAKES_ITS_OWN_RUNS and "runs/" in example.document.text:
            shutil.copytree(runs(), names["_folder"], dirs_exist_ok=True)
    return names["_folder"]


def leave(names: dict[str, Any]) -> None:
    """Removes the page's folder."""
    if "_folder" in names:
        shutil.rmtree(names["_folder"], ignore_errors=True)


def make_clone(folder: Path) -> None:
    """Copies the files and makes an environment that sees this one's packages."""
    unwanted = (".*", "runs", "site", "dist", "build", "images", "results", "__pycache__")
    shutil.copytree(ROOT, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns(*unwanted))
    home = folder / ".venv"
    venv.create(home, symlinks=True, with_pip=False)
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(home), "platbase": str(home)}))
    (packages / "pages.pth").write_text(f"{ROOT / 'src'}\n{sysconfig.get_path('purelib')}\n")
    text = (
        f"#!{sys.executable} -SE\n"
        "import json, os, socket, sys\n"
        "with socket.socket(socket.AF_UNIX) as line:\n"
        "    line.connect(os.environ['SIDESTEP_OF_THE_PAGES'])\n"
        "    with line.makefile('rw') as stream:\n"
        "        stream.write(json.dumps({'words': sys.argv[1:], 'folder': os.getcwd()}) + '\\n')\n"
        "        stream.flush()\n"
        "        status, text = json.loads(stream.read())\n"
        "print(text)\n"
        "sys.exit(status)\n"
    )
    (folder / ".pages").mkdir()
    for command in (home / "bin/sidestep", folder / ".pages/sidestep"):
        command.write_text(text)
        command.chmod(0o755)
    for stamp in (".ready", ".ready-dev"):
        (home / stamp).touch()


def runs() -> Path:
    """A folder with what the pages take to be there already, made once by the commands they name."""
    from filelock import FileLock

    shared = Path(os.environ[SHARED])
    folder = shared / "made"
    with FileLock(shared / "lock"):
        if not folder.exists():
            make_runs(shared / "unfinished")
            (shared / "unfinished").rename(folder)
    return folder


def make_runs(folder: Path) -> None:
    """Runs those commands; the whole of them, or a test fails."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for words in (
        "train --out runs/mine",
        "reproduce --out runs/reproduce",
    ):
        text = io.StringIO()
        with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
            assert sidestep(words.split(), folder) == 0, text.getvalue()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text), contextlib.chdir(folder):
        from sidestep.cli import main

        search = "falsify --shield none --attacks edge --episodes 16 --batch 16 --seconds 20 --out found"
        assert main(search.split()) == 0, text.getvalue()
    for name in ("first", "none", "game-seed-0", "game-seed-1"):
        shutil.copytree(folder / "runs/mine", folder / "runs" / name)
    found = sorted((folder / "found/counterexamples").glob("*.npz"))[0]
    found.rename(folder / "found.npz")
    worst = sorted((folder / "runs/reproduce/joint/worst").glob("*.npz"))[0]
    shutil.copy(worst, folder / "episode.npz")


pytest_collect_file = Sybil(
    parsers=[blocks],
    path=str(ROOT),
    patterns=["README.md", "docs/*.md", "docs/reference/*.md", "ros2/**/README.md"],
    teardown=leave,
).pytest()
