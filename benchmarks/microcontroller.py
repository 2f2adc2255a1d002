"""How much does a decision cost on a microcontroller? The exported C on an emulated Cortex-M4F.

    python benchmarks/microcontroller.py game --obstacles 2 --states 1000000 --json FILE
    python benchmarks/microcontroller.py joint:table --obstacles 1 --states 300000 --json FILE

Exports each shield's filter for the preset `paper`, builds it with arm-none-eabi-gcc for an STM32F405, as on
a Crazyflie 2.1 (Cortex-M4F, 168 MHz, single-precision FPU), and runs it in qemu-system-arm against its file
of states. Counted are emulated *instructions*, not cycles: by SysTick, while every instruction takes 1 ns of
the emulator's time, to 6 instructions. Also the stack that a call uses, and the sizes of code and constants.
Needs Debian's gcc-arm-none-eabi, libnewlib-arm-none-eabi and qemu-system-arm.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from machine import machine, versions
from sidestep.bridges.export import export_c
from sidestep.learning import load_policy
from sidestep.safety import make_shield
from sidestep.store.files import write_json
from sidestep.world import load_scenario

HERE = Path(__file__).with_name("microcontroller")
CLOCK = 168e6
FLAGS = [
    "-std=c99", "-O2", "-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard",
    "-ffunction-sections", "-fdata-sections",
]  # fmt: skip


def built(folder: Path) -> dict[str, int]:
    """Build the firmware; sizes of what sidestep.c takes, in bytes."""
    objects = []
    for name, source in (("sidestep", folder), ("check", folder), ("main", HERE)):
        target = folder / f"{name}.o"
        define = ["-DSIDESTEP_NO_MAIN"] if name == "check" else []
        subprocess.run(
            ["arm-none-eabi-gcc", *FLAGS, *define, "-c", source / f"{name}.c", "-o", target], check=True
        )
        objects.append(target)
    libraries = ["--specs=rdimon.specs", "-lc", "-lrdimon", "-lm", "-nostartfiles", "-Wl,--gc-sections"]
    link = ["arm-none-eabi-gcc", *FLAGS, f"-T{HERE / 'link.ld'}", *objects, *libraries]
    subprocess.run([*link, "-o", folder / "firmware.elf"], check=True)
    listing = subprocess.run(
        ["arm-none-eabi-size", "-A", folder / "sidestep.o"], check=True, capture_output=True, text=True
    )
    sizes = {"code": 0, "constants": 0, "data": 0}
    for line in listing.stdout.splitlines():
        name, *numbers = line.split() or [""]
        kinds = {".text": "code", ".rodata": "constants", ".data": "data", ".bss": "data"}
        for start, kind in kinds.items():
            if name.startswith(start) and numbers:
                sizes[kind] += int(numbers[0])
    return sizes


def emulated(folder: Path) -> dict[str, Any]:
    """Run the firmware against states.bin."""
    command = [
        "qemu-system-arm", "-M", "netduinoplus2", "-nographic", "-monitor", "none", "-serial", "none",
        "-icount", "shift=0", "-semihosting-config", "enable=on,target=native", "-kernel", "firmware.elf",
    ]  # fmt: skip
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    states, wrong, rough, open_, most, mean, stack, worst = run.stdout.split()
    to_instructions = 1e9 / CLOCK
    return {
        "states": int(states),
        "differ": int(wrong),
        "by rounding only": int(rough),
        "rounding decides": int(open_),
        "instructions, most": round(int(most) * to_instructions),
        "instructions, mean": round(float(mean) * to_instructions),
        "state with the most": int(worst),
        "stack, bytes": int(stack),
    }


def main() -> None:
    """Export, build, run, print, and write JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("shields", nargs="+")
    parser.add_argument("--obstacles", type=int, default=2)
    parser.add_argument("--pursuers", type=int, default=1)
    parser.add_argument("--what", default="filter", choices=("filter", "policy+filter"))
    parser.add_argument("--states", type=int, default=100_000)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    fields: dict[str, Any] = {"obstacle_count": asked.obstacles, "pursuer_count": asked.pursuers}
    policy = None
    if asked.what != "filter":
        policy, fields["observation"] = load_policy("pretrained"), "motion"
    scenario = load_scenario("paper", **fields)
    results: dict[str, Any] = {"fields": fields, "machine": machine(), "versions": versions(), "shields": {}}
    for name in asked.shields:
        with tempfile.TemporaryDirectory() as place:
            shield = make_shield(name, scenario)
            folder = Path(place)
            export_c(
                folder,
                scenario,
                policy,
                what=asked.what,
                shield=shield,
                shield_name=name,
                states=asked.states,
            )
            found = {**built(folder), **emulated(folder)}
        results["shields"][name] = found
        print(f"{name}: " + ", ".join(f"{key} {value:,}" for key, value in found.items()), flush=True)
        if asked.json is not None:
            write_json(asked.json, results)


if __name__ == "__main__":
    main()
