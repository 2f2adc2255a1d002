"""The page's traced functions, translated to WebAssembly.

They share one memory with named areas. The host writes `numbers` and what the visitor asks for, calls a
function, and reads its outputs:

- `draw`: a start, from two random `words`; `accepted` says whether an episode may start there
- `look`: what other numbers mean: whether the robot is `touching` something, `largest` l_max (m), the
  obstacles as they are `drifting` at the new speed, and which clearance tables `serve`
- `begin SHIELD`: the shield's memory at the start of an episode
- `ask`: what policy and pursuers ask for, the `held` nominal velocity and `wheels`
- `step SHIELD`: one control period with these. World and shield's memory are those of the next one
  afterwards.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sidestep._arrays import real
from sidestep.bridges.export.program import kind_of
from sidestep.bridges.export.wasm_code import Area, WasmLibrary
from sidestep.pursuit import CaptureGame
from sidestep.safety import Shield, make_shield
from sidestep.safety.clearance import ClearanceTable, shipped_tables
from sidestep.safety.shields.by_table import TableShield
from sidestep.safety.shields.catalogue import SHIELDS
from sidestep.views.play.program import commands, layouts, one_period
from sidestep.views.play.rules import is_touching
from sidestep.views.play.sliders import SLIDERS, drifts_at, with_numbers
from sidestep.world import Scenario, World

_NEXT = {"target": "next_target", "obstacles": "turned"}
"""Parts of the world that go on with another output than that of their own name."""


class Traced(NamedTuple):
    """A function of the engine as JAX has it: arrays in, a tuple of arrays out, by names of areas."""

    function: Callable[..., Any]
    inputs: list[str]
    outputs: list[str]


@dataclass(frozen=True)
class Engine:
    """A WebAssembly module, the areas of its memory by name, the clearance tables in it, and its functions as
    they were before."""

    binary: bytes
    areas: dict[str, Area]
    tables: list[ClearanceTable]
    functions: dict[str, Traced]


def make_engine(scenario: Scenario, policy: Callable[..., Any]) -> Engine:
    """Translate the page of a scenario; `policy` from `as_policy`. Its sliders' numbers stay inputs.

    **Raises** `NotTranslatable` where the policy uses what cannot be translated.
    """
    return _Build(scenario, policy).engine()


def tables_for(scenario: Scenario) -> list[ClearanceTable]:
    """The shipped clearance tables that serve a scenario with some numbers of its sliders, the one to be
    preferred first. A table is for one pursuer and one obstacle."""
    if (scenario.pursuer_count, scenario.obstacle_count) != (1, 1):
        return []
    return [table for table in shipped_tables() if not table.game.refuses(with_numbers(scenario, _of(table)))]


def _of(table: ClearanceTable) -> dict[str, float]:
    """The sliders' numbers that a table was solved for."""
    names = {"pursuer_half_axle": "half_axle"}
    return {slider.name: getattr(table.game, names.get(slider.name, slider.name)) for slider in SLIDERS}


class _Build:
    """One engine under construction."""

    def __init__(self, scenario: Scenario, policy: Callable[..., Any]):
        self.scenario, self.policy = scenario, policy
        self.names = [slider.name for slider in SLIDERS]
        self.place, self.inputs, self.outputs = layouts(scenario)
        self.library = WasmLibrary()
        self.areas: dict[str, Area] = {}
        self.functions: dict[str, Traced] = {}
        for name, shape in {"numbers": (len(SLIDERS),), **self.inputs.shapes, **self.outputs.shapes}.items():
            self._area(name, "f", shape)
        self.example = np.zeros(len(SLIDERS), np.float32)
        self.start = self._world(jnp.zeros(self.place.shapes[name]) for name in self.place.shapes)

    def engine(self) -> Engine:
        """The engine with every function."""
        tables = tables_for(self.scenario)
        world = list(self.place.shapes)
        self._area("words", "i", (2,))
        self._area("accepted", "b", ())
        self._add("draw", self._draw, ["numbers", "words"], [*world, "accepted"])
        self._area("touching", "b", ())
        self._area("largest", "f", ())
        self._area("drifting", "f", self.place.shapes["obstacles"])
        self._area("serve", "b", (len(tables),))
        looked = ["touching", "largest", "drifting", "serve"]
        self._add("look", lambda *given: self._look(tables, *given), ["numbers", *world], looked)
        asked = [*world, "held", "ask", "strategy", "mode", "command", "count"]
        self._add("ask", lambda *given: self._ask(asked, *given), ["numbers", *asked], ["held", "wheels"])
        for name in SHIELDS:
            if name != "joint":
                self._add_shield(name, lambda changed, name=name: make_shield(name, changed))
        for number, table in enumerate(tables):
            self._add_shield(f"joint {number}", lambda changed, table=table: TableShield(changed, table))
        return Engine(self.library.binary(), self.areas, tables, self.functions)

    def _area(self, name: str, kind: str, shape: tuple[int, ...]) -> None:
        if name not in self.areas:
            self.areas[name] = self.library.area(kind, shape)

    def _add(self, name: str, function: Callable[..., Any], inputs: list[str], outputs: list[str]) -> None:
        self.functions[name] = Traced(function, inputs, outputs)
        areas = [[self.areas[one] for one in group] for group in (inputs, outputs)]
        self.library.add(name, function, *areas)

    def _world(self, parts: Any) -> World:
        return World(**dict(zip(self.place.shapes, map(real, parts), strict=True)))

    def _with(self, numbers: Array) -> Scenario:
        return with_numbers(self.scenario, dict(zip(self.names, numbers, strict=True)))

    # The functions as JAX has them

    def _draw(self, numbers: Array, words: Array) -> tuple[Any, ...]:
        world, accepted = self._with(numbers).draw(words.astype(jnp.uint32))
        return (*(getattr(world, name) for name in self.place.shapes), accepted)

    def _ask(self, names: list[str], numbers: Array, *values: Array) -> tuple[Any, ...]:
        given = dict(zip(names, values, strict=True))
        world = self._world(given[name] for name in self.place.shapes)
        return commands(self._with(numbers), self.policy, world, given)

    def _look(self, tables: list[ClearanceTable], numbers: Array, *place: Array) -> tuple[Any, ...]:
        changed, world = self._with(numbers), self._world(place)
        drifts = drifts_at(world.obstacles[:, 2:], numbers[self.names.index("obstacle_speed")])
        serve = [table.game.serves(changed) for table in tables]
        return (
            is_touching(changed, world),
            CaptureGame.of(changed).largest_capture_distance,
            jnp.concatenate([world.obstacles[:, :2], drifts], axis=1),
            jnp.stack(serve) if serve else jnp.zeros(0, bool),
        )

    def _add_shield(self, name: str, made: Callable[[Scenario], Shield]) -> None:
        # With traced numbers: those of the scenario itself may not be what a shield is made for.
        begun = jax.eval_shape(lambda numbers: made(self._with(numbers)).init(self.start), self.example)
        memory, structure = jax.tree.flatten_with_path(begun)
        kept = []
        for keys, leaf in memory:
            kept.append(f"{name}{re.sub(r'[^a-z_0-9]+', ' ', jax.tree_util.keystr(keys))}".strip())
            self._area(kept[-1], kind_of(leaf.dtype), leaf.shape)

        def begin(numbers: Array, *place: Array) -> tuple[Any, ...]:
            return tuple(jax.tree.leaves(made(self._with(numbers)).init(self._world(place))))

        reads = [*self.place.shapes, "renew", "draws", "held", "wheels"]

        def step(numbers: Array, *values: Array) -> tuple[Any, ...]:
            changed, given = self._with(numbers), dict(zip(reads, values[: len(reads)], strict=True))
            world = self._world(given[name] for name in self.place.shapes)
            before = jax.tree.unflatten(structure, values[len(reads) :])
            commanded = (given["held"], given["wheels"])
            found, after = one_period(changed, made(changed), world, commanded, given, before)
            parts = [found[_NEXT.get(name, name)] for name in writes]
            return (*map(real, parts), *jax.tree.leaves(after))

        unread = ("nominal", *_NEXT.values())
        writes = [name for name in self.outputs.shapes if name not in unread]
        self._add(f"begin {name}", begin, ["numbers", *self.place.shapes], kept)
        self._add(f"step {name}", step, ["numbers", *reads, *kept], [*writes, *kept])


def packed(areas: dict[str, Area]) -> dict[str, list[Any]]:
    """The areas as JSON: address (bytes), kind of number, shape."""
    return {name: [area.address, area.kind, list(area.shape)] for name, area in areas.items()}
