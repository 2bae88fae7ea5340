"""GPU: more than 2^31 voxels and pixels, and convolutions in bfloat16."""

import torch
from torch.nn.functional import conv3d

from mvrecon.geometry.grid import Grid
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.cases.sizes import FEW, LONG, band
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, Subject

#: Tolerance of cuDNN's rounding in bfloat16; faults cause relative errors of order one.
ROUGH = 2e-2
SINGLE = (torch.float32,)


def need_gpu(subject: Subject, gigabytes: float) -> None:
    """Raise DoesNotApply unless the device is a GPU with sufficient free memory."""
    if not subject.device.startswith("cuda"):
        raise DoesNotApply("it needs a GPU; case 46 stands for it in main memory")
    free = torch.cuda.mem_get_info(subject.device)[0] / 2**30
    if free < gigabytes:
        raise DoesNotApply(f"it needs {gigabytes:.0f} GB of a GPU's memory, {free:.0f} GB are free")


def convolution(subject: Subject) -> float:
    """A 3-D convolution of 16 channels of 62 x 641 x 361 in bfloat16, against float32."""
    need_gpu(subject, 8)
    x = subject.random(1, 16, 62, 641, 361)
    weight = subject.random(16, 16, 3, 3, 3, seed=1) - 0.5
    allowed, torch.backends.cudnn.allow_tf32 = torch.backends.cudnn.allow_tf32, False
    try:
        exact = conv3d(x.bfloat16().float(), weight.bfloat16().float(), padding=1)
    finally:
        torch.backends.cudnn.allow_tf32 = allowed
    result = conv3d(x.bfloat16(), weight.bfloat16(), padding=1).float()
    return float((result - exact).norm() / exact.norm())


def huge_volume(subject: ProjectorSubject) -> float:
    """Rays along the last slab of 2049 x 1024 x 1024 voxels in bfloat16, which contains ones and a
    last voxel of three.
    """
    need_gpu(subject, 32)
    subject.need_lines()
    grid = Grid.centred(size=(1024, 1024, 2049), spacing=1.0)
    volume = torch.zeros(grid.shape, dtype=torch.bfloat16, device=subject.device)
    volume[-1] = 1
    volume[-1, -1, -1] = 3
    rows = torch.tensor(
        [[-300.0, 0.0, 2048.0], [-300.0, 517.0, 2048.0], [-300.0, 1023.0, 2048.0]],
        dtype=torch.float64,
    )
    ends = rows * torch.tensor([-5.0, 1.0, 1.0], dtype=torch.float64)
    integrals = subject.values(grid, grid.to_world(rows), grid.to_world(ends), volume)
    return gap(integrals, torch.tensor([1024.0, 1024.0, 1026.0]))


def huge_views(subject: ProjectorSubject) -> float:
    """The last of more than 2^31 pixels, and their adjoint, equal those of a separate small
    detector.
    """
    need_gpu(subject, 48)
    middle = (LONG - 1) / 2
    detector = {"pixels": [LONG, LONG], "pixel_mm": 1.0, "offset_mm": [3.0 - middle, 2.5 - middle]}
    rig = subject.rig(detector=detector, n_views=1)
    A, B = (
        subject.projector(GRID, cameras)
        for cameras in (rig, band(rig, LONG - FEW, LONG - FEW, (FEW, FEW)))
    )
    x = subject.random(1, 1, *GRID.shape)
    views, few = A(x), B(x)
    error = gap(views[..., -FEW:, -FEW:], few)
    views.zero_()[..., -FEW:, -FEW:] = few
    return greatest([error, gap(A.T(views), B.T(few))]) if few.any() else torch.nan


CASES = (
    Case(
        44,
        "conv3d in bfloat16",
        "equal to float32 within rounding",
        "mvrecon",
        convolution,
        ROUGH,
        SINGLE,
    ),
    Case(
        45,
        "more than 2^31 voxels",
        "correct length in the last slab",
        "projector",
        huge_volume,
        1e-3,
        SINGLE,
    ),
    Case(
        45,
        "more than 2^31 pixels",
        "last pixels equal to a small detector's",
        "projector",
        huge_views,
        1e-3,
        SINGLE,
    ),
)
