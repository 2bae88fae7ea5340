"""The kernels compiled by NVRTC for devices that are not at hand, and read as machine code: where
NVRTC and its disassembler are installed, as by the extra `dev` on Linux.
"""

import pytest
import torch

from mvrecon.kernels.cuda import nvrtc
from mvrecon.kernels.cuda.launch import HULL, RAYS, VOXELS, WARPS, Variant, text_of

#: Registers of a thread: 65 536 of a multiprocessor for at least 4 blocks of 128 threads.
MOST = 128
#: Instructions that read or write local memory, outside the loops of steps.
ASIDE = 10
F, D, B = torch.float32, torch.float64, torch.bfloat16
#: Ampere and Hopper, one volume and four; a case takes two seconds.
CASES = [
    (80, Variant(RAYS, F, B, 4, "siddon")),
    (80, Variant(RAYS, F, F, 1, "trilinear")),
    (90, Variant(RAYS, F, F, 1, "joseph")),
]
PARTS = [Variant(WARPS, F, B), Variant(VOXELS, F), Variant(HULL, D)]


@pytest.mark.parametrize(
    ("capability", "variant"), CASES, ids=lambda case: getattr(case, "method", case)
)
def test_steps_use_registers_and_single_precision(capability, variant, machine_code):
    """Nothing in local memory, no float64 and no call in a loop of steps; atomic additions for
    explicit rays alone. Before the loops a few numbers may be put aside: on sm_80 `gather` of four
    bfloat16 volumes does, and set-up in float64.
    """
    kernels, count = machine_code.compiled(text_of({"": variant}), capability), machine_code.count
    assert kernels.keys() == set(RAYS.names)
    for name, kernel in kernels.items():
        assert kernel.registers <= MOST, (name, kernel.registers)
        assert count(machine_code.LOCAL, kernel.instructions) <= ASIDE, name
        assert not any(count(machine_code.LOCAL, loop) for loop in kernel.loops), name
        added = [i for i in kernel.instructions if "ADD.F32" in i]
        assert bool(count(machine_code.ATOMIC, added)) == (name == "scatter"), name
    for name in ("project", "gather", "scatter"):
        assert kernels[name].loops, name
        for step in kernels[name].loops:
            assert not count(machine_code.DOUBLE, step), name
            # sm_80 leaves the loop of `scatter` by a conditional CALL that never returns
            assert name == "scatter" or not count(machine_code.CALL, step), name


@pytest.mark.pairwise(part=PARTS, capability=[80, 90])
def test_warps_back_projection_and_hull_use_only_registers(part, capability, machine_code):
    """float64 in no loop that reads values, nor over a brick's corners."""
    text, count = text_of({"": part}), machine_code.count
    kernels = machine_code.compiled(text, capability)
    assert kernels.keys() == set(part.source.names)
    for name, kernel in kernels.items():
        assert kernel.registers <= MOST, (name, kernel.registers)
        assert not count(machine_code.LOCAL + "|" + machine_code.ATOMIC, kernel.instructions), name
        values = [loop for loop in kernel.loops if count(r"LDG\.E(?!\S*\.64)", loop)]
        assert bool(values) == (name not in ("invert", *HULL.names)), name
        inner = kernel.loops if name in HULL.names else values
        assert not any(count(machine_code.DOUBLE, loop) for loop in inner), name
        called = name in ("warp", "warp_back") and any(count(machine_code.CALL, i) for i in inner)
        assert not called, name


@pytest.mark.parametrize("source", [WARPS, VOXELS], ids=lambda source: source.macro)
def test_it_compiles_for_hopper_in_float64(source, machine_code):
    kernels = machine_code.compiled(text_of({"": Variant(source, D)}), 90)
    assert kernels.keys() == set(source.names)


def test_a_compile_error_contains_the_compiler_s_message(machine_code):
    with pytest.raises(nvrtc.CompileError, match="error"):
        nvrtc.build("an error", "compute_90")
