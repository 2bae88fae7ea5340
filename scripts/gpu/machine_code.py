"""What the kernels of the CUDA back end are made of: registers, spills, instructions, float64 ones
among them, and those of the innermost loops. Needs no GPU.

    pip install nvidia-cuda-nvrtc nvidia-cuda-nvcc nvidia-cuda-nvdisasm
    python scripts/gpu/machine_code.py [--capability 90]
"""

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from mvrecon.kernels.rays.cuda import nvrtc
from mvrecon.kernels.rays.cuda.sources import Variant, text_of
from mvrecon.kernels.rays.trace import METHODS

KERNELS = ("store", "project", "record", "gather", "scatter", "vary")
STORED = ((torch.float32, 1), (torch.float32, 4), (torch.bfloat16, 4))
DOUBLE, LOAD = r"\bD(?:FMA|MUL|ADD|SETP)\b|F64", r"\bLDG\b"


def tool(name: str) -> str:
    """The path of a program out of NVIDIA's wheels."""
    paths = [path for root in nvrtc.roots() for path in root.rglob(name) if path.is_file()]
    if not paths:
        sys.exit(f"machine_code.py needs {name}: pip install nvidia-cuda-nvcc nvidia-cuda-nvdisasm")
    paths[0].chmod(0o755)
    return str(paths[0])


def assembled(variant: Variant, capability: int, folder: Path) -> tuple[str, str]:
    """The messages of the assembler, and the machine code as text."""
    ptx, cubin = folder / "rays.ptx", folder / "rays.cubin"
    text = nvrtc.build(text_of({"": variant}), f"compute_{capability}")
    ptx.write_bytes(text.rstrip(b"\0"))
    command = [tool("ptxas"), "-v", "-arch", f"sm_{capability}", str(ptx), "-o", str(cubin)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    shown = subprocess.run([tool("nvdisasm"), "-c", str(cubin)], capture_output=True, check=True)
    return said, shown.stdout.decode()


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
    """How many instructions match."""
    return sum(bool(re.search(pattern, one)) for one in instructions)


def rows(variant: Variant, capability: int, folder: Path) -> list[str]:
    """A line of a table for each kernel."""
    said, shown = assembled(variant, capability, folder)
    pattern = r"entry function '(\w+)'.*?(\d+) bytes spill stores.*?Used (\d+) registers"
    used = {name: (registers, spilt) for name, spilt, registers in re.findall(pattern, said, re.S)}
    parts = re.split(r"\.section\s+\.text\.(\w+)", shown)[1:]
    lines = []
    for name, body in zip(parts[::2], parts[1::2], strict=True):
        if name in KERNELS:
            every, inner = loops(body)
            steps = "; ".join(
                f"{len(loop)} ({count(DOUBLE, loop)} float64, {count(LOAD, loop)} loads)"
                for loop in inner
            )
            registers, spilt = used[name]
            numbers = f"{registers} | {spilt} | {len(every)} | {count(DOUBLE, every)}"
            lines.append(f"| {name} | {numbers} | {steps} |")
    return lines


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--capability", type=int, default=90)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for method, number in METHODS.items():
            for stored, together in STORED:
                print(f"\n{method}, {stored}, {together} volumes a ray\n")
                print("| kernel | registers | bytes spilt | instructions | float64 | inner loops |")
                print("|---|---:|---:|---:|---:|---|")
                variant = Variant(torch.float32, stored, together, number)
                print("\n".join(rows(variant, options.capability, Path(folder))), flush=True)


if __name__ == "__main__":
    main()
