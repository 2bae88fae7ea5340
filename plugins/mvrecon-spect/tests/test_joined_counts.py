"""Counts in joined pixels are counts of the same activity."""

from pathlib import Path

import h5py
import pytest
import torch

from mvrecon.apps.reconstruct import read_scan, run_reconstruction
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.checks import Refused
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon_spect.operators.projector import Spect

GRID, RIG = Grid.centred(12, spacing=12.0), dcspect80(pixels=24, columns=[2, 7, 12, 17])
#: A block, its views, and Poisson counts of them in whole numbers.
BLOCK = torch.zeros(1, 1, *GRID.shape)
BLOCK[..., 4:8, 3:9, 4:9] = 200.0
VIEWS = Spect(GRID, RIG)(BLOCK)
COUNTS = torch.poisson(VIEWS, torch.Generator().manual_seed(0)).int()
pytestmark = pytest.mark.usefixtures("blank_pictures")


@pytest.fixture
def measured(scan_of):
    """The settings of a scan of `COUNTS`."""
    return lambda *options: scan_of(COUNTS, RIG, GRID, "method=osem", *options)


def test_joined_pixels_reconstruct_the_activity_of_all_pixels(tmp_path: Path, measured):
    volumes = []
    for binning in (1, 2):
        options = "projector=spect", "views.kind=counts", f"views.binning={binning}"
        folder = tmp_path / f"run{binning}"
        run_reconstruction(ReconstructSettings(**measured(*options)), folder)
        volumes.append(read_volume(folder / "volume.nii.gz")[0])
    block, drawn = (slice(4, 8), slice(3, 9), slice(4, 9)), COUNTS.sum() / VIEWS.sum()
    for volume in volumes:
        assert volume.sum().item() == pytest.approx((drawn * BLOCK.sum()).item(), rel=0.01)
        mean = volumes[0][block].mean().item()
        assert volume[block].mean().item() == pytest.approx(mean, rel=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("projector=drr", "views.kind=counts"), "a projector of emission for views of counts"),
        (("projector=spect", "views.flat=9"), "expected counts for a projector of emission"),
        (("projector=spect",), "expected a flat field for intensities.*kind=counts"),
    ],
)
def test_counts_and_line_integrals_are_not_confused(measured, options, message):
    settings = measured(*options)
    with pytest.raises(Refused, match=message):
        read_scan(ReconstructSettings(**settings))


@pytest.mark.parametrize("options", [{"acceptance_degrees": 3}, {"diameter_mm": 30}])
@pytest.mark.parametrize("unit", [None, "spect of activity"])
def test_counts_of_any_hole_are_counts(tmp_path: Path, scan_of, options, unit):
    """Of a cone that ends within the object, and of holes and pixels as wide as a hand. Also tried:
    mu of 0.09 / mm, grids of one voxel and of 364 mm, pinholes of STIR, holes of 40 mm.
    """
    rig = dcspect80(pixels=4, columns=[2, 12])
    counts = 1000 * Spect(GRID, rig, **options)(BLOCK)
    given = (f"projector.{name}={value}" for name, value in options.items())
    settings = scan_of(counts, rig, GRID, "method=osem", "projector=spect", *given)
    settings["views"]["kind"] = "counts"
    if unit is not None:
        with h5py.File(tmp_path / "views.h5", "w") as file:
            file.create_dataset("views", data=counts[0, 0].numpy()).attrs["unit"] = unit
        settings["views"] |= {"path": str(tmp_path / "views.h5"), "kind": None}
    scan = read_scan(ReconstructSettings(**settings))
    assert scan.counts and scan.unit == "activity"
