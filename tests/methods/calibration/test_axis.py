"""The axis of rotation of closed-form objects comes back from one slice, with noise and glare."""

import math

import pytest
import torch

from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.methods.calibration.alignment import RootRamp
from mvrecon.methods.calibration.axis import KEPT, refined_axis
from mvrecon.operators.drr import Drr
from mvrecon.operators.radon import Radon

CENTRES = torch.tensor([[3.0, -3, 0], [18, 12, 0], [-21, 6, 0], [0, -23, 0], [-6, 15, 0]])
RADII = torch.tensor([40.0, 7, 9, 6, 4])[:, None].expand(-1, 3)
VALUES = 0.01 * torch.tensor([1.0, 1, -0.8, 2, 3])
RODS = Phantom((Solids("cylinder", CENTRES, torch.eye(3).expand(5, 3, 3), RADII, VALUES),))
GRID = Grid.centred(size=(96, 96, 8), spacing=1.0)


def rig_of(beam, arc, aside, rows=1):
    """Panels of 96 columns, or half ones of 64 that see 12 columns beyond the axis."""
    scale = 1.5 if beam == "fan" else 1.0
    columns, offset = (64, [0.0, 20.0 * scale]) if aside else (96, [0.0, 0.0])
    panel = {"pixels": [rows, columns], "pixel_mm": scale, "offset_mm": offset}
    if beam == "fan":
        return circular(120, 400.0, 600.0, panel, arc_degrees=arc)
    return parallel(120, panel, arc_degrees=arc)


def views_of(rig, offset, photons=2e4, seed=0):
    views = RODS.integrals(*rig.shifted(torch.tensor([[offset, 0.0]])).rays()).float()
    counts = torch.poisson(photons * (-views).exp(), torch.Generator().manual_seed(seed))
    return -(counts.clamp_min(1) / photons).log()[None, None]


@pytest.mark.parametrize(
    ("beam", "arc", "aside", "offset"),
    [
        ("parallel", 360.0, False, -2.625),
        ("parallel", 180.0, False, 1.25),
        ("parallel", 360.0, True, -2.625),
        ("fan", 360.0, False, 1.25),
        ("fan", 200.0, False, -2.625),
        ("fan", 360.0, True, 1.25),
    ],
)
def test_the_axis_comes_back(beam, arc, aside, offset):
    """Also tried: the other offset of each, random scans of study 08, cones among them, and a
    measured neutron sinogram.
    """
    rig = rig_of(beam, arc, aside)
    operator = Radon if beam == "parallel" else Drr
    assert abs(refined_axis(operator, rig, views_of(rig, offset), GRID, 4.0).offset - offset) < 0.1


@pytest.mark.parametrize("beam", ["parallel", "fan"])
@pytest.mark.parametrize("spacing", [1.5, 8.0])
def test_a_coarse_grid_biases_no_axis_and_the_error_is_within_its_uncertainty(beam, spacing):
    """The slice has voxels of its own size, whatever those of the grid. Also tried: 4 mm."""
    size = round(96 / spacing)
    grid = Grid.centred(size=(size, size, 1), spacing=spacing)
    rig, operator = rig_of(beam, 360.0, False), Radon if beam == "parallel" else Drr
    axis = refined_axis(operator, rig, views_of(rig, 1.25), grid, 4.0)
    assert abs(axis.offset - 1.25) < min(0.05, 2 * axis.uncertainty)
    assert axis.uncertainty < 0.1


@pytest.mark.parametrize("beam", ["parallel", "fan"])
def test_the_uncertainty_of_few_columns_covers_their_noise(beam):
    """Of 16 columns over a half turn or a short scan with 200 photons a pixel, within twice the
    uncertainty, which is a fraction of a pixel. Also tried: 16 random objects and full turns.
    """
    small = Phantom(
        (Solids("cylinder", CENTRES / 6, torch.eye(3).expand(5, 3, 3), RADII / 6, 6 * VALUES),)
    )
    grid = Grid.centred(size=(16, 16, 1), spacing=1.0)
    scale = 1.5 if beam == "fan" else 1.0
    panel = {"pixels": [1, 16], "pixel_mm": scale}
    if beam == "fan":
        rig, operator = circular(24, 66.0, 99.0, panel, arc_degrees=205.0), Drr
    else:
        rig, operator = parallel(24, panel, arc_degrees=180.0), Radon
    views = small.integrals(*rig.shifted(torch.tensor([[0.02, 0.0]])).rays()).float()
    ratios = []
    for seed in range(8):
        counts = torch.poisson(200 * (-views).exp(), torch.Generator().manual_seed(seed))
        y = -(counts.clamp_min(1) / 200).log()[None, None]
        axis = refined_axis(operator, rig, y, grid, 4.0)
        if axis.uncertainty < math.inf:
            assert axis.uncertainty < 0.3
            ratios.append(abs(axis.offset - 0.02) / axis.uncertainty)
    assert len(ratios) >= 4 and max(ratios) < 2


@pytest.mark.parametrize("photons", [100, 300])
@pytest.mark.parametrize(("beam", "arc"), [("parallel", 180.0), ("fan", 200.0)])
def test_the_uncertainty_covers_the_noise_of_few_photons(beam, arc, photons):
    """Within twice the uncertainty, where errors of 7 times were seen. Also tried: six seeds of
    each, panels of 32 to 64 columns, 24 to 60 views; with 30 photons, up to 2.3 times.
    """
    rig, operator = rig_of(beam, arc, False), Radon if beam == "parallel" else Drr
    for seed, offset in enumerate((1.25, -2.625)):
        views = views_of(rig, offset, photons, seed)
        axis = refined_axis(operator, rig, views, GRID, 4.0)
        assert abs(axis.offset - offset) < 2 * axis.uncertainty


def test_of_many_rows_those_in_the_plane_of_the_sources_tell_the_axis():
    """Rows elsewhere hold nonsense; the grid's axes are permuted and its centre is aside."""
    rig = rig_of("fan", 360.0, False, rows=24)
    views = views_of(rig, 1.25)
    views[:, :, :, :6] = views[:, :, :, -6:] = 7.0
    axes = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    grid = Grid.centred(size=(24, 96, 96), spacing=1.0).moved(axes, torch.tensor([1.0, 2.0, 3.0]))
    assert abs(refined_axis(Drr, rig, views, grid, 4.0).offset - 1.25) < 0.1


def test_a_rig_without_a_slice_stays():
    rig = dome(12, 400.0, 600.0, 160.0, {"pixels": [24, 32], "pixel_mm": 6.4}, extent="segment")
    assert refined_axis(Drr, rig, torch.rand(1, 1, 12, 24, 32), GRID, 4.0) == KEPT


@pytest.mark.parametrize(("beam", "arc"), [("parallel", 360.0), ("fan", 200.0)])
def test_an_empty_slice_tells_no_axis(beam, arc):
    """Noise alone moved it by up to 1.1 pixels. Also tried: other arcs, 20 seeds, half panels."""
    rig = rig_of(beam, arc, False)
    operator = Radon if beam == "parallel" else Drr
    counts = torch.poisson(torch.full((120, 1, 96), 1e3), torch.Generator().manual_seed(0))
    assert refined_axis(operator, rig, -(counts / 1e3).log()[None, None], GRID, 4.0) == KEPT


def test_an_axis_that_moves_too_far_stays():
    """Rather than a shift beyond the one that all views allow, with a warning; its uncertainty is
    as large as the error.
    """
    rig = rig_of("parallel", 360.0, False)
    with pytest.warns(UserWarning, match="shift the axis by 2.* expected at most 1"):
        axis = refined_axis(Radon, rig, views_of(rig, 2.5), GRID, 1.0)
    assert axis.offset == 0 and axis.uncertainty == pytest.approx(2.5, rel=0.2)


def test_the_root_of_the_ramp_is_symmetric_and_weighs_edges():
    """<S x, y> = <x, S y>; a constant row is nearly gone in its middle, an edge is not."""
    S = RootRamp((3, 1, 64), 0.5, torch.device("cpu"))
    x, y = torch.randn(2, 1, 1, 3, 1, 64, generator=torch.Generator().manual_seed(0))
    assert torch.allclose((S(x) * y).sum(), (x * S.T(y)).sum(), rtol=1e-4)
    rows = torch.ones(1, 1, 2, 1, 512)
    rows[:, :, 1, :, 256:] = 0
    middle = RootRamp((2, 1, 512), 0.5, torch.device("cpu"))(rows)[0, 0, :, 0, 252:260]
    assert middle[0].abs().max() < 0.2 * middle[1].abs().max()
