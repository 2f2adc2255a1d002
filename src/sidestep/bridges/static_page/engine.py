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
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
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


@final
class Engine:
    """The functions of the page of a scenario: as JAX has them, and as a module. Sliders' numbers are inputs.

    **Arguments:** `scenario` with the counts and modes, `policy` from `as_policy`.

    **Attributes:** `areas` of the module's memory and `functions` by name, the clearance `tables` in it.
    """

    def __init__(self, scenario: Scenario, policy: Callable[..., Any]):
        self.scenario, self.policy = scenario, policy
        self.tables = tables_for(scenario)
        self.areas: dict[str, Area] = {}
        self.functions: dict[str, Traced] = {}
        self._library = WasmLibrary()
        self._names = [slider.name for slider in SLIDERS]
        self._place, self._inputs, self._outputs = layouts(scenario)
        shapes = {"numbers": (len(SLIDERS),), **self._inputs.shapes, **self._outputs.shapes}
        shapes |= {"largest": (), "drifting": self._place.shapes["obstacles"]}
        for name, shape in shapes.items():
            self._area(name, "f", shape)
        self._area("words", "i", (2,))
        for name, shape in {"accepted": (), "touching": (), "serve": (len(self.tables),)}.items():
            self._area(name, "b", shape)
        world = list(self._place.shapes)
        self.functions["draw"] = Traced(self._draw, ["numbers", "words"], [*world, "accepted"])
        looked = ["touching", "largest", "drifting", "serve"]
        self.functions["look"] = Traced(self._look, ["numbers", *world], looked)
        asked = [*world, "held", "ask", "strategy", "mode", "command", "count"]
        self.functions["ask"] = Traced(self._ask, ["numbers", *asked], ["held", "wheels"])
        for name in SHIELDS:
            if name != "joint":
                self._add_shield(name, lambda changed, name=name: make_shield(name, changed))
        for number, table in enumerate(self.tables):
            self._add_shield(f"joint {number}", lambda changed, table=table: TableShield(changed, table))

    def binary(self) -> bytes:
        """The module with every function, translated.

        **Raises** `NotTranslatable` where the policy uses what cannot be translated.
        """
        for name, (function, inputs, outputs) in self.functions.items():
            areas = [[self.areas[one] for one in group] for group in (inputs, outputs)]
            self._library.add(name, function, *areas)
        return self._library.binary()

    def _area(self, name: str, kind: str, shape: tuple[int, ...]) -> None:
        if name not in self.areas:
            self.areas[name] = self._library.area(kind, shape)

    def _world(self, parts: Any) -> World:
        return World(**dict(zip(self._place.shapes, map(real, parts), strict=True)))

    def _with(self, numbers: Array) -> Scenario:
        return with_numbers(self.scenario, dict(zip(self._names, numbers, strict=True)))

    # The functions as JAX has them

    def _draw(self, numbers: Array, words: Array) -> tuple[Any, ...]:
        world, accepted = self._with(numbers).draw(words.astype(jnp.uint32))
        return (*(getattr(world, name) for name in self._place.shapes), accepted)

    def _ask(self, *values: Array) -> tuple[Any, ...]:
        given = dict(zip(self.functions["ask"].inputs, values, strict=True))
        world = self._world(given[name] for name in self._place.shapes)
        return commands(self._with(given["numbers"]), self.policy, world, given)

    def _look(self, numbers: Array, *place: Array) -> tuple[Any, ...]:
        changed, world = self._with(numbers), self._world(place)
        drifts = drifts_at(world.obstacles[:, 2:], numbers[self._names.index("obstacle_speed")])
        serve = [table.game.serves(changed) for table in self.tables]
        return (
            is_touching(changed, world),
            CaptureGame.of(changed).largest_capture_distance,
            jnp.concatenate([world.obstacles[:, :2], drifts], axis=1),
            jnp.stack(serve) if serve else jnp.zeros(0, bool),
        )

    def _add_shield(self, name: str, made: Callable[[Scenario], Shield]) -> None:
        world, unread = list(self._place.shapes), ("nominal", *_NEXT.values())
        reads = [*world, "renew", "draws", "held", "wheels"]
        writes = [part for part in self._outputs.shapes if part not in unread]

        def start(numbers: Array, *place: Array) -> Any:
            return made(self._with(numbers)).init(self._world(place))

        def begin(*given: Array) -> tuple[Any, ...]:
            return tuple(jax.tree.leaves(start(*given)))

        def step(numbers: Array, *values: Array) -> tuple[Any, ...]:
            changed, given = self._with(numbers), dict(zip(reads, values[: len(reads)], strict=True))
            before = jax.tree.unflatten(structure, values[len(reads) :])
            commanded = (given["held"], given["wheels"])
            now = self._world(given[part] for part in world)
            found, after = one_period(changed, made(changed), now, commanded, given, before)
            parts = [found[_NEXT.get(part, part)] for part in writes]
            return (*map(real, parts), *jax.tree.leaves(after))

        shapes = [jax.ShapeDtypeStruct(self.areas[part].shape, jnp.float32) for part in ("numbers", *world)]
        memory, structure = jax.tree.flatten_with_path(jax.eval_shape(start, *shapes))
        kept = []
        for keys, leaf in memory:
            words = re.sub(r"[^a-z_0-9]+", " ", jax.tree_util.keystr(keys))
            kept.append(f"{name} {words.strip() or 'memory'}")
            self._area(kept[-1], kind_of(leaf.dtype), leaf.shape)
        self.functions[f"begin {name}"] = Traced(begin, ["numbers", *world], kept)
        self.functions[f"step {name}"] = Traced(step, ["numbers", *reads, *kept], [*writes, *kept])


def packed(areas: dict[str, Area]) -> dict[str, list[Any]]:
    """The areas as JSON: address (bytes), kind of number, shape."""
    return {name: [area.address, area.kind, list(area.shape)] for name, area in areas.items()}
