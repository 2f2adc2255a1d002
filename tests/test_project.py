"""The project around the code: can a stranger install, import and trust what the files say?"""

import ast
import importlib.util
import re
import subprocess
import sys
import tomllib
from datetime import date
from pathlib import Path

import pytest
import yaml
from packaging.specifiers import SpecifierSet
from packaging.version import Version

import sidestep
from sidestep.learning import make_options, options_to_dict
from sidestep.world import Scenario

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS = PROJECT["project"]["optional-dependencies"]


def text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def parts(requirement):
    """Name and version bounds of `name[extra]>=1,<2`."""
    name, bounds = re.fullmatch(r"([\w.-]+)(?:\[[\w,]+\])?(.*)", requirement).groups()
    return name.lower().replace("_", "-"), bounds


CORE, EVERYTHING = "requirements.lock", "requirements-dev.lock"
BUILD = [*PROJECT["build-system"]["requires"], *PROJECT["dependency-groups"]["build"]]


def pins(lock):
    return dict(re.findall(r"^([\w.-]+)==([\w.]+)", text(lock), re.MULTILINE))


@pytest.mark.parametrize("name", [CORE, EVERYTHING])
def test_lock_holds_no_address_and_a_hash_for_every_pin(name):
    lock = text(name)
    assert "://" not in lock
    assert not re.search(r"--(extra-)?index-url|--find-links", lock)
    entries = re.split(r"\n(?=[\w.-]+==)", lock.strip())
    assert len(entries) == len(pins(name))
    assert all("--hash=sha256:" in entry for entry in entries)
    assert not {"torch", "stable-baselines3"} & set(pins(name))


@pytest.mark.parametrize(
    "lock, declared",
    [
        (CORE, [*PROJECT["project"]["dependencies"], *EXTRAS["play"], *BUILD]),
        (
            EVERYTHING,
            [*PROJECT["project"]["dependencies"], *EXTRAS["dev"], *EXTRAS["docs"], *BUILD],
        ),
    ],
)
def test_lock_pins_every_declared_dependency_within_its_bounds(lock, declared):
    for requirement in declared:
        name, bounds = parts(requirement)
        assert name in pins(lock), f"run make lock: {name} is not pinned"
        assert pins(lock)[name] in SpecifierSet(bounds), f"run make lock: {name}"


def test_make_reproduce_and_make_test_agree_on_every_version_and_the_first_installs_no_test_package():
    core, everything = pins(CORE), pins(EVERYTHING)
    assert core.items() <= everything.items()
    assert not {"mujoco", "onnxruntime", "playwright", "pyarrow", "av", "pyright", "pytest"} & set(core)


def test_every_extra_is_in_the_environment_of_make_setup():
    for extra, requirements in EXTRAS.items():
        if extra != "bench":
            assert {parts(requirement)[0] for requirement in requirements} <= set(pins(EVERYTHING)), extra


def test_nothing_says_to_install_from_an_index_that_has_no_sidestep():
    """`pip install sidestep`, with or without an extra, finds nothing or somebody else's package."""
    words = re.compile(r"pip install (?:[^\n`]* )?['\"]?sidestep(?![\w./-])")
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\0")
    told = [name for name in listed if name and name != "CHANGELOG.md" and name != "tests/test_project.py"]
    for name in told:
        path = ROOT / name
        if path.suffix in {".md", ".py", ".xml", ".yaml", ".toml", ".html", ""} and path.is_file():
            assert not words.search(path.read_text(encoding="utf-8")), name


def test_every_dependency_has_a_lower_and_an_upper_bound():
    for requirement in [
        *PROJECT["project"]["dependencies"],
        *(entry for extra in EXTRAS.values() for entry in extra),
    ]:
        name, bounds = parts(requirement)
        assert ">=" in bounds, name
        assert "<" in bounds, name


def test_versions_agree():
    version = sidestep.__version__
    assert f"version: {version}\n" in text("CITATION.cff")
    assert f"dist/sidestep-{version}-py3-none-any.whl" in text("docs/start.md")
    assert f'version="{version}"' in text("ros2/sidestep_ros/setup.py")
    assert f"<version>{version}</version>" in text("ros2/sidestep_ros/package.xml")


def test_the_changelog_has_a_dated_section_per_version_and_a_short_line_per_change():
    log = text("CHANGELOG.md")
    sections = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (unreleased|\d{4}-\d{2}-\d{2})$", log, re.MULTILINE)
    assert len(sections) == len(re.findall(r"^## ", log, re.MULTILINE))
    versions, days = [Version(version) for version, _ in sections], [day for _, day in sections]
    assert versions == sorted(set(versions), reverse=True)
    assert "unreleased" not in days[1:]
    released = [day for day in days if day != "unreleased"]
    assert [str(date.fromisoformat(day)) for day in released] == sorted(released, reverse=True)
    assert sidestep.__version__ == str(versions[len(days) - len(released)])
    kinds = "|".join(("Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"))
    for line in log.partition("\n## ")[2].splitlines()[1:]:
        assert re.fullmatch(rf"|- .+\.|## .+|### (?:{kinds})|#### .+", line), line
        assert len(line) < 120, line


def test_the_hooks_and_make_check_run_the_same_programs_of_the_environment():
    hooks = yaml.safe_load(text(".pre-commit-config.yaml"))["repos"]
    assert [repo["repo"] for repo in hooks] == ["local"]  # from elsewhere they would be downloaded
    checks = text("Makefile").partition("\ncheck:")[2].partition("\n\n")[0]
    for hook in hooks[0]["hooks"]:
        program = re.match(r"\.venv/bin/(?:python -m )?([\w-]+)", hook["entry"])[1]
        assert program in checks or program == "pytest", hook["id"]


@pytest.mark.parametrize(
    "path", sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml")), ids=lambda path: path.stem
)
def test_issue_templates_are_forms(path):
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    if path.stem == "config":
        assert set(form) <= {"blank_issues_enabled", "contact_links"}
        return
    assert {"name", "description", "body"} <= set(form)
    names = [field["id"] for field in form["body"]]
    assert len(names) == len(set(names))
    for field in form["body"]:
        assert field["type"] in {"textarea", "input", "dropdown", "checkboxes"}
        assert field["attributes"]["label"]


def test_every_page_but_those_that_are_included_is_in_the_navigation():
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("[!_]*.md")}
    listed = re.findall(r"^ +- [^:]+: ([\w/]+\.md)$", text("mkdocs.yml"), re.MULTILINE)
    assert sorted(listed) == sorted(pages)


@pytest.mark.parametrize("module", ["sidestep", "sidestep.cli", "sidestep.trials"])
def test_import_needs_nothing_optional(module):
    optional = [
        "gymnasium",
        "stable_baselines3",
        "torch",
        "scipy",
        "qpsolvers",
        "clarabel",
        "mujoco",
        "onnx",
        "distributed",
        "pyarrow",
        "rclpy",
    ]
    code = (
        "import sys\n"
        f"sys.modules.update(dict.fromkeys({optional!r}))\n"  # None in sys.modules makes an import fail
        f"import {module}\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_every_public_name_can_be_imported():
    for name in sidestep.__all__:
        assert getattr(sidestep, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        sidestep.nothing  # noqa: B018


def test_only_the_shields_room_asks_what_kind_of_shield_it_has():
    """Everybody else asks the shield itself: a new one then needs no other change."""
    asked = []
    for path in (ROOT / "src").rglob("*.py"):
        if path.parent.name == "shields":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            call = ast.unparse(node) if isinstance(node, ast.Call) else ""
            if call.startswith("isinstance(") and "Shield" in call:
                asked.append(f"{path.name}:{node.lineno}")
    assert asked == []


def test_docs_name_options_with_their_real_defaults():
    defaults = options_to_dict(make_options())
    row = re.compile(r"`(\w+)=([^`]+)` \(`?[^)]*\)")
    found = {}
    for line in text("docs/learning.md").splitlines():
        for name, value in row.findall(line) if line.startswith("|") else ():
            found[name] = ast.literal_eval(value)
    assert len(found) >= 7
    for name, value in found.items():
        actual = defaults[name] if name in defaults else getattr(Scenario(), name)
        assert actual == value, f"docs/learning.md says {name}={value!r}, it is {actual!r}"


def test_docs_name_scenario_constants_that_exist():
    table = text("docs/paper.md").partition("## What the paper does not print")[2].partition("\n## ")[0]
    named = re.findall(r"\(`(\w+)`\)", table)
    assert len(named) >= 5
    for name in named:
        assert hasattr(Scenario(), name)


# Examples of packages that the lock does not hold, and what to tell them so that they are soon done.
NEEDS = {
    "train_many_worlds.py": ("stable_baselines3", "stable-baselines3"),
    "train_with_sb3.py": ("stable_baselines3", "stable-baselines3"),
    "train_with_sbx.py": ("sbx", "sbx-rl"),
}
LONG = ("animate_chase.py", "car_pursuer.py")
BRIEFLY = ("--steps", "60", "--episodes", "1", "--shield", "none")


def test_the_gallery_shows_every_example():
    gallery = (ROOT / "docs" / "gallery.md").read_text()
    for path in (ROOT / "examples").iterdir():
        if path.suffix in (".py", ".toml"):
            assert f'--8<-- "examples/{path.name}"' in gallery, path.name


def masked(words):
    """Numbers differ from machine to machine, the words around them do not."""
    return re.sub(r"[-+]?\d+(?:\.\d+)?", "#", " ".join(words.split()))


def printed_in_the_gallery(example):
    """The block of output that the gallery shows below a script; None if it shows none."""
    after = text("docs/gallery.md").partition(f'--8<-- "examples/{example}"')[2].partition("\n## ")[0]
    block = re.search(r"^```text\n(.*?)^```$", after, re.MULTILINE | re.DOTALL)
    return block and block[1]


def test_every_code_block_of_the_pages_is_of_a_kind_that_runs_or_is_only_shown():
    """An indented block, or one without a language, would not be run and nobody would notice."""
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "ros2").rglob("*.md")]:
        inside, before = None, ""
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
            where = f"{page.relative_to(ROOT)}:{number}"
            fence = re.match(r"( *)(```+|~~~+)(.*)", line)
            if inside is not None:
                if fence and fence[2] == inside and not fence[3]:
                    inside = None
            elif fence:
                assert fence[3] in {"c", "python", "sh", "text", "toml", "yaml"}, where
                inside = fence[2]
            else:
                assert before or not line.startswith("    "), f"{where}: fence it"
            before = line.strip()


def test_blocks_that_are_left_out_are_on_the_pages(request):
    """A line of the list that no block begins with any more would hide the next block that does."""
    root = next(
        plugin
        for plugin in request.config.pluginmanager.get_plugins()
        if getattr(plugin, "__file__", None) == str(ROOT / "conftest.py")
    )
    for page, beginning in root.LEFT_OUT:
        assert re.search(rf"^```(sh|python)\n{re.escape(beginning)}", text(page), re.MULTILINE), beginning


@pytest.mark.parametrize(
    "example",
    [
        pytest.param(path.name, marks=[pytest.mark.slow] if path.name in LONG else [])
        for path in sorted((ROOT / "examples").glob("*.py"))
    ],
)
def test_examples_run(example):
    module, package = NEEDS.get(example, ("sidestep", ""))
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"needs: pip install torch==2.13.0 && pip install {package}")
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / example), *(BRIEFLY if package else ())],
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout
    shown = printed_in_the_gallery(example)
    if shown is not None:
        warnings = re.findall(r"\w+Warning: .*", done.stderr)
        assert masked(shown) == masked("\n".join([done.stdout, *warnings]))
