"""The kernels compiled by NVRTC, with no GPU at hand: where NVRTC is installed, as with torch for
CUDA, or by `pip install nvidia-cuda-nvrtc`.
"""

import re

import pytest
import torch

from mvrecon.kernels.rays.cuda import nvrtc
from mvrecon.kernels.rays.cuda.sources import KERNELS, Variant, text_of
from mvrecon.kernels.rays.trace import JOSEPH, SIDDON, TRILINEAR


def installed() -> bool:
    try:
        nvrtc.library()
    except OSError:
        return False
    return True


pytestmark = pytest.mark.skipif(not installed(), reason="no NVRTC, pip install nvidia-cuda-nvrtc")
VARIANTS = [
    Variant(torch.float32, stored, together, method)
    for method in (JOSEPH, SIDDON, TRILINEAR)
    for stored, together in ((torch.float32, 1), (torch.bfloat16, 4))
]


def kernels(variant: Variant, architecture: str) -> dict[str, str]:
    """PTX by kernel."""
    text = nvrtc.build(text_of({"": variant}), architecture).decode()
    parts = re.split(r"\.entry (\w+)", text)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def loops(ptx: str) -> list[str]:
    """The innermost loops: from a label to the first branch back to it, no other such label
    between.
    """
    lines, labels, found = ptx.splitlines(), {}, []
    for i, line in enumerate(lines):
        if label := re.match(r"(\$L\w+):", line):
            labels[label[1]] = i
        jump = re.search(r"bra(?:\.uni)?\s+(\$L\w+);", line)
        if jump and jump[1] in labels:
            found.append((labels[jump[1]], i))
    inner = [(a, b) for a, b in found if not any(a < c and d < b for c, d in found)]
    return ["\n".join(lines[a : b + 1]) for a, b in inner]


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_steps_are_in_registers_and_single_precision(variant):
    """For Hopper and Ampere: nothing in local memory, no float64 and no call in a loop of steps;
    atomic additions for explicit rays alone.
    """
    ptx = kernels(variant, "compute_80")
    assert ptx.keys() == set(KERNELS)
    assert not any("ld.local" in text or "st.local" in text for text in ptx.values())
    for name in ("project", "gather", "scatter", "vary"):
        steps = loops(ptx[name])
        assert steps, name
        # of the derivative the loop over pixels, too, has no other inside
        if name != "vary":
            assert not [step for step in steps if ".f64" in step or "call" in step], name
    assert [
        n
        for n in ("project", "gather", "vary", "store")
        if ".add.f32" in ptx[n] and "atom" in ptx[n]
    ] == []
    assert "atom.global.add.f32" in ptx["scatter"] or "red.global.add.f32" in ptx["scatter"]


def test_machine_code_for_hopper_and_a_mistake():
    variant = VARIANTS[0]
    assert nvrtc.build(text_of({"": variant}), "sm_90")[:4] == b"\x7fELF"
    with pytest.raises(nvrtc.CompileError, match="error"):
        nvrtc.build("an error", "compute_90")
