"""Time of FDK of random views, mvrecon's and RTK's, in one process each.

python experiments/11_methods/size/fdk.py mvrecon 96 512 1024   # or rtk; views, voxels, pixels
"""

import sys
import time

import torch

import mvrecon as mv
from mvrecon_peers.rtk_methods import rtk_fdk


def seconds(program: str, views: int, voxels: int, pixels: int) -> float:
    """Of one reconstruction with RTK's Hann window, after a small one that compiles."""
    panel = {"pixels": [pixels, pixels], "pixel_mm": 400 / pixels}
    rig = mv.circular(views, sid=500, sdd=1000, detector=panel)
    grid = mv.Grid.centred(voxels, spacing=140 / voxels)
    values = torch.rand(views, pixels, pixels)
    start = time.perf_counter()
    if program == "rtk":
        rtk_fdk(mv.Drr(grid, rig), values[None, None], 1.0)
    else:
        mv.fdk_streamed(lambda a, b: values[a:b], rig, grid, "hann", extrapolate=False)
    return time.perf_counter() - start


if __name__ == "__main__":
    name, sizes = sys.argv[1], [int(n) for n in sys.argv[2:]]
    seconds(name, 8, 16, 32)
    print(f"{seconds(name, *sizes):.1f} s")
