"""A breathing object: an invertible deformation that is at rest at the back, the views of its
phases, and the drawing of phases.
"""

import math
from dataclasses import replace

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.core.numbers import generator, mixed
from mvrecon.core.parts import PROJECTORS, SCENES
from mvrecon.data.acquisition.acquired import ERRORS, Acquired
from mvrecon.data.acquisition.breathing import (
    DIRECTION,
    SPINE,
    breathed,
    breathing_views,
    check_amplitude,
    share,
)
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.data.acquisition.disturbances import Disturbance, rig_errors
from mvrecon.data.dataset import SceneDataset
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.operators.drr import Drr
from mvrecon.operators.radon import Radon
from tests.data.acquisition.test_projectors import Slices

GRID = Grid.centred(size=(16, 18, 20), spacing=(12.0, 10.0, 11.0))
SQUARE = {"pixels": [40, 44], "pixel_mm": 9.0}
#: Rigs, and the projectors that take them: a cone, parallel beams, pinholes.
RIGS = {
    "cone": (circular(8, 600.0, 900.0, SQUARE, arc_degrees=180.0), "drr"),
    "parallel": (parallel(8, SQUARE | {"pixel_mm": 6.0}, 600.0), "radon"),
    "dome": (dome(8, 400.0, 200.0, 120.0, SQUARE | {"pixel_mm": 2.5}), "drr"),
}
OPERATORS = {"drr": Drr, "radon": Radon}
#: Where the ball is at rest, in mm, and its radius.
CENTRE, RADIUS = (10.0, 40.0, 8.0), 12.0


class Ball(Scene):
    """A ball in the front half of the grid."""

    data_range, unit, length = 1.0, "1/mm", None

    def finer(self, index, seed, grid, cameras, factor):
        ball = Solids(
            "ellipsoid",
            torch.tensor([CENTRE]),
            torch.eye(3)[None],
            torch.full((1, 3), RADIUS),
            torch.ones(1),
        )
        return voxelise(Phantom((ball,)), grid.refined(factor))[None]

    def sample(self, index, seed, grid, cameras):
        volume = torch.nn.functional.avg_pool3d(self.finer(index, seed, grid, cameras, 2)[None], 2)
        return Sample(torch.zeros(1, 0, 0, 0), volume[0], volume[0] > 0, f"ball-{index}")


def options(**others):
    given = {"views": 8, "breathing_mm": 15.0, "probability": 0.5} | others
    return {"fine": 4, "closed_form": False, "disturbed": given}


def acquired(scene, projector, fine=4, **disturbed):
    acquisition = Acquisition.of(options(**disturbed) | {"fine": fine})
    return Acquired(scene, {"name": projector}, acquisition)


def still(scene, projector, fine=4):
    return Acquired(scene, {"name": projector}, Acquisition(fine=fine, closed_form=False))


def moved_to(rest, grid, mm):
    """The place of a point after an amplitude: Y = X + mm s(Y) d, by fixed-point iteration."""
    sides = torch.tensor(grid.size).double() * torch.tensor(grid.spacing).double()
    place, direction = rest.clone(), torch.tensor(DIRECTION).double()
    for _ in range(100):
        place = rest + mm * share((place - grid.centre) / sides)[..., None] * direction
    return place


@pytest.mark.parametrize("rig", RIGS)
def test_a_ball_moves_in_the_views_of_its_phase_as_its_centre_is_projected(rig):
    """To 0.1 pixel, over more than a pixel, in all phases; in views at rest its image stays."""
    (cameras, projector), scene = RIGS[rig], Ball()
    centre, phases, farthest = torch.tensor(CENTRE).double(), set(), 0.0
    for index in range(4):
        case = acquired(scene, projector).sample(index, 0, GRID, cameras)
        v, u = (torch.arange(n).double() for n in cameras.shape)
        weights = case.views[0].double() / case.views[0].double().sum(dim=(1, 2), keepdim=True)
        seen = torch.stack([(weights.sum(1) * u).sum(1), (weights.sum(2) * v).sum(1)], dim=1)
        amplitudes = case.errors["breathing_mm"].double()
        for view, mm in enumerate(amplitudes.tolist()):
            expected = cameras.project(moved_to(centre, GRID, mm))[view, :2]
            assert (seen[view] - expected).abs().max() < 0.1
        phases |= {round(3 * mm / float(amplitudes.max())) for mm in amplitudes.tolist() if mm}
        away = (seen - cameras.project(centre)[:, :2]).norm(dim=1)
        farthest = max(farthest, float(away.max()))
    assert phases == {1, 2, 3} and farthest > 1


@pytest.mark.parametrize("rig", RIGS)
def test_views_of_each_phase_are_the_projector_s_views_of_the_deformed_object(rig):
    """Those at rest are those of an acquisition without errors, bit by bit."""
    (cameras, projector), scene = RIGS[rig], SCENES.build("ellipsoids", value=0.02)
    case = acquired(scene, projector, fine=2).sample(3, 0, GRID, cameras)
    clean = still(scene, projector, fine=2).sample(3, 0, GRID, cameras)
    assert torch.equal(case.volume, clean.volume) and torch.equal(case.inside, clean.inside)
    amplitudes = rig_errors(
        Disturbance(views=8, breathing_mm=15.0, probability=0.5), cameras, drawn(3)
    ).breathing_mm
    rest, wrong = amplitudes == 0, case.errors["wrong"]
    assert 0 < int(rest.sum()) < 8 and torch.equal(wrong, ~rest)
    assert torch.equal(case.views[:, rest], clean.views[:, rest])
    A = OPERATORS[projector](GRID.refined(2), cameras)
    volume = scene.finer(3, 0, GRID, cameras, 2)
    for view in (~rest).nonzero()[:, 0].tolist():
        moved = breathed(volume, A.grid, float(amplitudes[view]))
        expected = A(moved[None])[0, :, view]
        torch.testing.assert_close(case.views[:, view], expected, rtol=1e-5, atol=1e-6)
        assert (expected - clean.views[:, view]).norm() > 0.003 * clean.views[:, view].norm()


def drawn(index):
    """The generator of the errors of a case of series 0."""
    return generator(ERRORS, mixed(0, index))


def test_views_of_a_projector_with_finer_pixels_are_averaged(monkeypatch):
    monkeypatch.setitem(PROJECTORS._parts, "slices", Slices)
    scene = SCENES.build("ellipsoids", value=0.02)
    rig = circular(8, 600.0, 900.0, {"pixels": [20, 24], "pixel_mm": 18.0})
    case, plain = (
        acquired(scene, name, fine=2).sample(0, 0, GRID, rig) for name in ("slices", "drr")
    )
    assert torch.equal(case.errors["breathing_mm"], plain.errors["breathing_mm"])
    assert case.views.shape == plain.views.shape
    assert (case.views - plain.views).norm() < 0.1 * plain.views.norm()
    clean = still(scene, "slices", fine=2).sample(0, 0, GRID, rig)
    rest = ~case.errors["wrong"]
    assert rest.any() and torch.equal(case.views[:, rest], clean.views[:, rest])


@pytest.mark.parametrize("disturbed", [{"breathing_mm": 0.0}, {"probability": 0.0}])
def test_without_breathing_views_are_those_of_an_ideal_acquisition(disturbed):
    """Bit by bit, as the object."""
    (cameras, projector), scene = RIGS["cone"], SCENES.build("ellipsoids", value=0.02)
    case = acquired(scene, projector, fine=2, **disturbed).sample(0, 0, GRID, cameras)
    clean = still(scene, projector, fine=2).sample(0, 0, GRID, cameras)
    assert torch.equal(case.views, clean.views) and torch.equal(case.volume, clean.volume)
    assert not case.errors["wrong"].any()


def test_no_amplitude_in_its_range_folds_the_object():
    """The Jacobian's determinant of the map to the place at rest, by automatic derivatives, is
    above 0 up to the limit, and no longer at twice the limit. Also tried: grids that are shortest
    along y and along z.
    """
    for size in ((32, 32, 32), (20, 8, 40), (6, 40, 40)):
        grid = Grid.centred(size=size, spacing=(16.0, 10.0, 12.0))
        sides = torch.tensor(size).double() * torch.tensor([16.0, 10.0, 12.0]).double()
        limit = limit_of(grid)
        places = sides * (torch.rand(20000, 3, generator=generator(0, 0)).double() - 0.5)

        def rest(place, mm, sides=sides):
            moved = share(place / sides)[..., None] * torch.tensor(DIRECTION).double()
            return place - mm * moved

        def least(mm, rest=rest, places=places):
            jacobian = torch.func.vmap(torch.func.jacrev(lambda p: rest(p, mm)))(places)
            return float(torch.linalg.det(jacobian).min())

        assert all(least(part * limit) > 0 for part in (0.25, 0.5, 0.75, 0.999))
        assert least(2 * limit) < 0
        # from the place at rest back: one to one
        there = moved_to(places, grid, 0.5 * limit)
        torch.testing.assert_close(rest(there, 0.5 * limit), places, rtol=0, atol=1e-6)


def limit_of(grid):
    """The greatest amplitude in mm that a grid accepts, by bisection."""
    low, high = 0.0, 1e4
    for _ in range(60):
        middle = (low + high) / 2
        try:
            check_amplitude(grid, middle)
            low = middle
        except ValueError:
            high = middle
    return low


def test_the_spine_and_the_faces_of_the_grid_do_not_move():
    """What lies behind the spine keeps its bits. At the faces but the front and back, displacement
    and its slope are zero.
    """
    grid = GRID.refined(2)
    volume = torch.rand(1, *grid.shape, generator=generator(1, 0))
    moved, y = breathed(volume, grid, 15.0), voxel_centres(grid)[0, :, 0, 1]
    back = y <= SPINE * 180.0
    assert int(back.sum()) == 20 and torch.equal(moved[:, :, back], volume[:, :, back])
    assert (moved != volume)[0, 1:-1, ~back, 1:-1].double().mean() > 0.95
    ends = torch.tensor([-0.5, 0.5]).double()
    inner = torch.rand(200, 3, generator=generator(2, 0)).double() - 0.5
    for axis, end in [(0, ends[0]), (0, ends[1]), (2, ends[0]), (2, ends[1]), (1, SPINE)]:
        face = inner.clone()
        face[:, axis] = end
        face.requires_grad_()
        displacement = share(face)
        (slope,) = torch.autograd.grad(displacement.sum(), face)
        assert displacement.abs().max() < 1e-12 and slope.abs().max() < 1e-7
    assert float(share(torch.tensor([0.0, 0.5, 0.0]).double())) == pytest.approx(1.0)
    assert float(share(inner).max()) <= 1 and math.hypot(*DIRECTION) == pytest.approx(1.0)
    assert DIRECTION[1] > 0 > DIRECTION[2], "forward and towards the feet, in RAS"


def test_values_move_unchanged():
    """Of a volume that is linear along the motion, the deformed one has the values at the places
    at rest, which trilinear interpolation meets exactly.
    """
    index, grid = voxel_centres(GRID), GRID
    sides = torch.tensor(grid.size).double() * torch.tensor(grid.spacing).double()
    ramp = (500 + index[..., 1] + 2 * index[..., 2])[None].float()
    shift = 12.0 * share(index / sides)[..., None] * torch.tensor(DIRECTION).double()
    rest = index - shift
    expected = (500 + rest[..., 1] + 2 * rest[..., 2]).float()
    inner = (slice(1, -1), slice(1, -1), slice(1, -1))
    moved = breathed(ramp, grid, 12.0)[0]
    assert (moved - ramp[0])[inner].abs().max() > 15
    torch.testing.assert_close(moved[inner], expected[inner], rtol=0, atol=5e-3)


def test_each_drawn_view_is_in_one_phase_of_its_case():
    """Three phases, equally often, and rest; the amplitude is that of the case, from an eighth of
    the option to the option. Drawn after all other errors, which keep their numbers.
    """
    cameras, counts, depths = RIGS["cone"][0], torch.zeros(3), []
    faults = {"views": 8, "rod": 0.3, "scatter": 0.1, "dead": 0.1, "shift_px": 1.0, "lost": 1}
    for index in range(200):
        one, breathing = (
            rig_errors(
                Disturbance(**faults, probability=0.5, breathing_mm=mm), cameras, drawn(index)
            )
            for mm in (0.0, 15.0)
        )
        mm = breathing.breathing_mm
        assert not one.breathing_mm.any()
        zeroed = replace(breathing, breathing_mm=one.breathing_mm).record()
        assert all(torch.equal(value, zeroed[name]) for name, value in one.record().items())
        others = replace(breathing, breathing_mm=torch.zeros(8)).record()["wrong"]
        assert torch.equal(breathing.record()["wrong"], others | (mm > 0))
        levels = mm[mm > 0].unique()
        assert len(levels) <= 3
        if len(levels) == 3:
            thirds = levels[-1] * torch.tensor([1.0, 2.0, 3.0]).double() / 3
            torch.testing.assert_close(levels, thirds, rtol=1e-12, atol=0)
            depths.append(float(levels[-1]))
            counts += torch.stack([(mm == level).sum() for level in levels])
    assert 15 / 8 <= min(depths) < 4 and 12 < max(depths) <= 15
    # a third each, within 4 standard errors
    n = float(counts.sum())
    assert (counts / n - 1 / 3).abs().max() < 4 * (2 / 9 / n) ** 0.5


def test_phases_are_drawn_anew_in_each_epoch_and_repeatable():
    (cameras, projector), scene = RIGS["cone"], Ball()

    def cases(item):
        made = acquired(scene, projector, fine=2)
        return SceneDataset(made, GRID, cameras, [0, 1], seed=5, fresh=2)[item]

    first, later, again = cases(0), cases(2), cases(0)
    assert not torch.equal(first["breathing_mm"], later["breathing_mm"])
    assert not torch.equal(first["views"], later["views"])
    assert all(torch.equal(first[key], again[key]) for key in ("breathing_mm", "views"))


class Attenuated(Drr):
    """A projector that attenuates what it projects by a map."""

    def __init__(self, grid, cameras, mu=None):
        super().__init__(grid, cameras)
        self.mu = mu

    def forward(self, volume):
        return super().forward(volume)

    def mu_map(self):
        return self.mu


class Patient(Ball):
    """A ball with an attenuation map."""

    map_names = ("mu",)

    def maps(self, index, seed, grid, factor=1):
        return {"mu": 0.01 * self.finer(index, seed, grid, None, factor)}


def test_breathing_that_cannot_be_simulated_is_refused(monkeypatch):
    """Views in closed form, of no projector, with an attenuation that does not breathe; a grid
    that is too small.
    """
    scene, cameras = SCENES.build("ellipsoids"), RIGS["cone"][0]
    exact = Acquisition.of(options() | {"closed_form": True})
    for projector, acquisition, got in (
        ({"name": "drr"}, exact, "projector drr and closed_form True"),
        (None, Acquisition.of(options()), "projector None and closed_form False"),
    ):
        with pytest.raises(ValueError, match=f"closed_form=false, got {got}"):
            Acquired(scene, projector, acquisition)
    monkeypatch.setitem(PROJECTORS._parts, "attenuated", Attenuated)
    with pytest.raises(ValueError, match="not its attenuation; expected a projector without"):
        acquired(Patient(), "attenuated", probability=1.0).sample(0, 0, GRID, cameras)
    assert Acquired(Patient(), {"name": "attenuated"}).sample(0, 0, GRID, cameras).views.any()
    small = Grid.centred(8, spacing=5.0)
    for index in range(3):  # whatever is drawn
        with pytest.raises(ValueError, match=r"from 0 to below 8\.63 mm.* got 15"):
            acquired(scene, "drr", probability=0.1).sample(index, 0, small, cameras)
    with pytest.raises(ValueError, match=r"amplitude of breathing from 0 .* got -1"):
        breathing_views(Drr(GRID, cameras), torch.zeros(1, *GRID.shape), [-1.0] * 8)


def test_the_choice_breathing_composes_with_the_experiments_it_is_for():
    for experiment in ("open_kbp", "open_kbp_rig_errors"):
        given = compose(f"experiment={experiment}", "acquisition=breathing")["acquisition"]
        acquisition = Acquisition.of(given)
        assert acquisition.disturbed is not None and acquisition.disturbed.breathing_mm == 15.0
        assert not acquisition.closed_form
