"""No loop over rays reads or writes outside its copy of a volume, wherever rays touch the box of
nonzero voxels.
"""

import math

import numpy as np
import pytest
import torch

from mvrecon.geometry.cameras.rigs import parallel
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays.cpu import columns, operators as cpu, plan
from mvrecon.operators.radon import Radon

N = 24
#: Numbers in front of a copy and behind it: more than a slab.
GUARD = 40 * 40
#: Of parallel rays that meet ends of voxels in the middle of slabs, but for rounding.
SLOPES = (1 / 2, 1 / 3, 2 / 3, 1 / 4, 3 / 4)


def rig(slope: float, turn: float):
    angle = math.atan(slope)
    detector = {"pixels": [6, 12 * N], "pixel_mm": [3.0, math.cos(angle) / 6]}
    return parallel(1, detector, 3.0 * N, start_degrees=math.degrees(angle) + turn)


def guarded(monkeypatch: pytest.MonkeyPatch, value: float) -> list[np.ndarray]:
    """Copies of volumes lie between guards of this value; the memories in which they do."""
    memories, plain = [], cpu.empty

    def empty(*arguments, **_):
        shape, dtype = plain(*arguments[:5]).shape, arguments[4]
        memory = np.full(math.prod(shape) + 2 * GUARD, value, dtype)
        memory[GUARD:-GUARD] = 0
        memories.append(memory)
        return memory[GUARD:-GUARD].reshape(shape)

    monkeypatch.setattr(cpu, "empty", empty)
    return memories


@pytest.mark.pairwise(
    by=["columns", "rows"],
    turn=[0.0, 90.0, 180.0, 270.0],
    method=["joseph", "siddon"],
    dtype=[torch.float32, torch.float64],
)
def test_rays_along_the_boundary_of_a_box_stay_inside_its_copy(
    by, turn, method, dtype, monkeypatch
):
    """Where a ray meets the end of a box in the middle of a slab, rounding decides whether its
    cell is the last one that touches the box, or the one before: which is inside the copy, too.
    """
    if by == "rows":
        monkeypatch.setattr(plan, "kept_plan", plan.plan_by_content)
        monkeypatch.setattr(plan, "columnar", lambda rig: columns.columnar(rig) & False)
    for slope in SLOPES:
        for low in (4, 5):
            x = torch.zeros(1, 1, N, N, N, dtype=dtype)
            x[..., 6:19, low:16, low:18] = 1.0
            A = Radon(Grid.centred(N, 1.0), rig(slope, turn), method=method, skip="box")
            expected = A(x)
            with monkeypatch.context() as context:
                guarded(context, math.nan)
                assert torch.equal(A(x), expected)
            with monkeypatch.context() as context:
                memories = guarded(context, 0.0)
                A.with_support(x[0, 0] != 0).T(torch.ones_like(expected))
                assert memories
                assert not any(m[:GUARD].any() or m[-GUARD:].any() for m in memories)
