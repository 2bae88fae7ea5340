"""Warps, voxel-driven back-projection and hull compiled by NVRTC, with no GPU at hand, as in
`test_compiles.py`.
"""

import re

import pytest
import torch

from mvrecon.kernels.cuda.sources import KERNELS, Part, text_of
from mvrecon.kernels.rays.cuda import nvrtc
from tests.kernels.cuda.test_compiles import installed, loops

pytestmark = pytest.mark.skipif(not installed(), reason="no NVRTC, pip install nvidia-cuda-nvrtc")


@pytest.mark.parametrize("architecture", ["compute_80", "compute_90"])
@pytest.mark.parametrize("purpose", KERNELS)
def test_inner_loops_are_in_registers_and_single_precision(purpose, architecture):
    """Nothing in local memory but the hull's corners, no atomic addition; no float64 and no call
    in the inner loops of warps.
    """
    text = nvrtc.build(text_of({"": Part(purpose, torch.float32)}), architecture).decode()
    parts = re.split(r"\.entry (\w+)", text)[1:]
    ptx = dict(zip(parts[::2], parts[1::2], strict=True))
    assert ptx.keys() == set(KERNELS[purpose]) and "atom." not in text and "red." not in text
    if purpose != "hull":
        assert "ld.local" not in text and "st.local" not in text
    for name in ptx.keys() & {"warp", "warp_back"}:
        inner = loops(ptx[name])
        assert inner and not [loop for loop in inner if ".f64" in loop or "call" in loop], name


@pytest.mark.parametrize("purpose", KERNELS)
def test_machine_code_for_hopper_and_float64(purpose):
    source = text_of({"": Part(purpose, torch.float64)})
    assert nvrtc.build(source, "sm_90")[:4] == b"\x7fELF"
