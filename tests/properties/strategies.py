"""Random geometry: grids, rigs about them and volumes, all in units of the grid's own size so that
rays meet it.
"""

import itertools
import math
from dataclasses import replace

import torch
from hypothesis import strategies as st
from torch import Tensor

from mvrecon.geometry.cameras.camera import EXTENTS, Cameras
from mvrecon.geometry.grid import Grid
from tests.operators.cases import Case

METHODS = ("joseph", "siddon", "trilinear")
DTYPES = (torch.float32, torch.float64)
SEEDS = st.integers(0, 2**20)


def real(least: float, most: float) -> st.SearchStrategy[float]:
    return st.floats(least, most, allow_nan=False, allow_subnormal=False)


def vectors(least: float, most: float, size: int = 3) -> st.SearchStrategy[Tensor]:
    """Vectors whose components lie in a range, often round numbers."""
    each = real(least, most) | st.sampled_from(
        [x for x in (-1.0, -0.5, 0.0, 0.5, 1.0) if least <= x <= most]
    )
    return st.lists(each, min_size=size, max_size=size).map(
        lambda x: torch.tensor(x, dtype=torch.float64)
    )


def quaternion_rotation(q: Tensor) -> Tensor:
    """The rotation of a quaternion (w, x, y, z) of any length."""
    w, x, y, z = (q / q.norm()).tolist()
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.tensor(rows, dtype=torch.float64)


def cube_rotations() -> list[Tensor]:
    """The 24 rotations that take the axes to one another."""
    eye = torch.eye(3, dtype=torch.float64)
    signs = [torch.tensor(s, dtype=torch.float64) for s in itertools.product((1.0, -1.0), repeat=3)]
    every = [
        eye[list(order)] * sign for order in itertools.permutations(range(3)) for sign in signs
    ]
    return [turn for turn in every if torch.linalg.det(turn) > 0]


CUBE = st.sampled_from(cube_rotations())
TURNS = vectors(-1, 1, 4).filter(lambda q: q.norm() > 0.1).map(quaternion_rotation)
ROTATIONS = CUBE | TURNS


def upright(angle: float) -> Tensor:
    """A camera's axes (right, down, forward) that looks along a direction in the plane z = 0, its
    columns along -z.
    """
    x, y = math.cos(angle), math.sin(angle)
    return torch.tensor([[y, -x, 0.0], [0.0, 0.0, -1.0], [x, y, 0.0]], dtype=torch.float64)


#: Columns along z are read by loops of their own.
POSES = ROTATIONS | real(-math.pi, math.pi).map(upright)


@st.composite
def grids(draw: st.DrawFn, away: float = 10.0) -> Grid:
    """1 to 9 voxels along each axis, or some more along z, of 1e-3 to 1e3 mm, isotropic or not,
    turned or sheared.

    Its centre lies up to ten sizes away from the origin.
    """
    d, h, w = draw(st.tuples(*[st.integers(1, 9)] * 3))
    shape = (d + draw(st.sampled_from([0, 0, 8])), h, w)
    step = 10 ** draw(real(-3, 3) | st.just(0.0))
    ratio = draw(st.just(torch.ones(3, dtype=torch.float64)) | vectors(0.1, 2.0))
    linear = step * torch.diag(ratio)
    if draw(st.booleans()):
        shear = torch.eye(3, dtype=torch.float64)
        shear[0, 1:], shear[1, 2] = draw(vectors(-0.5, 0.5, 2)), draw(real(-0.5, 0.5))
        linear = draw(ROTATIONS) @ shear @ linear
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] = linear
    grid = Grid(shape, affine)
    affine[:3, 3] = draw(vectors(-away, away)) * radius(grid) - grid.centre
    return Grid(shape, affine)


def radius(grid: Grid) -> float:
    """Half the grid's longest diagonal in mm."""
    return (grid.corners() - grid.centre).norm(dim=1).max().item()


@st.composite
def rigs(
    draw: st.DrawFn,
    grid: Grid,
    parallel: bool | None = None,
    extents: tuple[str, ...] = tuple(EXTENTS),
) -> Cameras:
    """1 to 3 central or parallel cameras with 1 to 9 x 1 to 9 pixels whose sources are inside, on
    or outside.
    """
    parallel = draw(st.booleans()) if parallel is None else parallel
    extent = draw(st.sampled_from(extents))
    shape = draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    cameras = [
        draw(_cameras(grid, parallel, extent, shape)) for _ in range(draw(st.integers(1, 3)))
    ]
    joined = {
        name: torch.cat([getattr(each, name) for each in cameras])
        for name in ("source", "origin", "u", "v")
    }
    return replace(cameras[0], **joined)


@st.composite
def _cameras(
    draw: st.DrawFn, grid: Grid, parallel: bool, extent: str, shape: tuple[int, int]
) -> Cameras:
    r = radius(grid)
    right, down, forward = draw(POSES)
    target = grid.centre + r * draw(vectors(-0.5, 0.5))
    near = r * draw(real(0.0, 0.9) | st.sampled_from([1.0, 1.5, 10.0, 1000.0]))
    magnified = draw(real(0.1, 3.0) | st.sampled_from([1.0, 1.5, 2.0]))
    reach = magnified * max(near, 0.3 * r)
    width = 2 * r * (1.0 if parallel else magnified) * draw(real(0.1, 1.5) | st.just(1.0))
    u = right * width / shape[1]
    v = (
        (down + draw(st.just(0.0) | real(-0.4, 0.4)) * right)
        * width
        / shape[0]
        * draw(st.just(1.0) | real(0.3, 2.0))
    )
    source = target - near * forward
    middle = source + (-reach if extent == "behind" else reach) * forward
    offset = draw(st.just((0.0, 0.0)) | st.tuples(real(-2, 2), real(-2, 2)))
    corner = -u * ((shape[1] - 1) / 2 + offset[0]) - v * ((shape[0] - 1) / 2 + offset[1])
    start = source + corner if parallel else source
    return Cameras(start[None], (middle + corner)[None], u[None], v[None], shape, parallel, extent)  # type: ignore[arg-type]


@st.composite
def cases(draw: st.DrawFn, **options) -> Case:
    """A grid and a rig about it."""
    grid = draw(grids())
    return Case(grid, draw(rigs(grid, **options)))


@st.composite
def volumes(
    draw: st.DrawFn, shape: tuple[int, ...], dtype: torch.dtype = torch.float64, signed: bool = True
) -> Tensor:
    """Values [1 c *shape] of noise, with zeros, with 1e-30 and 1e30 among them, or all zero."""
    rng = torch.Generator().manual_seed(draw(SEEDS))
    x = (
        torch.rand(1, draw(st.sampled_from([1, 1, 4])), *shape, generator=rng, dtype=torch.float64)
        + 0.1
    )
    kind = draw(st.sampled_from(["noise", "sparse", "wild", "small", "great", "one", "none"]))
    if signed:
        x *= torch.randint(0, 2, x.shape, generator=rng) * 2 - 1
    if kind in ("sparse", "wild"):
        x *= torch.rand(x.shape, generator=rng) < 0.4
    if kind == "wild":
        x *= torch.tensor([1e-30, 1.0, 1e30])[torch.randint(0, 3, x.shape, generator=rng)]
    if kind == "one":
        x *= torch.arange(x.numel()).reshape(x.shape) == draw(SEEDS) % x.numel()
    return (x * {"small": 1e-30, "great": 1e30, "none": 0.0}.get(kind, 1.0)).to(dtype)


def epsilon(dtype: torch.dtype) -> float:
    return torch.finfo(dtype).eps
