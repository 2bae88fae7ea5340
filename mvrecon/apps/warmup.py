"""`mvrecon-warmup`: compile the kernels of the CPU once, so that no first call waits for it."""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

#: Voxels along an edge, pixels along a detector's, and views: as few as every kernel works with.
VOXELS, PIXELS, VIEWS = 8, 8, 4


def warm_up() -> float:
    """Call every projector's method, forward, adjoint and with gradients of the pose, and a method
    of every kind, in float32 and float64; returns the seconds that it took.
    """
    import torch

    import mvrecon as mv
    from mvrecon.operators.ray_transform import METHODS

    begin = time.perf_counter()
    grid = mv.Grid.centred(VOXELS, spacing=4.0)
    detector = {"pixels": [PIXELS, PIXELS], "pixel_mm": 8.0}
    cone, beam = mv.circular(VIEWS, 200.0, 400.0, detector), mv.parallel(VIEWS, detector)
    posed = replace(cone, source=cone.source.clone().requires_grad_())
    for dtype in (torch.float32, torch.float64):
        x = torch.rand(1, 1, *grid.shape, dtype=dtype)
        for method in METHODS:
            for A in (mv.Drr(grid, posed, method=method), mv.Radon(grid, beam, method=method)):
                z = x.clone().requires_grad_()
                A.T(A(z)).sum().backward()
        views = mv.Drr(grid, cone)(x)
        for name in ("fdk", "sirt", "fista_tv", "osem"):
            mv.reconstruct(views, cone, grid, name)
    return time.perf_counter() - begin


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `mvrecon-warmup`, which has no options."""
    argparse.ArgumentParser(prog="mvrecon-warmup", description=__doc__).parse_args(arguments)
    seconds = warm_up()
    from mvrecon.kernels.compiling import kept_in

    sys.stdout.write(f"kernels are ready after {seconds:.0f} s, kept in {kept_in()}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
