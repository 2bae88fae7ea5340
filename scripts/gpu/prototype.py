"""What hand-written kernels reach on a GPU: the prototype `joseph.cu`, checked against the
reference, and timed beside the project's own back end.

    python scripts/gpu/prototype.py --check       # in main memory, by g++: right or not; no GPU
    python scripts/gpu/prototype.py --out FOLDER  # on the GPU: right or not, then times
"""

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from kernels import BLOCK, Gpu, Host, Scene
from measuring import Results, on_device, reason, throughput

import mvrecon as mv
from mvrecon.kernels.rays import reference
from mvrecon.parts import PROJECTORS
from mvrecon.projectors.ray_transform import RayTransform

#: Detector rows that a block of threads takes; a bound of a ray without an end; the allowed error.
ROWS, FAR, TOLERANCE = 32, 1e200, 3e-6
SIZES = ((64, 8), (128, 32), (256, 180), (512, 720))


def frames_of(lines: torch.Tensor) -> torch.Tensor:
    """[m 3 4] from voxels about the centre to (u w, v w, w) about the detector's centre, scaled to
    size one.
    """
    direction, start = lines[:, 0], lines[:, 2]
    parallel = bool((direction[..., :2] == 0).all())
    basis = torch.cat([start[..., :2], direction[..., 2:]], -1) if parallel else direction
    inverse = torch.linalg.inv(basis)
    P = torch.cat([inverse, -inverse @ start[..., 2:]], -1)
    if parallel:
        P = torch.cat([P[:, :2], P.new_tensor([0, 0, 0, 1]).expand(len(P), 1, 4)], 1)
    return (P / P[:, 2].abs().sum(-1)[:, None, None]).float().contiguous()


def steep(lines: torch.Tensor, rows: int, columns: int) -> bool:
    """Whether some ray's main axis may be z."""
    u, v = (columns - 1) / 2, (rows - 1) / 2
    places = [[a * u, b * v, 1.0] for a in (-1, 0, 1) for b in (-1, 0, 1)]
    ways = torch.einsum("mxc,rc->mrx", lines[:, 0], torch.tensor(places, dtype=torch.float64)).abs()
    return bool((ways[..., 2] >= ways[..., :2].amax(-1) * (1 - 1e-6)).any())


class Joseph:
    """A and its transpose by the prototype's kernels, volumes [n d h w] to views [n m v u]."""

    def __init__(self, A: RayTransform, kernels: Host | Gpu):
        lines = A.fixed_lines.double().cpu()
        self.kernels, self.shape = kernels, A.domain_shape
        self.n_views, self.rows, self.columns = A.range_shape
        self.steep = steep(lines, self.rows, self.columns)
        self.lines = lines.to(kernels.device).contiguous()
        self.frames = frames_of(lines).to(kernels.device)
        low, high = (min(max(float(end), -FAR), FAR) for end in A.ray_extent)
        self.scene = Scene(lines=self.lines.data_ptr(), frames=self.frames.data_ptr())
        self.scene.sizes[:] = self.shape[::-1]
        self.scene.window[:] = low, high
        self.scene.views_, self.scene.rows, self.scene.columns = A.range_shape

    def _groups(self, count: int) -> int:
        return -(-count // self.kernels.nv)

    def _store(self, x: torch.Tensor, tall: bool) -> torch.Tensor:
        cells = math.prod(n + 3 for n in self.shape)
        store = torch.empty(self._groups(len(x)), cells, self.kernels.nv, device=x.device)
        self.kernels.store(x, store, tall, -(-cells // BLOCK))
        return store

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """A x."""
        tall = self._store(x, True)
        flat = self._store(x, False) if self.steep else None
        views = torch.empty(len(x), self.n_views, self.rows, self.columns, device=x.device)
        s = self.scene
        s.tall, s.flat = tall.data_ptr(), 0 if flat is None else flat.data_ptr()
        s.views, s.count = views.data_ptr(), len(x)
        blocks = self.n_views * -(-self.rows // ROWS) * -(-self.columns // 4)
        self.kernels.run("project", s, blocks, self._groups(len(x)))
        return views

    def adjoint(self, y: torch.Tensor) -> torch.Tensor:
        """A^T y."""
        groups, pixels = self._groups(len(y)), y[0].numel()
        rays, ends = (torch.empty(pixels, 4, device=y.device) for _ in range(2))
        values = torch.empty(groups, pixels, self.kernels.nv, device=y.device)
        flags = torch.zeros(self.n_views, dtype=torch.int32, device=y.device)
        volume = torch.empty(len(y), *self.shape, device=y.device)
        s = self.scene
        s.views, s.rays, s.ends = y.data_ptr(), rays.data_ptr(), ends.data_ptr()
        s.values, s.flags = values.data_ptr(), flags.data_ptr()
        s.volume, s.count = volume.data_ptr(), len(y)
        self.kernels.run("record", s, -(-pixels // BLOCK), groups)
        self.kernels.run("gather", s, -(-math.prod(self.shape) // BLOCK), groups)
        return volume


def small_cases() -> dict[str, tuple[mv.Grid, mv.Cameras]]:
    """Grids and rigs that the reference does in a moment."""
    detector = {"pixels": [18, 21], "pixel_mm": 2.3}
    grid = mv.Grid.centred(size=(10, 14, 12), spacing=(1.9, 2.1, 2.3))
    return {
        "cone": (grid, mv.circular(5, 100.0, 150.0, detector, start_degrees=3.0)),
        "parallel": (grid, mv.parallel(4, detector, start_degrees=3.0)),
        "dome": (grid, mv.dome(5, 90.0, 40.0, 140.0, {**detector, "pixel_mm": 1.1})),
    }


def worst_error(kernels: Host | Gpu) -> float:
    """The greatest difference from the reference, and of the two inner products, relative."""
    worst = 0.0
    for grid, rig in small_cases().values():
        kind = "radon" if rig.parallel else "drr"
        A = PROJECTORS.build(kind, grid=grid, cameras=rig)
        J, rng = Joseph(A, kernels), torch.Generator().manual_seed(0)
        geometry = A.fixed_lines, A.ray_extent
        for count in (1, 5):
            x = torch.rand(count, *grid.shape, generator=rng)
            y = torch.rand(count, len(rig), *rig.shape, generator=rng)
            views = reference.project(x.double(), *geometry, list(rig.shape), "joseph")
            volume = reference.backproject(y.double(), *geometry, list(grid.shape), "joseph")
            Jx = J.forward(x.to(kernels.device)).cpu().double()
            Jty = J.adjoint(y.to(kernels.device)).cpu().double()
            gap = ((Jx * y).sum() - (x * Jty).sum()).abs() / (Jx.norm() * y.double().norm())
            forward = (Jx - views).abs().max() / views.abs().max()
            adjoint = (Jty - volume).abs().max() / volume.abs().max()
            worst = max(worst, float(gap), float(forward), float(adjoint))
    return worst


def calls_of(n: int, n_views: int, count: int) -> dict[str, Callable[[], torch.Tensor]]:
    """The prototype and the back end on the same volumes and views."""
    detector = {"pixels": [n, n], "pixel_mm": 1.536 * 256.0 / n}
    rig = mv.circular(n_views, 1000.0, 1536.0, detector, start_degrees=3.0)
    A = mv.Drr(mv.Grid.centred(n, spacing=256.0 / n), rig, skip="off").to("cuda")
    J = Joseph(A, Gpu(1 if count == 1 else 4))
    x = torch.rand(count, *A.domain_shape, device="cuda")
    y = torch.rand(count, *A.range_shape, device="cuda")
    return {
        "prototype forward": lambda: J.forward(x),
        "prototype adjoint": lambda: J.adjoint(y),
        "back end forward": lambda: A(x[:, None]),
        "back end adjoint": lambda: A.T(y[:, None]),
    }


def times(results: Results, largest: int, seconds: float) -> None:
    """Milliseconds on the device, case by case, until the time is up."""
    begin = time.perf_counter()
    for n, n_views in SIZES:
        for count in (1, 8):
            late = time.perf_counter() - begin > seconds
            if n > largest or late or count * n**3 > 2**30:
                continue
            row = {"n": n, "n_views": n_views, "volumes": count}
            try:
                for what, call in calls_of(n, n_views, count).items():
                    with torch.no_grad():
                        results.row(**row, what=what, ms=throughput(call, "cuda")[0])
            except Exception as error:
                results.row(**row, what=reason(error))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    mode = parser.add_mutually_exclusive_group(required=True)
    mode.add_argument("--check", action="store_true")
    mode.add_argument("--out", type=Path)
    parser.add_argument("--largest", type=int, default=512)
    parser.add_argument("--seconds", type=float, default=240.0)
    options = parser.parse_args()
    kernels = Host if options.check else Gpu
    on_device("cpu" if options.check else "cuda")
    worst = max(worst_error(kernels(nv)) for nv in (1, 4))
    print(f"greatest relative error {worst:.1e}, allowed {TOLERANCE:.0e}", flush=True)
    if options.check:
        sys.exit(worst >= TOLERANCE)
    times(Results(options.out, "prototype"), options.largest, options.seconds)


if __name__ == "__main__":
    main()
