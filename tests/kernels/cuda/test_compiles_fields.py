"""Warps, voxel-driven back-projection and hull compiled by NVRTC, with no GPU at hand: where NVRTC
is installed.
"""

import re

import pytest
import torch

from mvrecon.kernels.cuda import nvrtc
from mvrecon.kernels.cuda.launch import HULL, VOXELS, WARPS, Variant, text_of

SOURCES = (WARPS, VOXELS, HULL)


@pytest.fixture(scope="module", autouse=True)
def compiler():
    try:
        nvrtc.library()
    except OSError as problem:
        pytest.skip(str(problem))


def loops(ptx: str) -> list[str]:
    """The innermost loops: from a label to a branch back to it, no other such pair inside."""
    lines, labels, ends = ptx.splitlines(), {}, []
    for i, line in enumerate(lines):
        if label := re.match(r"(\$L\w+):", line):
            labels[label[1]] = i
        jump = re.search(r"bra(?:\.uni)?\s+(\$L\w+);", line)
        if jump and jump[1] in labels:
            ends.append((labels[jump[1]], i))
    inner = [(a, b) for a, b in ends if not any(a < c and d < b for c, d in ends)]
    return ["\n".join(lines[a : b + 1]) for a, b in inner]


@pytest.mark.parametrize("capability", [80, 90])
@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.macro)
def test_inner_loops_use_registers_and_single_precision(source, capability):
    """Nothing in local memory, no atomic addition; no float64 and no call in the inner loops of
    warps.
    """
    text = nvrtc.build(text_of({"": Variant(source, torch.float32)}), f"compute_{capability}")
    parts = re.split(r"\.entry (\w+)", text.decode())[1:]
    ptx = dict(zip(parts[::2], parts[1::2], strict=True))
    every = "".join(ptx.values())
    assert ptx.keys() == set(source.names) and not re.search(r"\b(?:atom|red)\.", every)
    assert "ld.local" not in every and "st.local" not in every
    for name in ptx.keys() & {"warp", "warp_back"}:
        inner = loops(ptx[name])
        assert inner and not [loop for loop in inner if ".f64" in loop or "call" in loop], name


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.macro)
def test_machine_code_for_hopper_in_float64(source):
    text = text_of({"": Variant(source, torch.float64)})
    assert nvrtc.build(text, "sm_90")[:4] == b"\x7fELF"
