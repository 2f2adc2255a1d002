"""Export a policy, a shield or both as C for a microcontroller."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import jax
import numpy as np

import sidestep
from sidestep.bridges.export.c_code import HELPERS, TYPES, CBody, number, table
from sidestep.bridges.export.exported import Exported, Field
from sidestep.bridges.export.files import STATUS_WORDS, UNITS, check_looks_ahead, check_what, facts
from sidestep.bridges.export.parity import answers, random_states
from sidestep.bridges.export.program import KINDS, Node, Program, Tables
from sidestep.bridges.export.translate import translate
from sidestep.loop.step import decision_steps_of
from sidestep.safety import Shield
from sidestep.store.files import make_folder, write_bytes, write_json
from sidestep.world import Scenario, World, observe

FILES = (
    "sidestep.h", "sidestep.c", "check.c", "check.py", "states.bin", "CMakeLists.txt", "README.md",
    "about.json",
)  # fmt: skip
"""The files of an export."""
_MAGIC = 0x53494445


def _declaration(field: Field) -> str:
    """A member of a struct."""
    sizes = "".join(f"[{size}]" for size in field.shape)
    line = f"    {TYPES[field.kind]} {field.name}{sizes};"
    return f"{line:<32} /* {field.words} */" if field.words else line


class _Function(NamedTuple):
    """A function of the exported code: its head, what it does, and its body."""

    head: str
    words: str
    body: CBody


def export_c(
    path: str | Path,
    scenario: Scenario,
    policy: Callable[..., Any] | None,
    *,
    what: str = "policy+filter",
    shield: Shield,
    shield_name: str = "",
    run: str = "",
    states: int = 10_000,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write a folder of C99: the library, and `states` states with answers by which to check it.

    The functions are translated from the traced JAX program, number by number (see `translate`), for this
    scenario: its numbers become constants.

    **Returns** the content of `about.json`.

    **Raises** `ValueError` for an unknown `what`, a missing policy, files that exist, and `NotTranslatable`
    (a `ValueError`) where the shield or the policy uses what cannot be translated, before anything is
    written. **Raises** `OutputError` for a folder that cannot be written.
    """
    check_what(scenario, what, policy)
    if what != "policy":
        check_looks_ahead(shield, shield_name, "C")
    path = Path(path)
    there = [name for name in FILES if (path / name).exists()]
    if there and not overwrite:
        raise ValueError(
            f"{path / there[0]} exists already; give another folder, or --overwrite to replace it"
        )
    export = _Export(scenario, policy, shield, what)
    rows, open_count, inputs, outputs, loose = export.checked(states)
    about = facts(
        scenario,
        what,
        None if what == "policy" else shield_name,
        run=run,
        states={"count": states, "rounding decides": open_count},
        **({} if policy is None else {"decision_steps": decision_steps_of(policy)}),
    )
    fill = {
        "what": what, "version": sidestep.__version__, "robots": export.robots, "example": export.example,
        "kept": "" if what == "policy" else f" behind the shield `{shield_name}`",
        "adapter": export.adapter, "inputs": inputs, "outputs": outputs, "loose": loose,
        "states": f"{states:,}",
    }  # fmt: skip
    texts = {name: _template(name).substitute(fill) for name in ("check.c", "README.md")}
    texts |= {name: _template(name).template for name in ("check.py", "CMakeLists.txt")}
    texts |= {"sidestep.h": export.header, "sidestep.c": export.code}
    make_folder(path)
    for name, text in texts.items():
        write_bytes(path / name, text.encode())
    write_bytes(
        path / "states.bin", struct.pack("<5I", _MAGIC, states, inputs, outputs, loose) + rows.tobytes()
    )
    write_json(path / "about.json", about)
    return about


def _template(name: str) -> Template:
    return Template((files("sidestep.bridges.export") / "templates" / name).read_text())


class _Export(Exported):
    """What is translated, and the texts made of it."""

    def __init__(self, scenario: Scenario, policy: Callable[..., Any] | None, shield: Shield, what: str):
        super().__init__(scenario, policy, shield, what)
        self.tables = Tables()
        self.functions: list[_Function] = []
        if what != "policy":
            self._add_shield()
        if policy is not None and what != "filter":
            self._add_policy()
        read = set().union(*(function.body.given for function in self.functions))
        self.used = [field for field in self.fields if read & set(field.entries("world->"))]

    @property
    def robots(self) -> str:
        m, k = self.scenario.pursuer_count, self.scenario.obstacle_count
        return f"{m} pursuer{'s' * (m != 1)} and {k} obstacle{'s' * (k != 1)}"

    # The functions as C has them

    def _add(
        self,
        function: Callable[..., Any],
        head: str,
        words: str,
        inputs: list[tuple[Field, str]],
        outputs: list[str],
    ) -> None:
        program = Program(self.tables)
        results = translate(program, function, [field.given(program, before) for field, before in inputs])
        nodes: list[Node] = [node for result in results for node in result.reshape(-1)]
        self.functions.append(_Function(head, words, CBody(program, list(zip(outputs, nodes, strict=True)))))

    @property
    def _of_world(self) -> list[tuple[Field, str]]:
        return [(field, "world->") for field in self.fields]

    def _after(self) -> list[str]:
        return [name for field in self.memory for name in field.entries("memory->")]

    def _add_shield(self) -> None:
        self._add(
            self.start,
            "void sidestep_start(const sidestep_world *world, sidestep_memory *memory)",
            "The memory before the first call of sidestep_filter.",
            self._of_world,
            self._after(),
        )
        self._add(
            self.filtered,
            "void sidestep_filter(const sidestep_world *world, const float wish[2],\n"
            "                     sidestep_memory *memory, sidestep_answer *answer)",
            "The safe velocity for a nominal one, `wish`, in m/s. Call it once in every control period.",
            [*self._of_world, (self.wish, ""), *((field, "memory->") for field in self.memory)],
            ["answer->velocity[0]", "answer->velocity[1]", "answer->status", *self._after()],
        )

    def _add_policy(self) -> None:
        steps = decision_steps_of(self.policy)
        if self.what == "policy":
            self._add(
                self.acted,
                f"void sidestep_policy(const float observation[{self.seen.size}], float action[2])",
                "The policy's action in [-1, 1] x [-1, 1] for an observation.",
                [(self.seen, "")],
                ["action[0]", "action[1]"],
            )
            return
        self._add(
            self.wished,
            "void sidestep_wish(const sidestep_world *world, float wish[2])",
            f"The policy's velocity in m/s. It was trained to decide in every {steps}th period: keep `wish`\n"
            "   in between.",
            self._of_world,
            ["wish[0]", "wish[1]"],
        )

    # Texts

    @property
    def header(self) -> str:
        """sidestep.h."""
        period = np.float32(self.scenario.control_period)
        lines = [
            f"/* sidestep {sidestep.__version__}: {self.what} for {self.robots}.",
            f"   Units: {UNITS}. */",
            "#ifndef SIDESTEP_H",
            "#define SIDESTEP_H",
            "",
            "#include <stdbool.h>",
            "#include <stdint.h>",
            "",
            "/* Control period, s. */",
            f"#define SIDESTEP_PERIOD {number(period)}",
        ]
        if self.policy is not None and self.what != "filter":
            lines += ["/* Control periods between two decisions of the policy. */"]
            lines += [f"#define SIDESTEP_DECISION_STEPS {decision_steps_of(self.policy)}"]
        if self.what != "policy":
            members = [_declaration(field) for field in self.used] or ["    char none;"]
            lines += ["", "typedef struct {", *members, "} sidestep_world;"]
            lines += ["", "/* What the shield keeps from call to call. */", "typedef struct {"]
            lines += [_declaration(field) for field in self.memory] or ["    char none;"]
            lines += ["} sidestep_memory;", "", "typedef struct {"]
            lines += [_declaration(Field("velocity", (2,), "f", "m/s"))]
            lines += [_declaration(Field("status", (), "i", STATUS_WORDS)), "} sidestep_answer;"]
        for function in self.functions:
            lines += ["", f"/* {function.words} */", f"{function.head};"]
        return "\n".join([*lines, "", "#endif", ""])

    @property
    def code(self) -> str:
        """sidestep.c."""
        lines = ['#include "sidestep.h"', "", "#include <math.h>", ""]
        body: list[str] = []
        for function in self.functions:
            inside = function.body.lines()
            unused = [
                f"    (void){name};"
                for name in re.findall(r"(\w+)(?:\[\d+\])?[,)]", function.head)
                if not any(re.search(rf"\b{name}\b", line) for line in inside)
            ]
            body += ["", function.head, "{", *unused, *inside, "}"]
        text = "\n".join(body)
        for helper in re.split(r"(?=static inline)", HELPERS):
            name = re.search(r"(\w+)\(", helper)
            if name and re.search(rf"\b{name.group(1)}\(", text):
                lines.append(helper.rstrip())
        for which in sorted({one for function in self.functions for one in function.body.tables}):
            lines += ["", *table(f"table{which}", self.tables.arrays[which])]
        return "\n".join([*lines, text, ""])

    @property
    def example(self) -> str:
        """How the functions are called."""
        if self.what == "policy":
            given = f"float observation[{self.seen.size}] = {{0}}, action[2];"
            return f"{given}\nsidestep_policy(observation, action);"
        lines = ["sidestep_world world = {0}; /* fill in what you measured */", "sidestep_memory memory;"]
        lines += [
            "sidestep_answer answer;",
            "float wish[2] = {0.1f, 0.0f};",
            "sidestep_start(&world, &memory);",
        ]
        lines += ["/* then every SIDESTEP_PERIOD seconds: */"]
        if self.what != "filter":
            lines += ["sidestep_wish(&world, wish); /* in every SIDESTEP_DECISION_STEPS-th of them */"]
        return "\n".join([*lines, "sidestep_filter(&world, wish, &memory, &answer);"])

    @property
    def adapter(self) -> str:
        """The body of `sidestep_check` in check.c."""
        if self.what == "policy":
            return "    sidestep_policy(in, out);"
        fields = [(field, "world") for field in self.used]
        fields += [(self.wish, "")] if self.what == "filter" else []
        fields += [(field, "memory") for field in self.memory]
        lines = [
            "sidestep_world world;",
            "sidestep_memory memory;",
            "sidestep_answer answer;",
            "float wish[2];",
        ]
        at = 0
        for field, owner in fields:
            where = f"{owner}.{field.name}" if owner else field.name
            if field.kind == "f":
                lines.append(f"memcpy(&{where}, in + {at}, sizeof {where});")
            else:
                lines += [
                    f"{name} = ({TYPES[field.kind]})in[{at + k}];"
                    for k, name in enumerate(field.entries("memory."))
                ]
            at += field.size
        at = 0
        if self.what != "filter":
            lines += ["sidestep_wish(&world, wish);", "memcpy(out, wish, sizeof wish);"]
            at = 2
        lines += ["sidestep_filter(&world, wish, &memory, &answer);"]
        lines += [
            f"memcpy(out + {at}, answer.velocity, sizeof answer.velocity);",
            f"out[{at + 2}] = (float)answer.status;",
        ]
        at += 3
        for field in self.memory:
            for k, name in enumerate(field.entries("memory.")):
                lines.append(
                    f"out[{at + k}] = (float){name};" if field.kind != "f" else f"out[{at + k}] = {name};"
                )
            at += field.size
        return "\n".join("    " + line for line in lines)

    # States

    def checked(self, count: int) -> tuple[np.ndarray, int, int, int, int]:
        """Rows of inputs, answers and what is allowed; in how many rounding decides; numbers of inputs, of
        outputs, and of those that may differ a little."""
        state, rng = random_states(self.scenario, count, 0), np.random.default_rng(1)
        if self.what == "policy":
            world = [state[field.name] for field in self.fields]
            seen = jax.jit(jax.vmap(lambda *values: observe(self.scenario, World(*values))))
            inputs = [np.asarray(seen(*world), np.float32)]
            found, allowed = answers(self.acted, inputs, measured=1, loose=2, seed=2)
            return self._rows(inputs, found, allowed, 2)
        memory = [
            rng.integers(-1, 2, (count, *field.shape)).astype(KINDS[field.kind]) for field in self.memory
        ]
        spare = [np.zeros((count, *field.shape), np.float32) for field in self.fields]
        used = {field.name for field in self.used}
        world = [
            state[f.name] if f.name in used else zero for f, zero in zip(self.fields, spare, strict=True)
        ]
        n = len(self.fields)
        shown = [state[field.name] for field in self.used]
        if self.what == "filter":
            found, allowed = answers(
                self.filtered, [*world, state["wish"], *memory], measured=n + 1, loose=2, seed=2
            )
            return self._rows([*shown, state["wish"], *memory], found, allowed, 2)

        def both(*values: Any) -> tuple[Any, ...]:
            (wish,) = self.wished(*values[:n])
            return (wish, *self.filtered(*values[:n], wish, *values[n:]))

        found, allowed = answers(both, [*world, *memory], measured=n, loose=4, seed=2)
        return self._rows([*shown, *memory], found, allowed, 4)

    @staticmethod
    def _rows(
        inputs: list[np.ndarray], found: np.ndarray, allowed: np.ndarray, loose: int
    ) -> tuple[np.ndarray, int, int, int, int]:
        flat = np.concatenate([values.reshape(len(values), -1).astype("<f4") for values in inputs], 1)
        rows = np.concatenate([flat, found, allowed[:, None]], 1).astype("<f4")
        return rows, int(np.sum(~np.isfinite(allowed))), flat.shape[1], found.shape[1], loose
