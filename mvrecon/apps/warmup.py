"""`mvrecon-warmup`: compiles the CPU kernels in advance, with those of plugins' projectors.

Examples:

    mvrecon-warmup
    NUMBA_CACHE_DIR=kernels mvrecon-warmup

Compiled kernels are kept in the folder NUMBA_CACHE_DIR, else beside the code, else in the user's
cache.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from mvrecon.apps.command_line import command_line
from mvrecon.apps.config.errors import one_line

#: Voxels along an edge, pixels along a detector's, and views: few, but without streaks.
VOXELS, PIXELS, VIEWS = 8, 8, 16
#: Voxels and pixels along an edge from which on empty parts of a volume are looked for.
MIN_SKIP_VOXELS, MIN_SKIP_PIXELS = 32, 512


def warm_up() -> float:
    """Call all kernels: projectors and warps with adjoints and gradients of the geometry, the
    search for empty voxels, and a method of every kind, in float32 and float64; returns seconds.
    Projectors of plugins call theirs in a static method `warm_up(dtype)`.
    """
    import torch

    import mvrecon as mv
    from mvrecon.core.parts import PROJECTORS
    from mvrecon.geometry.lattice import lifted_maps
    from mvrecon.kernels.warps import warp
    from mvrecon.operators.ray_transform import RAY_METHODS
    from mvrecon.operators.voxel_driven import backproject

    begin = time.perf_counter()
    grid = mv.Grid.centred(VOXELS, spacing=4.0)
    detector = {"pixels": [PIXELS, PIXELS], "pixel_mm": 16.0}
    cone, beam = mv.circular(VIEWS, 200.0, 400.0, detector), mv.parallel(VIEWS, detector)
    posed = replace(cone, source=cone.source.clone().requires_grad_())
    corner = cone.origin + (PIXELS - 1) * cone.u
    turned = replace(cone, origin=corner, u=cone.v, v=-cone.u)  # its columns lie across z
    large = mv.Grid.centred(MIN_SKIP_VOXELS, spacing=1.0)
    fine = mv.circular(VIEWS, 200.0, 400.0, {"pixels": [MIN_SKIP_PIXELS] * 2, "pixel_mm": 0.125})
    maps = lifted_maps(torch.eye(4, dtype=torch.float64))[None, None].requires_grad_()
    for dtype in (torch.float32, torch.float64):
        x = torch.rand(1, 1, *grid.shape, dtype=dtype)
        for method in RAY_METHODS:
            for A in (mv.Drr(grid, posed, method=method), mv.Radon(grid, beam, method=method)):
                z = x.clone().requires_grad_()
                A.T(A(z)).sum().backward()
        warp(x[None].clone().requires_grad_(), maps, grid.shape).sum().backward()
        views = mv.Drr(grid, cone)(x)
        for name in ("fdk", "sirt", "fista_tv", "pdhg_tv", "osem"):
            mv.reconstruct(views, cone, grid, name)
        backproject(views.requires_grad_(), turned, grid).sum().backward()
        ends = torch.zeros(1, 1, *large.shape, dtype=dtype)
        ends[..., 0, 0, 0] = ends[..., -1, -1, -1] = 1
        mv.Drr(large, fine)(ends)
        for name in PROJECTORS.names():
            with suppress(ImportError):  # of a library that is not installed
                if own := getattr(PROJECTORS.get(name), "warm_up", None):
                    own(dtype)
    return time.perf_counter() - begin


def parser() -> argparse.ArgumentParser:
    """The command line of `mvrecon-warmup`, which has no options of its own."""
    return command_line("mvrecon-warmup", __doc__)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `mvrecon-warmup`."""
    parser().parse_args(arguments)
    with one_line("mvrecon-warmup"):
        seconds = warm_up()
        from mvrecon.kernels.compiling import kept_in

        kept = f"kept in {folder}" if (folder := kept_in()) else "and are not kept"
        sys.stdout.write(f"kernels are ready after {seconds:.0f} s, {kept}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
