"""Time of a reconstruction of random views in memory, by mvrecon or RTK, in one process each.

python experiments/11_methods/size/in_memory.py fdk mvrecon 96 512 1024   # views, voxels, pixels
python experiments/11_methods/size/in_memory.py os_sart rtk 90 512 512    # or sirt; one iteration
"""

import sys
import time

import torch

import mvrecon as mv
from mvrecon_peers import rtk_methods

SUBSETS = 10


def fdk(A: mv.Drr, views: torch.Tensor) -> None:
    """With RTK's Hann window."""
    mv.fdk_streamed(lambda a, b: views[0, 0, a:b], A.cameras, A.grid, "hann", extrapolate=False)


METHODS = {
    ("mvrecon", "fdk"): fdk,
    ("mvrecon", "sirt"): lambda A, views: mv.sirt(A, views, iterations=1),
    ("mvrecon", "os_sart"): lambda A, views: mv.os_sart(A, views, iterations=1, subsets=SUBSETS),
    ("rtk", "fdk"): lambda A, views: rtk_methods.rtk_fdk(A, views, 1.0),
    ("rtk", "sirt"): lambda A, views: rtk_methods.rtk_sirt(A, views, iterations=1),
    ("rtk", "os_sart"): lambda A, views: rtk_methods.rtk_os_sart(
        A, views, iterations=1, views_per_subset=len(A.cameras) // SUBSETS
    ),
}


def seconds(method: str, program: str, views: int, voxels: int, pixels: int) -> float:
    """Time of one reconstruction, for one iteration of an iterative method."""
    panel = {"pixels": [pixels, pixels], "pixel_mm": 400 / pixels}
    rig = mv.circular(views, sid=500, sdd=1000, detector=panel)
    A = mv.Drr(mv.Grid.centred(voxels, spacing=140 / voxels), rig)
    values = torch.rand(1, 1, views, pixels, pixels)
    start = time.perf_counter()
    METHODS[program, method](A, values)
    return time.perf_counter() - start


if __name__ == "__main__":
    method, program = sys.argv[1:3]
    sizes = [int(n) for n in sys.argv[3:]]
    seconds(method, program, 20, 16, 32)  # compiles
    print(f"{method} {program} {seconds(method, program, *sizes):.1f} s")
