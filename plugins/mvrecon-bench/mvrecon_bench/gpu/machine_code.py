"""Statistics of the CUDA kernels' machine code: registers, local memory, number of instructions, of
float64 instructions, and of those in the innermost loops. Requires no GPU.

    pip install nvidia-cuda-nvrtc nvidia-cuda-nvdisasm       # extra `dev` has both on Linux
    python -m mvrecon_bench.gpu.machine_code [--capability 90]
"""

import argparse
import re
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch

from mvrecon.kernels.cuda import nvrtc
from mvrecon.kernels.cuda.launch import HULL, RAYS, VOXELS, WARPS, Variant, text_of
from mvrecon.kernels.rays.lines import METHODS

#: Kernels along rays to report.
SHOWN = ("store", "project", "record", "gather", "scatter", "vary")
STORED = ((torch.float32, 1), (torch.float32, 4), (torch.bfloat16, 4))
#: Patterns of instructions.
DOUBLE, LOAD = r"\bD(?:FMA|MUL|ADD|SETP)\b|F64|64H", r"\bLDG\b"
LOCAL, CALL, ATOMIC = r"\b(?:LDL|STL)\b", r"\bCALL\b", r"\b(?:ATOM|ATOMG|REDG?)\b"


class Kernel(NamedTuple):
    """The machine code of a kernel.

    Args:
        registers: registers per thread.
        instructions: all instructions.
        loops: instructions of each innermost loop.
    """

    registers: int
    instructions: list[str]
    loops: list[list[str]]


def disassembler() -> Path:
    """NVIDIA's disassembler from its wheel.

    Raises:
        OSError: the disassembler is not installed.
    """
    paths = [path for root in nvrtc.roots() for path in root.rglob("nvdisasm") if path.is_file()]
    if not paths:
        raise OSError("nvdisasm is not installed: pip install nvidia-cuda-nvdisasm")
    return paths[0]


def compiled(source: str, capability: int) -> dict[str, Kernel]:
    """The kernels of a CUDA C++ source by name.

    Raises:
        OSError: NVRTC or the disassembler is not installed.
    """
    tool = disassembler()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rays.cubin"
        file.write_bytes(nvrtc.built(source, f"sm_{capability}"))
        shown = subprocess.run([str(tool), str(file)], capture_output=True, check=True).stdout
    text = shown.decode()
    counts = re.findall(r"REGCOUNT.*?index@\((\w+)\).*?\.word\s+(0x\w+)", text, re.S)
    registers = {name: int(number, 16) for name, number in counts}
    parts = re.split(r"\.section\s+\.text\.(\w+)", text)[1:]
    bodies = zip(parts[::2], parts[1::2], strict=True)
    return {name: Kernel(registers[name], *loops(body)) for name, body in bodies}


def loops(body: str) -> tuple[list[str], list[list[str]]]:
    """Instructions of a kernel, and those of its innermost loops."""
    labels: dict[str, int] = {}
    instructions: list[str] = []
    ends: list[tuple[int, int]] = []
    for line in body.splitlines():
        if label := re.match(r"\s*\.(L_x_\d+):", line):
            labels[label[1]] = len(instructions)
        if code := re.match(r"\s*/\*[0-9a-f]+\*/\s+(.*);", line):
            jump = re.search(r"BRA.*`\(\.(L_x_\d+)\)", code[1])
            if jump and jump[1] in labels:
                ends.append((labels[jump[1]], len(instructions) + 1))
            instructions.append(code[1])
    inner = [(a, b) for a, b in ends if not any(a <= c < d < b or a < c < d <= b for c, d in ends)]
    return instructions, [instructions[a:b] for a, b in inner if b - a > 4]


def count(pattern: str, instructions: list[str]) -> int:
    """Number of matching instructions."""
    return sum(bool(re.search(pattern, one)) for one in instructions)


def row(name: str, kernel: Kernel) -> str:
    """Table row of a kernel."""
    code = kernel.instructions
    steps = "; ".join(
        f"{len(loop)} ({count(DOUBLE, loop)} float64, {count(LOAD, loop)} loads)"
        for loop in kernel.loops
    )
    numbers = f"{kernel.registers} | {count(LOCAL, code)} | {len(code)} | {count(DOUBLE, code)}"
    return f"| {name} | {numbers} | {steps} |"


def texts() -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Compilation units: title, source, and the kernels to report."""
    # here, as the tests of the core read machine code without the plugin
    from mvrecon_spect.kernels.cuda import FOOTPRINTS

    single, half = torch.float32, torch.bfloat16
    for method in METHODS:
        for stored, together in STORED:
            variant = Variant(RAYS, single, stored, together, method)
            yield f"{method}, {stored}, {together} a ray", text_of({"": variant}), SHOWN
    for source in (WARPS, VOXELS, HULL, FOOTPRINTS):
        for stored in (single, half) if source is WARPS else (single,):
            variant = Variant(source, single, stored)
            yield f"{source.macro}, {stored}", text_of({"": variant}), source.names


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--capability", type=int, default=90)
    options = parser.parse_args()
    for title, source, names in texts():
        print(f"\n{title}\n")
        print("| kernel | registers | local memory | instructions | float64 | inner loops |")
        print("|---|---:|---:|---:|---:|---|")
        kernels = compiled(source, options.capability)
        print("\n".join(row(name, kernels[name]) for name in names), flush=True)


if __name__ == "__main__":
    main()
