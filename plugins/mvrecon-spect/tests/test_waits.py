"""Synchronisations of pinholes on an emulated GPU: only transfers to the device, none
back.
"""

import torch

from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon_bench.gpu.as_gpu import GPU, AsGpu, on_gpu
from mvrecon_spect.operators.projector import Spect

GRID = Grid.centred(size=(8, 7, 6), spacing=12.0)


def test_blur_on_a_gpu_does_not_synchronise_and_matches_the_cpu():
    torch.manual_seed(0)
    x, mu = torch.zeros(2, 1, *GRID.shape), 0.01 * torch.rand(*GRID.shape)
    x[..., 2:4, 3:5, 2:5] = torch.rand(2, 1, 2, 2, 3)  # layers and pixels that nothing is seen in
    rig = dcspect80(pixels=[9, 8])[::20]
    A = Spect(GRID, rig, 5.0, mu, blur=True, intrinsic_mm=3.0)
    y = torch.rand(2, 1, *A.range_shape)
    views, volumes = A(x), A.T(y)
    with torch.no_grad(), AsGpu() as gpu:
        A.to(GPU)
        again, back = A(on_gpu(x)), A.T(on_gpu(y))
        assert A.A.last_backend == "cuda"
        assert {why.split(", ")[-1] for _, why in gpu.waits} == {"copied from main memory"}
        torch.testing.assert_close(again.values, views, rtol=1e-5, atol=1e-6 * views.max().item())
        torch.testing.assert_close(
            back.values, volumes, rtol=1e-5, atol=1e-6 * volumes.max().item()
        )
