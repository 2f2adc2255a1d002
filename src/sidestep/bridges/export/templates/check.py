"""Does sidestep.c answer as the program it was translated from? Needs a C compiler, and NumPy.

python check.py [STATES]      CC names the compiler
"""

import ctypes
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
TOUCHING = 3e-3


def compiled(folder):
    """`sidestep_check` as a function of two pointers to floats."""
    library = Path(folder) / "sidestep.so"
    sources = [HERE / "sidestep.c", HERE / "check.c"]
    options = ["-std=c99", "-O2", "-shared", "-fPIC", "-DSIDESTEP_NO_MAIN"]
    subprocess.run([os.environ.get("CC", "cc"), *options, "-o", library, *sources, "-lm"], check=True)
    function = ctypes.CDLL(str(library)).sidestep_check
    function.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    function.restype = None
    return function


def main():
    """Answer, compare and print; 1 where something differs."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "states.bin"
    _, count, inputs, outputs, measured = np.fromfile(path, "<u4", 5)
    rows = np.fromfile(path, "<f4", offset=20).reshape(count, inputs + outputs + 1)
    answers = np.empty((count, outputs), np.float32)
    with tempfile.TemporaryDirectory() as folder:
        answer = compiled(folder)
        for row, out in zip(rows, answers, strict=True):
            answer(row.ctypes.data, out.ctypes.data)
    allowed, wanted = rows[:, -1], rows[:, inputs:-1]
    with np.errstate(invalid="ignore"):
        off = np.where(np.isfinite(wanted) | np.isfinite(answers), np.abs(answers - wanted), 0.0)
    loose, clear = np.arange(outputs) < measured, np.isfinite(allowed)
    wrong = np.any(np.where(loose, off > allowed[:, None] + TOUCHING, off > 0.0), 1) & clear
    wrong |= np.any(np.isfinite(answers) != np.isfinite(wanted), 1)
    rough = clear & np.any(off[:, loose] > allowed[:, None], 1)
    print(
        f"{count} states: {np.sum(wrong)} differ, {np.sum(rough)} by rounding only "
        f"(at most {np.max(off[rough][:, loose], initial=0.0):.2g}), in {np.sum(~clear)} it decides between "
        "two answers"
    )
    return int(np.any(wrong))


if __name__ == "__main__":
    sys.exit(main())
