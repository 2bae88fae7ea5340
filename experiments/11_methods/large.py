"""FDK of 720 views of 512^2 on 512^3 voxels, views made block by block: seconds, peak memory."""

import time

import torch

import mvrecon as mv
from mvrecon.core.machine import peak
from mvrecon.data.scenes.solids import Phantom, Solids

N, N_VIEWS, VALUE = 512, 720, 0.02


def main() -> None:
    """Reconstruct an ellipsoid of 0.02/mm and print its value in the middle."""
    grid = mv.Grid.centred(N, spacing=0.5)
    detector = {"pixels": [N, N], "pixel_mm": 0.8}
    rig = mv.circular(N_VIEWS, 1000.0, 1536.0, detector, arc_degrees=360.0)
    half = torch.tensor([[60.0, 50.0, 40.0]])
    value = torch.tensor([VALUE])
    ball = Phantom((Solids("ellipsoid", torch.zeros(1, 3), torch.eye(3)[None], half, value),))
    making = 0.0

    def read(first: int, last: int) -> torch.Tensor:
        nonlocal making
        start = time.perf_counter()
        views = [
            ball.integrals(*one.rays(), ray_extent=one.ray_extent).float()
            for one in rig[first:last]
        ]
        making += time.perf_counter() - start
        return torch.cat(views)

    start = time.perf_counter()
    volume = mv.fdk_streamed(read, rig, grid, filter="hann")
    seconds = time.perf_counter() - start
    middle = volume[0, 0, 236:276, 236:276, 236:276].mean().item()
    print(f"{seconds - making:.1f} s, and {making:.1f} s for exact views")
    print(f"peak {(peak() or 0) / 2**30:.2f} GiB; middle {middle:.6f}/mm, expected {VALUE}")


if __name__ == "__main__":
    main()
