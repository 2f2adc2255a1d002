"""A traced JAX function as a shared library, which this machine's C compiler builds."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sidestep.bridges.export.c_code import HELPERS, CBody, table
from sidestep.bridges.export.program import Program, Tables, kind_of
from sidestep.bridges.export.translate import translate

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
"""What the C compiler is called with: every operation rounds by itself."""


def c_code(function: Callable[..., tuple[Any, ...]], *examples: Any) -> str:
    """C99 of a function of arrays that returns a tuple of arrays: `void sidestep_decide(struct words *io)`.

    The struct holds the entries of all arguments, then those of all results, each as a float or an int32_t.
    **Raises** `NotTranslatable`.
    """
    program = Program(Tables())
    inputs, fields, outputs = [], [], []
    for k, example in enumerate(map(np.asarray, examples)):
        kind, made = kind_of(example.dtype), np.empty(example.shape, object)
        for flat, place in enumerate(np.ndindex(*example.shape)):
            name = f"io->in{k}[{flat}]"
            made[place] = program.given(name if kind != "b" else f"({name} != 0)", kind)
        inputs.append(made)
        fields.append((f"in{k}", made.size, kind))
    for k, nodes in enumerate(translate(program, function, inputs)):
        flat = nodes.reshape(-1)
        outputs += [(f"io->out{k}[{place}]", node) for place, node in enumerate(flat)]
        fields.append((f"out{k}", flat.size, flat[0].kind if flat.size else "f"))
    body = CBody(program, outputs)
    lines = ["#include <math.h>", "#include <stdbool.h>", "#include <stdint.h>", "", HELPERS]
    for number in body.tables:
        lines += table(f"table{number}", program.tables.arrays[number])
    lines += ["struct words {"]
    for name, size, kind in fields:
        lines += [f"    {'float' if kind == 'f' else 'int32_t'} {name}[{size}];"] if size else []
    lines += ["};", "void sidestep_decide(struct words *io);", "void sidestep_decide(struct words *io)", "{"]
    return "\n".join([*lines, *body.lines(), "}", ""])


def compiler() -> str | None:
    """The path of the C compiler: `$CC`, or `cc`; None without one."""
    return shutil.which(os.environ.get("CC", "cc"))


def build(folder: Path, code: str, compiler: str) -> tuple[Path | None, str]:
    """The library, or None and why there is none."""
    source, library = folder / "decide.c", folder / "decide.so"
    source.write_text(code, encoding="ascii")
    try:
        subprocess.run(
            [compiler, *FLAGS, "-o", library, source, "-lm"], check=True, capture_output=True, text=True
        )
    except subprocess.CalledProcessError as error:
        said = (error.stderr.strip().splitlines() or ["it says nothing"])[0]
        return None, f"{compiler} failed with status {error.returncode}: {said}"
    except OSError as error:
        return None, f"{compiler} cannot be run: {error.strerror}"
    return library, ""
