"""Counts behind pinholes by the footprints of voxels, with a matched adjoint.

For camera c and voxel v, the sum over pixels of A is s(c, v) = (area of the hole) cos^3 / (4 pi
h^2) times the voxel's volume and exp(-integral of mu from the voxel to the pinhole), by
construction, for any pixels, angles and grids, if the detector holds the footprint. The voxel's
view is the image of its box, of the hole and of the detector's resolution, integrated over each
pixel; see `mvrecon_spect.kernels.reference`.

Limits: the image of a round hole is a product of profiles along u and v, of the right variance and
kurtosis, not a disc, which shows if it is several pixels wider than the object's detail.
Perspective within a voxel is not modelled, and voxels that a pinhole's plane cuts or touches
contribute nothing.
"""

import math
from collections.abc import Iterator, Sequence
from copy import copy
from types import SimpleNamespace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.data.resample import resample
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Box, Grid
from mvrecon.kernels.operator import accumulation_dtype, choose_backend, to_accumulation_dtype
from mvrecon.kernels.self_test import Errors
from mvrecon.operators.checks import check, check_floating
from mvrecon.operators.memo import FixedGeometry, grid_key, kept
from mvrecon.operators.operator import Cropped, LinearOperator, PixelIntegral, Projector, Scaled
from mvrecon.operators.selection import ViewSelection
from mvrecon_spect.kernels import ops, reference
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.operators.matter import Matter
from mvrecon_spect.operators.path_integrals import path_integrals
from mvrecon_spect.operators.response import Response, geometric, record_of

#: Maximum bytes of the cached transmission of an operator; bytes of a part that is computed anew in
#: every call otherwise.
MOST_KEPT, PART = 2**30, 2**27
#: Correlation of a voxel's image along u and v, with its pixel, above which long voxels are split.
OBLIQUE = 0.1
#: Ratio of edges, and most parts of a voxel along an axis.
LONG, MOST_PARTS = 1.5, 8
#: Lines each way over a pixel of `pixel_integral`, if it is wider than half a voxel's image.
ACROSS = 4


class Footprints(FixedGeometry):
    """Counts [b c m v u] behind pinholes of volumes [b c d h w] in counts / mm^3.

    Differentiable in the volume, in mu, and in the cameras, to any order in the volume and the
    views. Results are bitwise reproducible, for any number of threads; zero voxels and footprints
    beside the detector are skipped. The transmission from each voxel to each
    pinhole is cached beside mu, up to 1 GiB, until mu changes; the operator of a subset takes its
    part of it.

    Args:
        grid: grid of the activity.
        cameras: pinholes with detectors perpendicular to their axes.
        hole: effective area and acceptance.
        response: widths of the image of a point.
        matter: linear attenuation and its grid; None: none.
        backend: see `choose_backend`.
    """

    mu: Tensor | None
    fixed_rig: Tensor | None
    capabilities = frozenset({"refine"})

    def __init__(
        self,
        grid: Grid,
        cameras: Cameras,
        hole: Hole,
        response: Response,
        matter: Matter | None = None,
        backend: str = "auto",
    ):
        super().__init__()
        self.built_from(grid, cameras)
        self.hole, self.response = hole, response
        self.backend, self.last_backend = backend, ""
        self.matter = grid if matter is None else matter.grid
        self.register_buffer("mu", None if matter is None else matter.mu, persistent=False)
        self.domain_shape, self.range_shape = grid.shape, (len(cameras), *cameras.shape)
        self.fine = grid
        with torch.inference_mode(False), torch.no_grad():  # else no derivative could save them
            self.parts = parts_of(self._record(), grid)
            self.fine = parted(grid, self.parts)
            fixed = None if self.pose_gradient else self._record()
        vectors = [getattr(cameras, name).detach().cpu() for name in VECTORS]
        self.poses = tuple(row.tobytes() for row in torch.cat(vectors, dim=1).numpy())
        self.register_buffer("fixed_rig", fixed, persistent=False)
        self.register_buffer("place", torch.zeros(()), persistent=False)
        self.last_clear = self.clear

    def _record(self) -> Float[Tensor, "m c"]:
        return record_of(self.cameras, self.fine, self.hole, self.response)

    def _apply(self, fn, recurse: bool = True) -> "Footprints":
        exact, clear = (self.fixed_rig, self.mu), self.clear
        super()._apply(fn, recurse)  # moves them, without loss of precision
        self.fixed_rig, self.mu = (None if t is None else t.to(self.device) for t in exact)
        if self.mu is not None:  # known without synchronisation with a GPU
            kept(self.mu, "is zero", lambda: clear)
        return self

    @property
    def device(self) -> torch.device:
        return self.place.device

    @property
    def rig(self) -> Float[Tensor, "m c"]:
        """The record of each pinhole; with a graph if the cameras require a gradient."""
        fixed = None if self.pose_gradient else self.fixed_rig
        return self._record() if fixed is None else fixed

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Project volumes to views.

        Raises:
            ValueError: a wrong rank, size, device or dtype.
            RuntimeError: the cameras or the grid were changed in place.
        """
        self.check_unchanged()
        check(x, "a volume [b c d h w]", self.domain_shape, self.device)
        check_floating(x, "a volume")
        volume = to_accumulation_dtype(x).flatten(0, 1)
        for axis, part in enumerate(self.parts, start=1):
            volume = volume.repeat_interleave(part, dim=axis) if part > 1 else volume
        project, rig, views = self._kernels(x).project, self.rig, []
        detector = list(self.cameras.shape)
        for some, passed in self._passes():
            values = volume
            if passed is not None and passed.requires_grad:
                values, passed = volume * passed[0].to(volume), None
            views.append(project(values, rig[some], detector, passed))
        return torch.cat(views, dim=1).unflatten(0, x.shape[:2])

    def adjoint(self, y: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """The exact transpose of `forward`; raises the same errors."""
        self.check_unchanged()
        check(y, "views [b c m v u]", self.range_shape, self.device)
        check_floating(y, "views")
        views, volume = to_accumulation_dtype(y).flatten(0, 1), None
        backproject, rig, size = self._kernels(y).backproject, self.rig, list(self.fine.shape)
        for some, passed in self._passes():
            own = views[:, some].contiguous()
            if passed is not None and passed.requires_grad:
                one = backproject(own, rig[some], size, None) * passed[0].to(own)
            else:
                one = backproject(own, rig[some], size, passed)
            volume = one if volume is None else volume + one
        assert volume is not None  # a rig has a camera
        for axis, part in enumerate(self.parts, start=1):
            volume = volume.unflatten(axis, (-1, part)).sum(dim=axis + 1) if part > 1 else volume
        return volume.unflatten(0, y.shape[:2])

    def _kernels(self, tensor: Tensor):
        self.last_backend = choose_backend(tensor, self.backend, "footprints", self_test)
        return REFERENCE if self.last_backend == "reference" else ops

    def _passes(self) -> Iterator[tuple[slice, Float[Tensor, "m d h w"] | None]]:
        """Slices of the cameras, with the transmission from each voxel to each pinhole: all at once
        if it is cached, and one by one if it requires a gradient.
        """
        count, mu = len(self.cameras), self.mu
        if mu is None or self.clear:
            yield slice(0, count), None
            return
        moving = torch.is_grad_enabled() and (mu.requires_grad or self.pose_gradient)
        size = math.prod(self.fine.shape) * accumulation_dtype(mu.dtype).itemsize
        if not (moving or mu.requires_grad or self.pose_gradient) and count * size <= MOST_KEPT:
            yield slice(0, count), self._kept(mu)
            return
        step = 1 if moving else max(PART // size, 1)
        for first in range(0, count, step):
            some = slice(first, min(first + step, count))
            yield some, self._transmission(some)

    @torch.compiler.disable
    def _kept(self, mu: Tensor) -> Float[Tensor, "m d h w"]:
        """The transmission, cached beside mu by cameras; that of a subset is a part of it."""
        key = "transmission", grid_key(self.matter), grid_key(self.fine), self.cameras.shape
        known: dict[tuple[bytes, ...], Tensor] = kept(mu, key, dict)
        for cameras, made in list(known.items()):  # other threads may add
            if cameras == self.poses:
                return made
            if set(self.poses) <= set(cameras):
                return made[[cameras.index(pose) for pose in self.poses]]
        with torch.inference_mode(False), torch.no_grad():
            made = self._transmission(slice(0, len(self.cameras)))
        if sum(part.nbytes for part in known.values()) + made.nbytes <= MOST_KEPT:
            known[self.poses] = made
        return made

    @torch.compiler.disable
    def _transmission(self, some: slice) -> Float[Tensor, "m d h w"]:
        assert self.mu is not None
        cameras = self.cameras[list(range(*some.indices(len(self.cameras))))]
        return path_integrals(self.mu, self.matter, cameras, self.fine).neg().exp()

    @property
    def clear(self) -> bool:
        """Whether mu is zero everywhere and requires no gradient; as at the last call in programs
        of `torch.export`.
        """
        mu = self.mu
        if mu is None or mu.requires_grad:
            return mu is None
        if not torch.compiler.is_exporting():
            self.last_clear = _is_zero(mu)
        return self.last_clear

    def subset(self, selection: LinearOperator) -> LinearOperator:
        """The operator of a subset of cameras; subsets of pixels are computed from full views."""
        if not isinstance(selection, ViewSelection):
            return super().subset(selection)
        return self._like(self.grid, selection.views)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> Projector:
        """The same operator for activity in a box and a subset of the cameras, with the full
        attenuation map.
        """
        return self._like(self.grid.cropped(box), views)

    def refined(self, factor: int) -> Projector:
        """The same operator on a finer grid, with the same attenuation map."""
        return self._like(self.grid.refined(factor), None)

    def _like(self, grid: Grid, views: Sequence[int] | None) -> Projector:
        if views is not None and self.pose_gradient:  # selected vectors would not follow the rig
            return Cropped(self._like(grid, None), Box.whole(grid.shape), views)
        cameras = self.cameras if views is None else self.cameras[list(views)]
        matter = None if self.mu is None else Matter(self.mu, self.matter)
        other = Footprints(grid, cameras, self.hole, self.response, matter, self.backend)
        return other.to(self.device)

    def with_mu(self, mu: Float[Tensor, "d h w"]) -> "Footprints":
        """The same operator with another attenuation on its grid, in 1/mm; it shares the rest."""
        other = copy(self)
        other._buffers = {**self._buffers, "mu": mu}
        other.matter = self.grid
        return other.to(self.device)

    def with_support(self, support: Bool[Tensor, "d h w"] | None) -> LinearOperator:
        return self if support is None else Scaled(self, voxels=support.to(self.device))

    def mu_map(self) -> Float[Tensor, "d h w"] | None:
        """mu on the grid of the activity, or None if it is zero everywhere."""
        if self.mu is None or self.clear:
            return None
        same = self.matter is self.grid
        return self.mu if same else resample(self.mu, self.matter, self.grid).clamp_min(0)

    def pixel_integral(self) -> PixelIntegral | None:
        """The sensitivity of a pixel times the mean over lines; None with blur or attenuation."""
        if not self.clear or self.response != Response():
            return None
        rays = ACROSS if pixel_in_voxels(self.cameras, self.grid) > 0.5 + 1e-6 else 1
        return PixelIntegral(self.hole.weight(self.cameras), rays)


@torch.compiler.disable
def _is_zero(mu: Tensor) -> bool:
    """Whether a map is zero now, also between the graphs of `torch.compile`, which would keep the
    answer of their first call.
    """
    return kept(mu, "is zero", lambda: not bool((mu != 0).any()))


#: The operators by the reference.
REFERENCE = SimpleNamespace(
    project=ops.FOOTPRINTS.apply, backproject=ops.FOOTPRINTS.apply_transpose
)


def self_test(device: str, dtype: torch.dtype, purpose: str) -> Errors:
    """Blurred pinholes with attenuation."""
    grid, hole = Grid.centred(size=(5, 6, 7), spacing=(22.0, 20.0, 18.0)), Hole(4.0)
    cameras = dcspect80(pixels=[9, 8], columns=[0, 7, 13], rows=[1])
    rig = record_of(cameras, grid, hole, geometric(hole, 3.0)).to(device)
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(2, *grid.shape, generator=generator).to(device, dtype)
    passed = torch.rand(len(rig), *grid.shape, generator=generator).to(device)
    yield from ops.FOOTPRINTS.self_test(x, rig, list(cameras.shape), passed)


def pixel_in_voxels(cameras: Cameras, grid: Grid) -> float:
    """Width of a pixel's image at the grid's centre in voxels, as median over the cameras."""
    pitch = torch.maximum(cameras.u.norm(dim=-1), cameras.v.norm(dim=-1)).detach()
    depth = cameras.project(grid.centre.to(cameras.source))[:, 2].detach()
    width = (pitch * (depth / cameras.distance.detach()).abs()).median().item()
    return width / min(grid.spacing)


def parted(grid: Grid, parts: tuple[int, int, int]) -> Grid:
    """The grid of the parts of voxels, of so many along (z, y, x)."""
    steps = torch.tensor(parts[::-1], dtype=torch.float64)
    affine = grid.affine.clone()
    affine[:3, :3] /= steps
    affine[:3, 3] = grid.to_world((1 - steps) / (2 * steps))
    d, h, w = (n * part for n, part in zip(grid.shape, parts, strict=True))
    return Grid((d, h, w), affine)


def parts_of(rig: Float[Tensor, "m c"], grid: Grid) -> tuple[int, int, int]:
    """Parts of a voxel along (z, y, x) whose images are nearly products of profiles along u and v.

    Only voxels with long edges are split, and only if their image at the grid's centre, with the
    hole's and a pixel, is oblique on the detector.
    """
    # to six decimals, so that rounding decides no number
    edges = [round(edge / min(grid.spacing), 6) for edge in grid.spacing[::-1]]
    if max(edges) < LONG:
        return 1, 1, 1
    z, y, x = (min(math.ceil(edge - 0.1), MOST_PARTS) for edge in edges)
    index = torch.cat([grid.centre_index, grid.centre_index.new_ones(1)])[None].to(rig)
    for record in rig:
        prints, w = reference.footprints(record, index), index @ record[reference.OF_W]
        images = reference.edges_of(record, prints.centre, w)
        spread = (prints.variance + 1 / 12).prod().sqrt()
        if (images.prod(dim=0).sum() / 12 / spread).abs() > OBLIQUE:
            return z, y, x
    return 1, 1, 1
