"""Read a campaign file and lay out its jobs. Everything is checked before anything runs."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from sidestep._bounds import did_you_mean
from sidestep.learning import PRETRAINED, load_policy, make_options, options_to_dict, policy_file
from sidestep.loop.policies import GOAL_SEEKING
from sidestep.pursuit import make_pursuer
from sidestep.safety import make_shield
from sidestep.store.files import json_safe
from sidestep.trials.campaign.jobs import AXES, KINDS, Job, digest_of_file, figure_names
from sidestep.world import Scenario, load_scenario, scenario_to_dict

_TABLES = ("name", "kind", "grid", "settings", "scenarios", "learners", "compare")
_KIND_AXES = {
    "evaluate": ("scenario", "shield", "pursuer", "policy", "seed"),
    "train": ("scenario", "shield", "pursuer", "learner", "seed"),
}
_DEFAULT_AXES: dict[str, Any] = {
    "scenario": "paper", "shield": "joint", "pursuer": "nash", "policy": GOAL_SEEKING, "learner": "default",
    "seed": 0,
}  # fmt: skip
_SETTINGS: dict[str, dict[str, int]] = {
    "evaluate": {"episodes": 100, "batch": 128},
    "train": {"episodes": 200, "evaluation_episodes": 1000, "batch": 256},
}
_COMPARE = ("by", "figures", "lower_is_better")
_MOST_JOBS = 1_000_000


class CampaignError(ValueError):
    """A campaign file that cannot be run: the message names the file, the key and what is allowed."""


@dataclass(frozen=True)
class CompareSettings:
    """What to compare: groups of jobs that share the labels `by`, in each of `figures`.

    For the figures in `lower_is_better`, a lower value is an improvement.
    """

    by: tuple[str, ...]
    figures: tuple[str, ...]
    lower_is_better: tuple[str, ...] = ()


@dataclass(frozen=True)
class Campaign:
    """The distinct jobs of a campaign, in the order of the grid; `text` is the content of its file."""

    name: str
    kind: str
    jobs: tuple[Job, ...]
    compare: CompareSettings | None = None
    text: str = ""


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign file, check its values, and lay out its grid.

    Paths in it are relative to its folder.

    **Raises** `CampaignError` (a `ValueError`) naming the file, the key, its value and what is allowed.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        content = tomllib.loads(text)
    except FileNotFoundError:
        raise CampaignError(f"there is no campaign file {path}") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise CampaignError(f"campaign file {path} cannot be read: {error}") from None
    return _Reader(path, content).campaign(text)


class _Reader:
    """Reads one file; error messages name the file and the key."""

    def __init__(self, path: Path, content: dict[str, Any]):
        self.path, self.content = path, content

    def fail(self, key: str, message: str) -> NoReturn:
        raise CampaignError(f"campaign file {self.path}: '{key}' {message}")

    def campaign(self, text: str) -> Campaign:
        self.known("", self.content, _TABLES)
        kind = self.content.get("kind", "evaluate")
        if kind not in KINDS:
            self.fail("kind", f"= {kind!r}: it must be one of {', '.join(map(repr, KINDS))}")
        name = self.content.get("name", self.path.stem)
        if not isinstance(name, str) or not name:
            self.fail("name", f"= {name!r}: it must be text")
        jobs = self.jobs(kind)
        return Campaign(name, kind, tuple(jobs), self.compare(kind), text)

    def known(self, where: str, table: Mapping[str, Any], names: Iterable[str]) -> None:
        names = list(names)
        for name in table:
            if name not in names:
                hint = did_you_mean(name, names)
                key = f"{where}.{name}" if where else name
                self.fail(key, f"is unknown{hint} Known here: {', '.join(names)}.")

    def table(self, name: str) -> dict[str, Any]:
        table = self.content.get(name, {})
        if not isinstance(table, dict):
            self.fail(name, f"= {table!r}: it must be a table, [{name}]")
        return table

    def jobs(self, kind: str) -> list[Job]:
        settings = self.settings(kind)
        axes = self.axes(kind)
        choices = {name: self.choices(name, values) for name, values in axes.items()}
        if "policy" in choices:
            self.check_policies(choices)
        jobs: list[Job] = []
        seen: dict[str, dict[str, Any]] = {}
        for combination in itertools.product(*axes.values()):
            labels = dict(zip(axes, combination, strict=True))
            decided = {name: choices[name][label] for name, label in labels.items()}
            file = None
            if "policy" in decided:
                decided["policy"], file = decided["policy"]
            job = Job(labels, {"kind": kind, **decided, **settings}, file)
            if job.id in seen:
                self.fail("grid", f"asks for the same job twice, as {seen[job.id]} and as {labels}")
            seen[job.id] = labels
            jobs.append(job)
        return jobs

    def settings(self, kind: str) -> dict[str, int]:
        table, defaults = self.table("settings"), _SETTINGS[kind]
        self.known("settings", table, defaults)
        for name, value in table.items():
            self.whole(f"settings.{name}", value, 1)
        settings = {**defaults, **table}
        if kind == "evaluate":
            # Slots beyond the number of episodes would be stepped in vain.
            settings["batch"] = min(settings["batch"], settings["episodes"])
        return settings

    def whole(self, key: str, value: Any, least: int) -> None:
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            self.fail(key, f"= {value!r}: it must be a whole number of at least {least}")

    def axes(self, kind: str) -> dict[str, list[Any]]:
        """The distinct labels of each axis, in order."""
        grid = self.table("grid")
        self.known("grid", grid, _KIND_AXES[kind])
        axes: dict[str, list[Any]] = {}
        for name in (axis for axis in AXES if axis in _KIND_AXES[kind]):
            value = grid.get(name, _DEFAULT_AXES[name])
            values: list[Any] = value if isinstance(value, list) else [value]
            if name == "seed":
                values = self.seeds(value)
            if not values:
                self.fail(f"grid.{name}", "is empty: a grid without a value has no jobs")
            for label in values:
                if name != "seed" and not isinstance(label, str):
                    self.fail(f"grid.{name}", f"holds {label!r}: names are needed, as text")
            if len(set(values)) < len(values):
                twice = next(label for label in values if values.count(label) > 1)
                self.fail(f"grid.{name}", f"holds {twice!r} twice; each value may occur once")
            axes[name] = values
        count = 1
        for values in axes.values():
            count *= len(values)
        if count > _MOST_JOBS:
            self.fail("grid", f"has {count:,} jobs; at most {_MOST_JOBS:,} are laid out at once")
        return axes

    def seeds(self, value: Any) -> list[int]:
        """`3`, `[0, 1, 2]` or `{ first = 0, count = 3 }`."""
        if isinstance(value, dict):
            self.known("grid.seed", value, ("first", "count"))
            if "count" not in value:
                self.fail("grid.seed", "needs a count, as in { first = 0, count = 20 }")
            first, count = value.get("first", 0), value["count"]
            self.whole("grid.seed.first", first, 0)
            self.whole("grid.seed.count", count, 1)
            if count > _MOST_JOBS:
                self.fail("grid.seed.count", f"= {count}: at most {_MOST_JOBS:,} jobs are laid out at once")
            seeds = list(range(first, first + count))
        else:
            seeds = value if isinstance(value, list) else [value]
        for seed in seeds:
            self.whole("grid.seed", seed, 0)
            if seed >= 2**31:
                self.fail("grid.seed", f"holds {seed}: seeds must be less than 2^31")
        return seeds

    def choices(self, axis: str, labels: list[Any]) -> dict[Any, Any]:
        """The value of each label, checked."""
        if axis == "seed":
            return {seed: seed for seed in labels}
        read = {
            "scenario": self.scenario, "shield": self.shield, "pursuer": self.pursuer,
            "policy": self.policy, "learner": self.learner,
        }[axis]  # fmt: skip
        for table, of in (("scenarios", "scenario"), ("learners", "learner")):
            if of == axis:
                for unused in set(self.table(table)) - set(labels):
                    self.fail(f"{table}.{unused}", f"is described, but grid.{axis} does not name it")
        choices = {}
        for label in labels:
            try:
                choices[label] = read(label)
            except CampaignError:
                raise
            except (ValueError, OSError) as error:
                self.fail(f"grid.{axis}", f"names '{label}': {error}")
        return choices

    def scenario(self, label: str) -> dict[str, Any]:
        """All fields of the scenario, so that the job's settings do not depend on the name."""
        described = self.table("scenarios")
        if label in described:
            if not isinstance(described[label], dict):
                self.fail(f"scenarios.{label}", "must be a table of scenario fields")
            values = dict(described[label])
            scenario = load_scenario(self.named_file(values.pop("preset", "paper")), **values)
        else:
            scenario = load_scenario(self.named_file(label))
        fields = json_safe(scenario_to_dict(scenario))
        return {name: value for name, value in fields.items() if value is not None and name != "name"}

    def named_file(self, name: str) -> str:
        """`name`, or the path of the file it names, relative to the campaign file's folder."""
        file = self.path.parent / name
        return str(file) if file.is_file() else name

    def shield(self, label: str) -> str:
        make_shield(label, Scenario())
        return label

    def pursuer(self, label: str) -> str:
        make_pursuer(label)
        return label

    def learner(self, label: str) -> dict[str, Any]:
        described = self.table("learners")
        if label not in described and label != _DEFAULT_AXES["learner"]:
            raise ValueError(f"there is no table [learners.{label}]")
        return json_safe(options_to_dict(make_options(**described.get(label, {}))))

    def policy(self, label: str) -> tuple[str, str | None]:
        """The policy's identity and its file."""
        if label == GOAL_SEEKING:
            return label, None
        run = label if label == PRETRAINED else (self.path.parent / label).absolute()
        load_policy(run)
        file = policy_file(run)
        return digest_of_file(file), str(file)

    def check_policies(self, choices: Mapping[str, Mapping[Any, Any]]) -> None:
        """Fail unless each policy's observation size matches each scenario."""
        from sidestep.loop.policies import as_policy

        for policy, (_, file) in choices["policy"].items():
            if file is None:
                continue
            for label, fields in choices["scenario"].items():
                try:
                    as_policy(load_policy(file), load_scenario("paper", **fields))
                except ValueError as error:
                    self.fail(
                        "grid.policy", f"names '{policy}', which does not fit scenario '{label}': {error}"
                    )

    def compare(self, kind: str) -> CompareSettings | None:
        table = self.table("compare")
        if not table:
            return None
        self.known("compare", table, _COMPARE)
        for name, value in table.items():
            if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
                self.fail(f"compare.{name}", f"= {value!r}: it must be a list of names")
        for name in ("by", "figures"):
            if not table.get(name):
                self.fail(f"compare.{name}", "is needed, with at least one name")
        allowed = [axis for axis in _KIND_AXES[kind] if axis != "seed"]
        for name in table["by"]:
            if name not in allowed:
                self.fail("compare.by", f"holds '{name}': it must be one of {', '.join(allowed)}")
        for name in table["figures"]:
            self.known("compare.figures", {name: None}, figure_names(kind))
        for name in table.get("lower_is_better", []):
            if name not in table["figures"]:
                self.fail("compare.lower_is_better", f"holds '{name}', which compare.figures does not")
        return CompareSettings(*(tuple(table.get(name, ())) for name in _COMPARE))
