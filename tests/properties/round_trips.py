"""Formats that are written, each with random contents, its writer, its reader and the comparison:
`read(write(x)) == x`, or the writer refuses by name what the format cannot hold.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor

from mvrecon.core.numbers import generator
from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from mvrecon.data.projections.arrays import Hdf5Views
from mvrecon.data.projections.views import Measured, MeasuredViews
from mvrecon.data.projections.writing import Exposure, write_projections
from mvrecon.data.resample import right_angled
from mvrecon.data.volume_files import read_volume, save_volume
from mvrecon.geometry.cameras import files
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.cameras.formats import angles, astra, matrices, rtk_xml, tigre
from mvrecon.geometry.cameras.rigs import Detector, circular
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.training.export import save_views
from tests.properties.strategies import SEEDS, cases, grids, real, volumes


@dataclass(frozen=True)
class Format:
    """A format: its contents, how they are written into a folder and read back, the comparison,
    which asserts, and whether the format can hold them (None: its writer decides).
    """

    contents: st.SearchStrategy[Any]
    write: Callable[[Path, Any], Any]
    read: Callable[[Path, Any], Any]
    same: Callable[[Any, Any], None]
    holds: Callable[[Any], bool | None] = lambda x: True

    def check(self, data: st.DataObject, folder: Path) -> None:
        """Write and read contents; if they are refused, nothing is written."""
        x = data.draw(self.contents)
        try:
            self.write(folder, x)
        except ValueError as error:
            assert not self.holds(x), error
            assert not [path for path in folder.rglob("*") if path.is_file()]
            return
        assert self.holds(x) is not False
        self.same(x, self.read(folder, x))


Placed = tuple[Tensor, Grid]


@st.composite
def placed(draw: st.DrawFn, signed: bool = True) -> Placed:
    """A volume on a grid off the origin, of unequal spacing or not, turned, sheared or not."""
    grid = draw(grids())
    return draw(volumes(grid.shape, torch.float32, signed))[0, 0], grid


def same_places(
    x: Placed, y: Placed, tolerance: float = 0.0, voxels: float = 1e-9, relative: float = 0.0
) -> None:
    """Every voxel has its value at its place, in whatever order of axes.

    Args:
        x, y: written and read.
        tolerance: of the values.
        voxels: of the places, in voxels.
        relative: of the values, relative to each.
    """
    (values, grid), (found, there) = x, y
    assert found.numel() == values.numel()
    place = there.to_index(voxel_centres(grid).reshape(-1, 3))
    assert (place - place.round()).abs().max() <= voxels
    k, j, i = place.round().long().flip(-1).unbind(dim=-1)
    error = (found[k, j, i] - values.flatten()).abs()
    assert (error <= tolerance + relative * values.flatten().abs()).all()


def upright(grid: Grid) -> bool:
    """Whether a grid's axes run along x, y and z."""
    steps = torch.diag(torch.tensor(grid.spacing, dtype=torch.float64))
    return bool(torch.equal(grid.affine[:3, :3], steps))


def of_volumes(ending: str, holds: Callable[[Grid], bool], voxels: float) -> Format:
    return Format(
        placed(),
        lambda folder, x: save_volume(folder / f"a{ending}", *x),
        lambda folder, x: read_volume(folder / f"a{ending}"),
        lambda x, y: same_places(x, y, voxels=voxels),
        lambda x: holds(x[1]),
    )


@st.composite
def _stored(draw: st.DrawFn) -> tuple[list[Stored], dict[str, str]]:
    """Volumes of one shape in any type, spacing and unit, with labels or without."""
    shape, kind = draw(grids()).shape, draw(st.sampled_from(["i2", "u1", "i4", "f4", "f8"]))
    rng, labelled = np.random.default_rng(draw(SEEDS)), draw(st.booleans())
    made = [
        Stored(
            f"case {k}",
            (100 * rng.random(shape)).astype(kind),
            draw(st.tuples(*[real(1e-6, 1e6)] * 3)),
            rng.integers(0, 256, shape).astype("u1") if labelled else None,
        )
        for k in range(draw(st.integers(1, 3)))
    ]
    about = {"units": draw(st.sampled_from(["HU", "1/mm", "activity"]))}
    if labelled:
        about["labels"] = "1=Brainstem,2=Cord"
    if draw(st.booleans()):
        about["orientation"] = draw(st.sampled_from(["RAS", "LPI", "LAS"]))
    return made, about


def _same_stored(x: Any, file: VolumeFile) -> None:
    written, about = x
    assert len(file) == len(written)
    assert (file.unit, file.orientation) == (about["units"], about.get("orientation"))
    assert not (named := about.get("labels")) or file.structures == {"Brainstem": 1, "Cord": 2}
    for k, one in enumerate(written):
        other = file.read(k)
        assert (other.name, other.spacing, other.ct.dtype) == (one.name, one.spacing, one.ct.dtype)
        assert np.array_equal(one.ct, other.ct)
        if named:
            labels = file.slabs(k, "label")[1].whole().numpy()
            assert np.array_equal(labels, one.label)


@dataclass(frozen=True)
class Views:
    """Views in their unit, with their dose and duration if they are counts."""

    values: Tensor
    unit: str
    dose: float | None = None
    duration_s: float | None = None
    attenuated: bool = False


@st.composite
def _views(draw: st.DrawFn) -> Views:
    """Line integrals, or Poisson counts of any dose and time."""
    shape = draw(st.tuples(*[st.integers(1, 6)] * 3))
    rng = generator(0, draw(SEEDS))
    if draw(st.booleans()):
        return Views(torch.randn(shape, generator=rng), "1/mm * mm")
    mean, dose = 10 ** draw(real(-1, 6)), 10 ** draw(real(-9, 9))
    counts = torch.poisson(torch.full(shape, mean, dtype=torch.float64), generator=rng)
    duration_s = draw(st.none() | real(1e-3, 1e5))
    unit = draw(st.sampled_from(["spect of activity", "activity * mm"]))
    return Views((counts / dose).float(), unit, dose, duration_s, draw(st.booleans()))


def _write_views(folder: Path, x: Views) -> None:
    save_views(folder, "a", x.values, x.unit, x.attenuated, x.dose, x.duration_s)


def _same_views(x: Views, stack: Hdf5Views) -> None:
    values = stack.read(0, stack.n_views).double()
    assert (stack.unit, stack.dose, stack.attenuated) == (x.unit, x.dose, x.attenuated)
    if x.dose is None:
        assert torch.equal(values, x.values.double())
        return
    assert stack.duration_s == x.duration_s
    assert torch.equal(values, values.round())  # counts are in counts
    expected = x.values.double() * x.dose
    assert ((values - expected).abs() <= 2e-7 * expected).all()
    with h5py.File(stack.path) as file:
        assert file["views"].attrs["unit"] == "counts"


def _same_greys(x: Tensor, measured: MeasuredViews) -> None:
    """Within half a grey value of 49 900."""
    found = measured.whole().views
    assert ((-found).exp() - (-x).exp()).abs().max() <= 0.51 / 49_900


@dataclass(frozen=True)
class Rig:
    """Cameras, and whether they are cone beams about the z axis, which every format holds."""

    cameras: Cameras
    gantry: bool


@st.composite
def _gantries(draw: st.DrawFn) -> Rig:
    """Cone beams with offset and turned detectors and sources off a circle, on a large or a small
    arc, which in radians would be a large one.
    """
    count, start = draw(st.integers(1, 12)), draw(real(-400, 400) | st.just(0.0))
    arc = draw(real(0.5, 6) | real(6, 360))
    pixels = [draw(st.integers(1, 6)), draw(st.integers(1, 6))]
    plate = {"pixels": pixels, "pixel_mm": [2.0, 3.0]}
    turns = [start + arc * k / count for k in range(count)]
    rig = circular(count, 400.0, 800.0, plate, angles=turns)
    rng = generator(0, draw(SEEDS))
    tilt = draw(st.sampled_from([0.0, 4.0])) * torch.randn(count, 3, generator=rng).double()
    shift = draw(st.sampled_from([0.0, 8.0])) * torch.randn(2, count, 3, generator=rng).double()
    R = torch.stack([rig.u / 3, rig.v / 2, torch.linalg.cross(rig.u, rig.v) / 6], dim=1)
    source, centre = rig.source + shift[0], rig.detector_centre + shift[1]
    return Rig(Detector.of(plate).carried(source, centre, R @ euler_rotation(tilt)), True)


def _same_rig(x: Rig, cameras: Cameras) -> None:
    one = x.cameras
    assert (one.shape, one.parallel, one.extent) == (
        cameras.shape,
        cameras.parallel,
        cameras.extent,
    )
    size = sum(getattr(one, name).norm(dim=-1, keepdim=True) for name in VECTORS)
    for name in VECTORS:
        scale = size if name in ("source", "origin") else getattr(one, name).norm(dim=-1)[:, None]
        assert ((getattr(one, name) - getattr(cameras, name)).abs() <= 1e-6 * scale).all(), name


def _plate(rig: Cameras) -> dict[str, Any]:
    sizes = rig.v.norm(dim=-1)[0].item(), rig.u.norm(dim=-1)[0].item()
    return {"detector": {"pixels": list(rig.shape), "pixel_mm": list(sizes)}}


ANY_RIG = _gantries() | cases().map(lambda case: Rig(case.rays, False))


def _of_rigs(kind: Any, options: Callable[[Cameras], dict[str, Any]], contents: Any) -> Format:
    return Format(
        contents,
        lambda folder, x: kind.write(x.cameras, folder / "rig"),
        lambda folder, x: kind.read(folder / "rig", **options(x.cameras)),
        _same_rig,
        lambda x: x.gantry or None,
    )


def _of_astra(rig: Cameras) -> dict[str, Any]:
    return {"pixels": list(rig.shape), "parallel": rig.parallel}


FORMATS = {
    "volume.nii": of_volumes(".nii", lambda grid: True, 1e-4),  # single precision
    "volume.nii.gz": of_volumes(".nii.gz", lambda grid: True, 1e-4),
    "volume.mha": of_volumes(".mha", right_angled, 1e-9),
    "volume.nrrd": of_volumes(".nrrd", right_angled, 1e-9),
    "volumes.h5": Format(
        _stored(),
        lambda folder, x: write_volumes(folder / "a.h5", x[0], **x[1]),
        lambda folder, x: VolumeFile(folder / "a.h5"),
        _same_stored,
    ),
    "views.h5": Format(
        _views(), _write_views, lambda folder, x: Hdf5Views(folder / "a" / "views.h5"), _same_views
    ),
    "views.tif": Format(
        st.tuples(*[st.integers(1, 5)] * 3, SEEDS).map(
            lambda n: 6 * torch.rand(n[:3], generator=generator(0, n[3]))
        ),
        lambda folder, x: write_projections(folder / "a", x, Exposure(photons=None)),
        lambda folder, x: MeasuredViews(Measured(path=str(folder / "a"))),
        _same_greys,
    ),
    "rig.json": Format(
        ANY_RIG,
        lambda folder, x: files.save(x.cameras, folder / "rig.json"),
        lambda folder, x: files.from_file(folder / "rig.json"),
        _same_rig,
    ),
    "rig.xml": _of_rigs(rtk_xml, _plate, ANY_RIG),
    "tigre.json": _of_rigs(tigre, lambda rig: {}, ANY_RIG),
    "astra.txt": _of_rigs(astra, _of_astra, ANY_RIG),
    "angles.csv": _of_rigs(angles, _plate, ANY_RIG),
    # read with a point of the object, the origin, which random rigs do not have in front of them
    "matrices.txt": _of_rigs(matrices, _plate, _gantries()),
}
