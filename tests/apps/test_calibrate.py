"""A scan's rig is calibrated at reduced resolution and returned at full resolution."""

import warnings

import pytest
import torch

from mvrecon.apps import correction
from mvrecon.apps.progress import Bar
from mvrecon.apps.scan import Scan, ViewsInMemory
from mvrecon.data.projections.views import Corrected
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.random_rigs import Misalignment, misaligned
from mvrecon.geometry.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid, coarse, voxel_centres
from mvrecon.methods.calibration.from_data import KINDS
from mvrecon.operators.drr import Drr
from mvrecon.operators.radon import Radon

GRID = Grid.centred(size=(32, 28, 24), spacing=(3.0, 3.0, 4.0))
RIG = circular(20, 400.0, 600.0, {"pixels": [48, 64], "pixel_mm": 3.2})


class Measured:
    """Views in memory, with the two methods required by a calibration."""

    def __init__(self, views, mask):
        self.views, self.mask, self.gains = views, mask, torch.ones(len(views))

    def whole(self):
        return Corrected(self.views / self.gains[:, None, None], self.mask)

    def divided_by(self, gains):
        other = Measured(self.views, self.mask)
        other.gains = gains
        return other


def test_offset_gains_and_dead_pixels_of_a_scan(monkeypatch):
    """Half the voxels and pixels each way; one pixel in fifty is dead, with a wild value."""
    monkeypatch.setattr(correction, "MAX_GRID_VOXELS", 16)
    rng = torch.Generator().manual_seed(0)
    truth = Misalignment.none(20)
    truth.offset_px[:, 0] = 2.6
    gains = (0.05 * torch.linspace(-1, 1, 20)).exp()
    places = torch.tensor([[12.0, 5.0, -10.0], [-15.0, 10.0, 12.0], [5.0, -18.0, 0.0]])
    x = sum(torch.exp(-((voxel_centres(GRID) - p) ** 2).sum(-1) / 128) for p in places)
    exact = Drr(GRID, misaligned(RIG, truth))(x.float()[None, None])[0, 0] * gains[:, None, None]
    mask = torch.rand(exact.shape, generator=rng) > 0.02
    scan = Scan(Measured(torch.where(mask, exact, 99.0), mask), RIG, GRID, {"name": "drr"})
    mended, fit = correction.calibrate(scan, ["offset_u", "gains"], "cpu", Bar())
    assert (fit.misalignment.offset_px[:, 0] - 2.6).abs().max() < 0.1
    assert (mended.cameras.origin - misaligned(RIG, truth).origin).norm(dim=1).max() < 0.1 * 3.2
    views = mended.measured.whole().views
    assert ((views - exact / gains[:, None, None])[mask].norm() / exact[mask].norm()) < 0.01
    assert "offset_u +2." in correction.in_words(fit, ["offset_u", "gains"])
    kept = fit._replace(kept=["offset_u"], settled=False)
    words = correction.calibration_table(kept, ["offset_u", "gains"])["words"]
    assert "offset_u kept at the nominal value" in words and "still changed" in words


GRIDS = {
    "slice": Grid.centred(size=(40, 40, 1), spacing=2.5),
    "slice aside": Grid.centred(size=(20, 30, 1), spacing=2.5, centre=(10.0, 0.0, 12.0)),
    "part": Grid.centred(12, spacing=3.0, centre=(12.0, 5.0, -10.0)),
    "turned part": Grid.centred(12, spacing=3.0).moved(
        torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), torch.tensor([4.0, 9.0, 2.0])
    ),
}


@pytest.mark.parametrize("beam", ["cone", "parallel"])
@pytest.mark.parametrize("name", GRIDS)
def test_a_grid_of_a_part_of_the_object_calibrates_as_one_of_all_of_it(name, beam, monkeypatch):
    """One slice, or a region: the rig is fitted to all that the views show. Also tried: grids far
    larger than the field, and slices wider than it; 64 voxels a side.
    """
    monkeypatch.setattr(correction, "MAX_GRID_VOXELS", 32)
    panel = {"pixels": [48, 64], "pixel_mm": 3.2 if beam == "cone" else 2.0}
    rig = circular(30, 400.0, 600.0, panel) if beam == "cone" else parallel(30, panel)
    truth = Misalignment.none(30)
    truth.offset_px[:, 0] = 2.6
    places = torch.tensor([[12.0, 5.0, -10.0], [-15.0, 10.0, 12.0], [5.0, -18.0, 0.0]])
    x = sum(torch.exp(-((voxel_centres(GRID) - p) ** 2).sum(-1) / 128) for p in places)
    project = Drr if beam == "cone" else Radon
    views = project(GRID, misaligned(rig, truth))(x.float()[None, None])[0, 0]
    measured = Measured(views, torch.ones_like(views, dtype=torch.bool))
    projector = {"name": "drr" if beam == "cone" else "radon"}
    scan = Scan(measured, rig, GRIDS[name], projector)
    mended, fit = correction.calibrate(scan, ["offset_u"], "cpu", Bar())
    assert fit.misalignment.offset_px[0, 0] == pytest.approx(2.6, abs=0.1)
    assert mended.grid is scan.grid


def test_the_coarse_grid_fills_the_same_box():
    turned = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    fine = Grid.centred(size=(100, 80, 10), spacing=(1.0, 1.0, 2.0), centre=(5.0, 0.0, -3.0))
    fine = fine.moved(turned.double(), torch.tensor([1.0, 2.0, 3.0]).double())
    fewer = coarse(fine, 64)
    assert fewer.size == (64, 52, 10)
    assert torch.allclose(fewer.corners(), fine.corners())


def test_an_axis_by_conjugate_rays_stays_in_the_fit_of_other_parameters():
    """Of a cone over a truncated short scan alone, and over a full turn with a tilt of half a
    degree. Nothing warns that the axis is kept.
    """
    rng, turn = torch.Generator().manual_seed(0), torch.eye(3, dtype=torch.float64)
    centres = (torch.rand(9, 3, generator=rng).double() - 0.5) * torch.tensor([60.0, 60.0, 16.0])
    centres[0], radii = 0, 3 + 9 * torch.rand(9, 3, generator=rng).double()
    values = torch.full((9,), 0.02, dtype=torch.float64)
    panel = {"pixels": [16, 96], "pixel_mm": 1.5}
    for free, arc, width, tilt in (
        (["offset_u"], 215.0, 70.0, 0.0),
        (["offset_u", "tilt"], 360.0, 40.0, 0.5),
    ):
        rig = circular(90, 250.0, 375.0, panel, arc_degrees=arc)
        radii[0] = torch.tensor([width, 0.8 * width, 200.0])
        solid = Phantom((Solids("ellipsoid", centres, turn.expand(9, 3, 3), radii, values),))
        truth = Misalignment.none(90)
        truth.offset_px[:, 0], truth.tilt_degrees[:, KINDS["tilt"].column] = -2.4, tilt
        views = solid.integrals(*misaligned(rig, truth).rays()).float()
        measured = ViewsInMemory(views, torch.ones_like(views, dtype=torch.bool))
        grid = Grid.centred(size=(140, 140, 16), spacing=1.0)
        scan = Scan(measured, rig, grid, {"name": "drr"})
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            _, fit = correction.calibrate(scan, free, "cpu", Bar())
        assert not fit.kept and abs(fit.misalignment.offset_px[0, 0] + 2.4) < 0.1
        assert fit.residual[-1] < fit.residual[0]
        if tilt:
            assert abs(fit.misalignment.tilt_degrees[0, KINDS["tilt"].column] - tilt) < 0.2


def test_the_axis_of_a_tilted_rig_is_that_of_its_tilted_plane():
    """Parallel beams whose axis is tilted by a degree and three pixels aside: the axis was 0.35
    pixels off with an uncertainty of 0.06, and the tilt 0.3 degrees. Also tried: cones, tilts of
    0.5 to 3 degrees, half acquisitions, half turns.
    """
    centres = [[4.0, -6, 6], [-10, 8, -6], [12, 3, 5], [-3, -14, -9]]
    radii = [[20.0, 14, 8], [6, 8, 6], [4, 4, 4], [5, 4, 5]]
    bodies = torch.tensor([centres, radii], dtype=torch.float64)
    turn = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
    values = torch.full((4,), 0.02, dtype=torch.float64)
    solid = Phantom((Solids("ellipsoid", bodies[0], turn, bodies[1], values),))
    rig = parallel(60, {"pixels": [32, 56], "pixel_mm": 1.0}, arc_degrees=360.0)
    by = Misalignment.none(60)
    by.offset_px[:, 0], by.tilt_degrees[:, KINDS["tilt"].column] = 3.0, 1.0
    views = solid.integrals(*misaligned(rig, by).rays(), misaligned(rig, by).ray_extent).float()
    measured = ViewsInMemory(views, torch.ones_like(views, dtype=torch.bool))
    grid = Grid.centred(size=(56, 56, 32), spacing=1.0)
    scan = Scan(measured, rig, grid, {"name": "radon"})
    _, fit = correction.calibrate(scan, ["offset_u", "tilt"], "cpu", Bar())
    assert fit.misalignment.offset_px[0, 0].item() == pytest.approx(3.0, abs=0.1)
    assert fit.misalignment.tilt_degrees[0, 2].item() == pytest.approx(1.0, abs=0.12)


def tilted_scan():
    """Three quarters of a turn of few pixels; the axis is tilted by 0.8 degrees, and 2 pixels
    aside.
    """
    centres = [[2.3, -3.4, 3.4], [-5.7, 4.6, -3.4], [6.8, 1.7, 2.9], [-1.7, -8.0, -5.1]]
    radii = [[11.4, 8, 4.6], [3.4, 4.6, 3.4], [2.3, 2.3, 2.3], [2.9, 2.3, 2.9]]
    bodies = torch.tensor([centres, radii], dtype=torch.float64)
    turn, values = torch.eye(3).double().expand(4, 3, 3), torch.full((4,), 0.035).double()
    solid = Phantom((Solids("ellipsoid", bodies[0], turn, bodies[1], values),))
    rig = parallel(40, {"pixels": [20, 32], "pixel_mm": 1.0}, arc_degrees=270.0)
    by = Misalignment.none(40)
    by.offset_px[:, 0], by.tilt_degrees[:, KINDS["tilt"].column] = 2.0, 0.8
    views = solid.integrals(*misaligned(rig, by).rays(), misaligned(rig, by).ray_extent).float()
    measured = ViewsInMemory(views, torch.ones_like(views, dtype=torch.bool))
    return Scan(measured, rig, Grid.centred(size=(32, 32, 20), spacing=1.0), {"name": "radon"})


def test_the_uncertainty_of_an_axis_holds_that_of_a_tilt_that_is_fitted_with_it(monkeypatch):
    """The axis was 0.063 pixels off with an uncertainty of 0.02. Also tried: full and half turns,
    cones, half acquisitions, noise, pixels of 0.001 mm.
    """
    monkeypatch.setattr(correction, "MAX_GRID_VOXELS", 32)
    _, fit = correction.calibrate(tilted_scan(), ["offset_u", "tilt"], "cpu", Bar())
    assert abs(fit.misalignment.offset_px[0, 0].item() - 2.0) < fit.uncertainty["offset_u"] < 0.2


def test_warnings_of_several_fits_are_those_of_the_last_alone(monkeypatch):
    """A fit that ends after one round warns; its repetitions for a tilted axis warned again, or of
    parameters as kept that a later one determines.
    """
    fits, calibrated = [], correction.calibrated

    def counted(*args, **options):
        fits.append(calibrated(*args, **options))
        warnings.warn(f"fit {len(fits)}", stacklevel=2)
        return fits[-1]

    monkeypatch.setattr(correction, "MAX_GRID_VOXELS", 32)
    monkeypatch.setattr(correction, "MAX_ROUNDS", 1)
    monkeypatch.setattr(correction, "calibrated", counted)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        correction.calibrate(tilted_scan(), ["offset_u", "tilt"], "cpu", Bar())
    assert len(fits) > 1
    last = ["The rig still changed in the last of 1 rounds", f"fit {len(fits)}"]
    assert [str(one.message) for one in told] == last
