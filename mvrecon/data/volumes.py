"""Scenes of CT volumes from files: HU to attenuation, the patient centred in the grid, views from a
finer grid.

The grid is the field of view: everything outside of its box is cut off, in the true volume and in
the views.
"""

import math
import warnings
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import data_range_of, generator, uniform
from mvrecon.data.attenuation import UNITS, WATER, StoredUnit, check_spread, physical
from mvrecon.data.body import body, body_box, enclosed
from mvrecon.data.hdf5 import VolumeFile
from mvrecon.data.resample import Slabs, cut, parallel, resample, reversed_axes
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.data.volume_files import name_of, open_volume, volumes_in
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.operators.ray_transform import RayTransform

#: Range of a varied copy's pose: degrees about each axis, relative scale, mm along each axis.
MAX_TURN_DEGREES, MAX_SCALE_CHANGE, MAX_SHIFT_MM = 10.0, 0.1, 20.0


class Placed(NamedTuple):
    """A case of a file: its attenuation, the grids of its voxels in the file's and the case's
    world, in mm, and whether it is mirrored left to right.
    """

    name: str
    mu: Slabs
    source: Grid
    grid: Grid
    mirrored: bool = False


def moved(
    grid: Grid,
    pivot: Float[Tensor, "3"],
    target: Float[Tensor, "3"],
    rng: torch.Generator | None,
    exact: bool = False,
) -> Grid:
    """Move a grid from one point to another; with `rng` also rotate, scale and shift it about that
    at random. An exact move only shifts, so that axes stay parallel.
    """
    linear = torch.eye(3, dtype=torch.float64)
    if rng is not None and not exact:
        angles = [uniform(rng, -MAX_TURN_DEGREES, MAX_TURN_DEGREES) for _ in range(3)]
        linear = uniform(rng, 1 - MAX_SCALE_CHANGE, 1 + MAX_SCALE_CHANGE) * euler_rotation(
            angles, "xyz"
        )
    if rng is not None:
        target = target + torch.tensor(
            [uniform(rng, -MAX_SHIFT_MM, MAX_SHIFT_MM) for _ in range(3)], dtype=torch.float64
        )
    affine = grid.affine.clone()
    affine[:3, :3] = linear @ affine[:3, :3]
    affine[:3, 3] = linear @ (affine[:3, 3] - pivot) + target
    return Grid(grid.shape, affine)


#: Threshold of tissue: -400 HU to find the patient, a quarter of water to check voxels.
SKIN, TISSUE = 0.6 * WATER, 0.25 * WATER
#: Share of the grid; a patient that fills less is probably not in mm.
MIN_PATIENT_SHARE = 0.002
#: Voxels of the finer grid by default, half a GiB: the same on every machine, as cases must be.
MAX_FINE_VOXELS = 2**27
#: Maximum voxels of a file kept in memory, 2 GiB.
MAX_KEPT_VOXELS = 2**29
Crop = Literal["body", "none"]


@dataclass(kw_only=True)
class FileScene(Scene):
    """CT volumes as cases, in their true size.

    Args:
        path: path of the file.
        crop: "body" moves the centre of the patient's box to the grid's centre, "none" keeps the
            file's position (about the origin if the file has none).
        fine: refinement of the grid that views are projected from relative to the true volume's; at
            least 2. None: 4, or 3 or 2 where that would exceed 2^27 voxels: 4 for grids of up to
            128^3. 2 flatters iterative methods: the views are nearly those of their own voxels.
        own_voxels: project the file's own voxels, cut at the grid's box, instead of a finer grid's:
            several times as fast where the grid is about as fine as the file. Ignores `fine`.
        rays: a pixel measures the mean over rays x rays lines of sight.
        vary: continue beyond the last case with varied copies, new in every pass: True mirrors left
            to right, rotates, scales and shifts at random; "exact" only mirrors and shifts, without
            interpolation, the same for every seed.
        data_range: range of values for PSNR and SSIM, in 1/mm; of activity in its unit. 0.04 is
            twice water, the usual window of -1000 to 1000 HU.
        stored_unit: unit of the numbers in the file: HU (converted by `data.attenuation`), 1/mm, or
            activity, which are projected unchanged.

    Raises:
        ValueError: an unknown crop or unit, or numbers that are too small.
    """

    path: str | Path
    crop: Crop = "body"
    fine: int | None = None
    own_voxels: bool = False
    rays: int = 2
    vary: bool | Literal["exact"] = False
    data_range: float = 0.04
    stored_unit: StoredUnit = "HU"
    unit: str = field(default="1/mm", init=False)

    def __post_init__(self) -> None:
        if self.stored_unit not in UNITS:
            raise ValueError(f"stored_unit must be one of {UNITS}, got {self.stored_unit!r}")
        self.unit = "activity" if self.stored_unit == "activity" else "1/mm"
        if self.vary not in (True, False, "exact"):
            raise ValueError(f"vary must be true, false or 'exact', got {self.vary!r}")
        if self.crop not in ("body", "none"):
            raise ValueError(f"crop must be 'body' or 'none', got {self.crop!r}")
        self.data_range = data_range_of(self.data_range)
        if (self.fine is not None and self.fine < 2) or self.rays < 1:
            raise ValueError(
                f"A scene from a file needs fine >= 2 and rays >= 1, got fine {self.fine}, rays "
                f"{self.rays}"
            )
        self._kept: dict[int, tuple[str, Slabs, Grid]] = {}
        self._pivots: dict[tuple[int, bool], Float[Tensor, 3]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": {}}

    @property
    @abstractmethod
    def length(self) -> int:
        """The number of cases in the file."""

    @abstractmethod
    def case(self, index: int) -> tuple[str, Slabs, Grid]:
        """Return name, values in the stored unit and grid of a case, as in the file."""

    def seed_of(self, index: int, seed: int) -> int:
        """The seed on which the case `index` of the series `seed` depends: 0 for cases as in the
        file and their exact moves, which all series share.
        """
        return seed if index >= self.length and self.vary != "exact" else 0

    def factor(self, grid: Grid) -> int:
        """Refinement factor of the grid that views are projected from."""
        size = math.prod(grid.shape)
        return self.fine or next((k for k in (4, 3) if size * k**3 <= MAX_FINE_VOXELS), 2)

    def sample(self, index: int, seed: int, grid: Grid, cameras: Cameras) -> Sample:
        """Return a case seen by `cameras`, with its true volume on `grid`.

        Raises:
            IndexError: the file has no such case.
            ValueError: values that are not finite, or no patient in the volume.
        """
        case = self._placed(index, seed, grid)
        factor = self.factor(grid)
        if self.own_voxels:
            factor = 1 if parallel(case.grid, grid) else 2
        on = grid.refined(factor)
        fine = resample(case.mu, case.grid, on)
        unseen = self._unseen(case.name, fine[None], factor)
        if self.own_voxels:
            fine, on = cut(case.mu.whole(), case.grid, grid), case.grid
        return replace(unseen, views=self._views(fine, on, cameras))

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Any, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """The case's attenuation in 1/mm on `grid.refined(factor)`, from the grid of the views if
        that is a multiple.
        """
        case, between = self._placed(index, seed, grid), max(1, self.factor(grid) // factor)
        fine = resample(case.mu, case.grid, grid.refined(factor * between))
        return F.avg_pool3d(fine[None], between)

    def pooled(
        self, index: int, seed: int, grid: Grid, cameras: Any, fine: Float[Tensor, "1 d h w"]
    ) -> Sample:
        """Return the case with arbitrary views; without any [1 0 0 0] where the values of `finer`
        are those that `sample` averages.
        """
        factor = fine.shape[-1] // grid.shape[-1]
        if self.own_voxels or factor != self.factor(grid):
            return super().pooled(index, seed, grid, cameras, fine)
        return self._unseen(self._placed(index, seed, grid).name, fine, factor)

    def _unseen(self, name: str, fine: Float[Tensor, "1 d h w"], factor: int) -> Sample:
        """A case without views [1 0 0 0], from its values on a grid `factor` times finer."""
        truth = F.avg_pool3d(fine, factor)
        inside = enclosed(body(truth[0], self._above(TISSUE)))
        if inside.float().mean() < MIN_PATIENT_SHARE:
            warnings.warn(
                f"{self.path}: {name} fills {int(inside.sum())} of {inside.numel()} voxels of "
                f"the grid; is the spacing in its file mm, and not cm?",
                stacklevel=3,
            )
        return Sample(truth.new_zeros(1, 0, 0, 0), truth, inside[None], name)

    def placement(self, index: int, seed: int, grid: Grid) -> Float[Tensor, "4 4"]:
        """The affine map in mm from the file's world to the case's: a crop's shift, and the
        rotation and scale of a varied copy after its mirroring.
        """
        case = self._placed(index, seed, grid)
        return case.grid.affine @ torch.linalg.inv(case.source.affine)

    def _placed(self, index: int, seed: int, grid: Grid) -> Placed:
        turn, case = divmod(index, self.length)
        if index < 0 or (turn and not self.vary):
            raise IndexError(
                f"{self.path} has {self.length} case(s), got index {index}; `vary: true` adds "
                f"varied ones"
            )
        name, mu, source = self._kept[case] if case in self._kept else self._read(case)
        seed = self.seed_of(index, seed)
        rng = generator(seed, index) if turn else None
        mirrored = rng is not None and uniform(rng, 0, 1) < 0.5
        if mirrored:
            mu = mu.flipped([2])
        pivot = grid.centre
        if self.crop == "body" or rng is not None:
            if (case, mirrored) not in self._pivots:
                self._pivots[case, mirrored] = self._pivot(name, mu, source)
            pivot = self._pivots[case, mirrored]
        target = grid.centre if self.crop == "body" else pivot
        placed = moved(source, pivot, target, rng, self.vary == "exact")
        name = f"{name}-{seed}-{turn}" if turn else name
        return Placed(name, mu, source, placed, mirrored)

    def _read(self, case: int) -> tuple[str, Slabs, Grid]:
        """Name, attenuation and grid of a case of the file, cached in memory if `keeps` and within
        `MAX_KEPT_VOXELS`.
        """
        name, values, source = self.case(case)
        if self.stored_unit == "HU":
            values = values.watched(lambda *ends: self._named(name, check_spread, *ends))
        mu = values.mapped(lambda slab: self._named(name, physical, slab, self.stored_unit))
        kept = sum(math.prod(mu.shape) for _, mu, _ in self._kept.values())
        if self.keeps and kept + math.prod(mu.shape) <= MAX_KEPT_VOXELS:
            self._kept[case] = name, Slabs.of(mu.whole()), source
            return self._kept[case]
        return name, mu, source

    def _pivot(self, name: str, mu: Slabs, source: Grid) -> Float[Tensor, "3"]:
        """World mm of the centre of the patient's box."""
        patient = body_box(mu, self._above(SKIN))
        if not patient.size:
            raise ValueError(
                f"{self.path}: {name} shows no patient: expected values above "
                f"{'0' if self.unit == 'activity' else '-400 HU'}, all are below"
            )
        return source.cropped(patient).centre

    def _named(self, name: str, step: Callable[..., Any], *values: Any) -> Any:
        """Apply a step to a case's values; its error names file and case."""
        try:
            return step(*values)
        except ValueError as error:
            raise ValueError(f"{self.path}: {name} {error}") from error

    @torch.no_grad()
    def _views(
        self, volume: Float[Tensor, "d h w"], grid: Grid, cameras: Cameras
    ) -> Float[Tensor, "1 m v u"]:
        A = RayTransform(grid, cameras.refined(self.rays), method="siddon")
        return F.avg_pool2d(A(volume[None, None])[0], self.rays)

    def _above(self, threshold: float) -> float:
        """A threshold in 1/mm; of activity, zero."""
        return 0.0 if self.stored_unit == "activity" else threshold


@dataclass(kw_only=True)
class Hdf5Volumes(FileScene):
    """The volumes of an HDF5 file; see `mvrecon.data.hdf5` for its layout.

    Args:
        orientation: sides of the patient towards which the file's axes x, y, z run, as three
            letters: L or R, P or A, I or S. The world is RAS as in NIfTI. None: as in the file, or
            RAS. Others: see `FileScene`.

    Raises:
        ValueError: invalid orientation letters.
    """

    orientation: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._file = VolumeFile(self.path)
        if self.orientation is not None:
            reversed_axes(self.orientation)

    @cached_property
    def length(self) -> int:
        """The number of volumes in the file."""
        return len(self._file)

    def case(self, index: int) -> tuple[str, Slabs, Grid]:
        """Return name, values and grid of a volume, centred on the origin, with axes towards RAS.

        Raises:
            ValueError: the file's unit differs from `stored_unit`.
        """
        name, hu, spacing = self._file.slabs(index)
        if self._file.unit != self.stored_unit:
            raise ValueError(
                f"{self.path}: expected the scene's stored_unit to be the file's, "
                f"{self._file.unit!r}, got {self.stored_unit!r}"
            )
        grid = Grid.centred(size=hu.shape[::-1], spacing=spacing[::-1])
        return name, hu.flipped(self._reversed()), grid

    def labels(self, index: int) -> Slabs:
        """Return a volume's labels of structures, with axes towards RAS.

        Raises:
            ValueError: the file has no labels.
        """
        return self._file.slabs(index, "label")[1].flipped(self._reversed())

    def _reversed(self) -> list[int]:
        return reversed_axes(self.orientation or self._file.orientation or "RAS")


@dataclass(kw_only=True)
class Volumes(FileScene):
    """Volumes in world mm (RAS) by their headers: one NIfTI, MHA or NRRD file, a DICOM CT series,
    or a folder of them.

    The cases of a folder are its files and its folders of DICOM slices, sorted by name; files that
    differ in their ending only are named with it. Options: see `FileScene`.
    """

    @cached_property
    def paths(self) -> list[Path]:
        """The volumes, sorted by name."""
        return volumes_in(self.path)

    @property
    def length(self) -> int:
        """The number of volumes."""
        return len(self.paths)

    def case(self, index: int) -> tuple[str, Slabs, Grid]:
        """Return name, values and grid of a volume, its axes roughly towards RAS."""
        path = self.paths[index]
        alone = [name_of(other) for other in self.paths].count(name_of(path)) == 1
        return name_of(path) if alone else path.name, *open_volume(path)
