"""Every registered projector makes views that it can reconstruct from: the table of projectors."""

from typing import Any

import pytest
import torch

from mvrecon.core.parts import PROJECTORS, SCENES, required
from mvrecon.data.acquisition.acquired import Acquired, Projection, source_of
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.sirt import sirt
from mvrecon.operators.drr import Drr
from mvrecon.report.metrics import volume_metrics

GRID = Grid.centred(size=(13, 11, 9), spacing=2.0)
SQUARE = {"pixels": [9, 15], "pixel_mm": 4.0}
#: One of them each projector takes: a cone, parallel beams in slices, pinholes.
RIGS = {
    "cone": circular(9, 60.0, 90.0, SQUARE, start_degrees=13.0),
    "stack": parallel(9, SQUARE | {"pixel_mm": 2.0}, 60.0, start_degrees=11.0),
    "pinholes": dome(9, 60.0, 40.0, 120.0, SQUARE | {"pixel_mm": 2.0}),
}
#: scikit-image turns about a voxel's centre, so the finer grid must have odd sizes, too.
FINE = {"skimage": 3}


def doubled(grid: Grid, cameras: Any) -> Any:
    """The plugin of the README."""
    return 2 * Drr(grid, cameras)


class Halved(Drr):
    """A subclass that computes something else, and does not say what."""

    def forward(self, volume):
        return super().forward(volume) / 2

    def adjoint(self, views):
        return super().adjoint(views) / 2


class Slices(Drr):
    """A projector that requires a row of pixels for each slice, like 2-D libraries, and does not
    declare that it integrates along lines.
    """

    def __init__(self, grid, cameras):
        super().__init__(grid, cameras)
        if cameras.shape[0] != grid.shape[0]:
            raise ValueError("as many rows as slices")

    def forward(self, volume):
        return super().forward(volume)


class Stubborn(Drr):
    """A projector that supports only one grid."""

    def __init__(self, grid, cameras):
        super().__init__(grid, cameras)
        if grid is not GRID:
            raise ValueError("this grid alone")

    def forward(self, volume):
        return super().forward(volume)


@pytest.fixture
def parts(monkeypatch):
    """The plugins of this file, registered for one test."""
    own = {"doubled": doubled, "halved": Halved, "slices": Slices, "stubborn": Stubborn}
    monkeypatch.setattr(PROJECTORS, "_parts", {**PROJECTORS._parts, **own})


def measured(name: str, acquisition: Acquisition | None = None) -> tuple[Any, Any]:
    """The projector and a case that it has measured, with the first rig that it takes."""
    acquisition = acquisition or Acquisition(fine=FINE.get(name, 2))
    refusals = []
    for rig in RIGS.values():
        try:
            A = PROJECTORS.build(name, grid=GRID, cameras=rig)
            scene = Acquired(SCENES.build("ellipsoids"), {"name": name}, acquisition)
            return A, scene.sample(2, 0, GRID, rig)
        except ImportError as error:
            pytest.skip(f"{name}: {error}")
        except ValueError as error:
            refusals.append(str(error))
    pytest.fail(f"{name} takes none of the rigs: {refusals}")


BUILT = [name for name in PROJECTORS.names() if not required("projector", name)]


@pytest.mark.parametrize("name", [*BUILT, "doubled", "halved"])
def test_every_projector_reconstructs_its_own_measurement(name, parts):
    """50 iterations of SIRT from 9 views: 20 dB or more for any unit of the views."""
    A, sample = measured(name)
    volume = sirt(A, sample.views[None], 50)
    figures = volume_metrics(volume[0], sample.volume, sample.inside, 1.0)
    assert figures["psnr"] > 20, figures


@pytest.mark.parametrize(("name", "factor"), [("doubled", 2.0), ("halved", 0.5)])
def test_a_multiple_of_an_operator_has_multiplied_views(name, factor, parts):
    """`2 * A` declares line integrals, so its views are exactly twice as large; a subclass without
    declaration is projected on the finer grid, up to the discretisation error.
    """
    exact, other = measured("drr")[1].views, measured(name)[1].views
    if name == "doubled":
        assert torch.equal(other, 2 * exact)
    assert (other - factor * exact).norm() < 0.12 * (factor * exact).norm()


def test_pinholes_have_the_views_of_lines_times_their_sensitivity():
    spect = pytest.importorskip("mvrecon_spect.operators.projector")
    rig, scene = RIGS["pinholes"], SCENES.build("ellipsoids")
    views = Acquired(scene, {"name": "spect"}).sample(2, 0, GRID, rig).views
    rays = spect.Spect(GRID, rig).pixel_integral().rays
    lines = torch.nn.functional.avg_pool2d(scene.sample(2, 0, GRID, rig.refined(rays)).views, rays)
    torch.testing.assert_close(views, lines * spect.sensitivity(rig, 2.3).to(lines))


@pytest.mark.parametrize("closed_form", [True, False])
def test_line_integrals_have_one_unit_however_they_are_computed(closed_form, parts):
    acquisition, scene = Acquisition(closed_form=closed_form), SCENES.build("ellipsoids")
    units = {"drr": "1/mm * mm", "doubled": "doubled of 1/mm", "halved": "halved of 1/mm"}
    for name, unit in units.items():
        made = Acquired(scene, {"name": name}, acquisition)
        assert made.unit_of_views(GRID, RIGS["cone"]) == unit


def test_finer_grids_converge_to_the_exact_integral(parts):
    """A projector without declaration: its views converge to half the closed form."""
    exact = measured("drr")[1].views / 2
    errors = [
        float((measured("halved", Acquisition(fine=k))[1].views - exact).norm() / exact.norm())
        for k in (2, 4)
    ]
    assert errors[1] < 0.7 * errors[0]


def test_a_projector_that_cannot_refine_only_the_grid_refines_pixels_too(parts):
    """Rows of a stack lie between the slices of a grid twice as fine: the pixels are cut, too."""
    source = source_of({"name": "slices"}, GRID, RIGS["cone"], 2)
    assert isinstance(source, Projection) and source.rays == 2
    drr = {"name": "drr", "rays_per_pixel": 2}
    exact = Acquired(SCENES.build("ellipsoids"), drr).sample(2, 0, GRID, RIGS["cone"]).views
    assert (measured("slices")[1].views - exact).norm() < 0.12 * exact.norm()


def test_a_projector_that_does_not_support_finer_grids_is_refused(parts):
    """A projector that cannot make views on a finer grid is refused, with its own reason, once."""
    with pytest.raises(ValueError, match="'stubborn' cannot .* 2 times finer .*: this grid alone$"):
        source_of({"name": "stubborn"}, GRID, RIGS["cone"], 2)


def test_pixels_of_several_rays_are_their_mean():
    """`rays_per_pixel: 3` measures the mean of nine closed-form integrals, those of the cut
    detector.
    """
    rig, scene = RIGS["cone"], SCENES.build("ellipsoids")
    views = Acquired(scene, {"name": "drr", "rays_per_pixel": 3}).sample(0, 0, GRID, rig).views
    lines = scene.sample(0, 0, GRID, rig.refined(3)).views
    assert torch.allclose(views, torch.nn.functional.avg_pool2d(lines, 3))


def test_pixels_on_the_finer_grid_are_the_mean_of_their_rays():
    """`rays: 3` on the finer grid, of the detector cut into nine pixels."""
    rig, scene = RIGS["cone"], SCENES.build("ellipsoids")
    thin = Acquired(scene, {"name": "drr"}, Acquisition(closed_form=False))
    lines = thin.sample(0, 0, GRID, rig.refined(3)).views
    mean = Acquired(scene, {"name": "drr"}, Acquisition(closed_form=False, rays=3))
    views = mean.sample(0, 0, GRID, rig).views
    torch.testing.assert_close(views, torch.nn.functional.avg_pool2d(lines, 3))
    assert not torch.allclose(views, thin.sample(0, 0, GRID, rig).views, rtol=1e-2)
