"""Emission cases with random uptake in the labelled structures of real CT scans."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool3d

from mvrecon.core.numbers import generator, mixed, uniform
from mvrecon.data.attenuation import CT_KEV, SPECT_KEV
from mvrecon.data.body import body, enclosed
from mvrecon.data.resample import Slab, Slabs, resample
from mvrecon.data.scenes.sample import Sample
from mvrecon.data.volumes import TISSUE, Hdf5Volumes, Placed
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_spect.scenes.spect_ct import at_energy

#: Random series of the uptakes, separate from those of the patients' pose.
UPTAKE = 0x75707461


@dataclass(kw_only=True)
class SpectLabels(Hdf5Volumes):
    """Patients of an HDF5 file of CT scans, with random activity in their labelled structures and
    attenuation at 140.5 keV from their Hounsfield units.

    Tissue outside these structures has the uptake of the body, air has none. The unmodified case
    and each varied copy (`vary`) have different random uptakes. The pinholes must be outside the
    grid: matter outside the grid neither emits nor attenuates.

    Convention: volumes are in RAS orientation, as in NIfTI, for any orientation of the file.

    Args:
        uptake: minimum and maximum activity of structures, by their names in the file's attribute
            `labels`; other structures have the activity of the body.
        body: minimum and maximum activity of other tissue.
        attenuates: whether tissue attenuates.
        path: path of a file with the dataset `label`. Others: see `Hdf5Volumes`.

    Raises:
        ValueError: no structure or an unknown one, activities that are not finite, negative or not
            ascending, or a file without labels or with activity.
    """

    uptake: Mapping[str, tuple[float, float]]
    body: tuple[float, float] = (0.05, 0.15)
    attenuates: bool = True
    data_range: float = 1.0
    unit: str = field(default="activity", init=False)
    map_names = ("mu",)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.unit = "activity"
        if self.stored_unit == "activity":
            raise ValueError("Expected a file of HU or 1/mm, got stored_unit activity")
        if self.own_voxels:
            raise ValueError("Expected views of a finer grid for spect_labels, got own_voxels=True")
        known = self._file.structures
        if not self.uptake or set(self.uptake) - set(known):
            raise ValueError(
                f"{self.path}: expected uptakes of structures among {', '.join(known)}, got "
                f"{', '.join(self.uptake) or 'none'}"
            )
        for name, (low, high) in {**self.uptake, "body": self.body}.items():
            if not 0 <= low <= high < math.inf:
                raise ValueError(
                    f"Expected the least and the greatest activity of {name}, 0 or more, got "
                    f"{low} and {high}"
                )

    def sample(self, index: int, seed: int, grid: Grid, cameras: Cameras) -> Sample:
        """A case: line integrals without attenuation, truth and attenuation on `grid`.

        Raises:
            IndexError: the case does not exist.
        """
        factor = self.factor(grid)
        fine = self.finer(index, seed, grid, cameras, factor)
        views = self._views(fine[0], grid.refined(factor), cameras)
        return replace(self.pooled(index, seed, grid, cameras, fine), views=views)

    def pooled(
        self, index: int, seed: int, grid: Grid, cameras: Any, fine: Float[Tensor, "1 d h w"]
    ) -> Sample:
        """The case without views; its truth is averaged from the activity on a finer grid."""
        case = self._placed(index, seed, grid)
        factor = fine.shape[-1] // grid.shape[-1]
        mu = resample(case.mu, case.grid, grid)
        return Sample(
            fine.new_zeros(1, 0, 0, 0),
            avg_pool3d(fine[None], factor)[0],
            enclosed(body(mu, TISSUE))[None],
            case.name,
            maps=self.maps(index, seed, grid),
        )

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Cameras, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """The case's activity on `grid.refined(factor)`."""
        case = self._placed(index, seed, grid)
        labels = self.labels(index % self.length)
        labels = labels.flipped([2]) if case.mirrored else labels
        activity = _activity(case, labels.whole(), self._drawn(index, seed))
        return resample(activity, case.grid, grid.refined(factor))[None]

    def maps(
        self, index: int, seed: int, grid: Grid, factor: int = 1
    ) -> dict[str, Float[Tensor, "1 d h w"]]:
        """Linear attenuation "mu" of a case at 140.5 keV in 1/mm on `grid.refined(factor)`."""
        target = grid.refined(factor) if factor > 1 else grid
        if not self.attenuates:
            return {"mu": torch.zeros(1, *target.shape)}
        case = self._placed(index, seed, grid)
        at_140 = case.mu.mapped(lambda mu: at_energy(mu, CT_KEV, SPECT_KEV))
        return {"mu": resample(at_140, case.grid, target)[None]}

    def parameters(self, index: int, seed: int, grid: Grid) -> dict[str, float]:
        """The activity of each structure of a case, and of its body."""
        drawn = self._drawn(index, seed)
        names = {label: name for name, label in self._file.structures.items()} | {0: "body"}
        return {f"uptake_{names[label]}": value for label, value in drawn.items()}

    def _drawn(self, index: int, seed: int) -> dict[int, float]:
        """The activity of each label of a case; label 0 is the body."""
        rng = generator(UPTAKE, mixed(self.seed_of(index, seed), index))
        labels = self._file.structures
        between = {0: self.body} | {labels[name]: ends for name, ends in self.uptake.items()}
        return {label: uniform(rng, *ends) for label, ends in between.items()}


def _activity(case: Placed, labels: Float[Tensor, "d h w"], levels: Mapping[int, float]) -> Slabs:
    """The activity of a case's voxels: that of their structure, or of the body in other tissue."""
    table = torch.full((256,), levels[0])
    outside = torch.ones(256, dtype=torch.bool)
    for label in levels.keys() - {0}:
        table[label], outside[label] = levels[label], False

    def passes() -> Iterator[Slab]:
        for first, mu in case.mu:
            part = labels.narrow(case.mu.axis, first, mu.shape[case.mu.axis]).long()
            empty: Bool[Tensor, "d h w"] = outside[part] & (mu < TISSUE)
            yield first, table[part].masked_fill(empty, 0.0)

    return replace(case.mu, passes=passes)
