"""Modules of WebAssembly, run without a browser."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

HOST = Path(__file__).with_name("wasm_host.mjs")


@pytest.fixture
def answers_of(node, tmp_path):
    """`answers_of(binary, name, inputs, outputs, states)`: what a function of a module leaves in its output
    areas (states, numbers), for the numbers of its input areas, one state per row."""
    from sidestep.bridges.export.wasm_code import IMPORTED

    def answers_of(binary, name, inputs, outputs, states):
        files = [tmp_path / part for part in ("module", "job", "inputs", "outputs")]
        areas = {
            key: [[area.address, area.kind, area.size] for area in group]
            for key, group in (("inputs", inputs), ("outputs", outputs))
        }
        files[0].write_bytes(binary)
        files[1].write_text(json.dumps({"imports": list(IMPORTED), "name": name, **areas}))
        states.astype("<f4").tofile(files[2])
        subprocess.run([node, HOST, *files], check=True)
        return np.fromfile(files[3], "<f4").reshape(len(states), -1)

    return answers_of
