"""Rig errors that nobody knows: which views, by how much, and that they are those of a moved
detector."""

from dataclasses import asdict

import pytest
import torch

from mvrecon.acquisition.acquired import Acquired
from mvrecon.acquisition.disturbances import Disturbance, RigErrors, rig_errors
from mvrecon.acquisition.settings import Acquisition
from mvrecon.engine.report import remarks
from mvrecon.geometry.grid import Grid
from mvrecon.parts import CAMERAS, PROJECTORS, SCENES
from mvrecon.projectors.drr import Drr
from mvrecon.scenes.analytic import generator

GRID = Grid.centred((12, 12, 12), 10.0)
DETECTOR = {"pixels": [12, 16], "pixel_mm": 20.0}
RIGS = {
    "cone": CAMERAS.build("circular", n_views=5, sid=400.0, sdd=800.0, detector=DETECTOR),
    "parallel": CAMERAS.build("parallel", n_views=5, detector=DETECTOR),
}


def measured(rig="cone", index=0, projector="drr", **options):
    disturbed = Disturbance(**options) if options else None
    scene = SCENES.build("ellipsoids")
    acquired = Acquired(scene, {"name": projector}, Acquisition(disturbed=disturbed))
    return acquired.sample(index, 0, GRID, RIGS[rig])


@pytest.mark.parametrize("rig", RIGS)
def test_a_detector_moved_by_one_column_and_two_rows_sees_what_its_neighbours_saw(rig):
    scene = SCENES.build("ellipsoids")
    offset = torch.tensor([[1.0, 2.0]]).expand(5, 2)
    moved = RigErrors(offset, torch.ones(5, 1, 1)).rig(RIGS[rig])
    views = scene.sample(0, 0, GRID, RIGS[rig]).views
    seen = scene.sample(0, 0, GRID, moved).views
    assert torch.allclose(seen[..., :-2, :-1], views[..., 2:, 1:], atol=1e-4 * float(views.max()))


def test_so_many_views_are_disturbed_and_the_object_is_the_same():
    plain = measured()
    for index in range(3):
        plain, wrong = measured(index=index), measured(index=index, views=2, shift_px=1.0)
        changed = (wrong.views != plain.views).flatten(2).any(dim=2)[0]
        assert int(changed.sum()) == 2
        assert torch.equal(wrong.volume, plain.volume)


def test_a_share_of_the_cases_has_errors_and_these_are_whole():
    kind = {"views": 2, "shift_px": 1.0, "gain": 0.05}
    draws = [
        rig_errors(Disturbance(**kind, share=0.5), RIGS["cone"], generator(0, index))
        for index in range(200)
    ]
    wrong = [int(draw.offset_px.any(dim=1).sum()) for draw in draws]
    assert set(wrong) == {0, 2} and 70 < wrong.count(2) < 130
    assert [int((draw.gain != 1).sum()) for draw in draws] == wrong
    with pytest.raises(ValueError, match="share from 0 to 1, got 1.5"):
        Disturbance(**kind, share=1.5)


def test_a_gain_is_a_factor_of_a_view_within_its_bounds():
    plain, wrong = measured().views, measured(views=5, gain=0.05).views
    factor = (wrong.double().sum(dim=(0, 2, 3)) / plain.double().sum(dim=(0, 2, 3)))[:, None, None]
    assert torch.allclose(wrong.double(), plain.double() * factor, rtol=1e-5)
    assert 0.001 < float((factor - 1).abs().max()) <= 0.05


def test_shifts_are_drawn_anew_for_each_case_and_again_for_the_same():
    options = {"views": 5, "shift_px": 0.7}
    errors = [rig_errors(Disturbance(**options), RIGS["cone"], generator(0, i)) for i in range(40)]
    offsets = torch.stack([one.offset_px for one in errors])
    assert float(offsets.abs().max()) <= 0.7
    # of a uniform number: 200 draws along each axis, within 4 standard errors
    assert float(offsets.square().mean()) == pytest.approx(0.7**2 / 3, rel=0.18)
    assert torch.equal(measured(index=4, **options).views, measured(index=4, **options).views)


class Halved(Drr):
    """A projector that does not say how its pixels are made of line integrals."""

    def forward(self, volume):
        return super().forward(volume) / 2


def test_a_projector_on_a_finer_grid_is_disturbed_as_line_integrals_are(monkeypatch):
    """Its operator is that of the moved detectors; without the shift the views are far off."""
    monkeypatch.setitem(PROJECTORS._parts, "halved", Halved)
    options = {"views": 5, "shift_px": 3.0}
    views, line = measured(projector="halved", **options).views, measured(**options).views / 2
    still = measured(projector="halved").views
    assert (views - line).norm() < 0.15 * line.norm() < 0.5 * (views - still).norm()


def test_a_table_says_that_views_were_disturbed():
    """By each option's name and value."""
    acquisition = asdict(Acquisition(disturbed=Disturbance(views=3, shift_px=1.0, gain=0.05)))
    (line,) = remarks({"acquisition": acquisition})
    assert line.endswith("disturbed.views 3, disturbed.shift_px 1, disturbed.gain 0.05")


@pytest.mark.door
@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"views": 0}, ValueError, "disturbed.views as a whole number of at least 1, got 0"),
        ({"views": 6}, ValueError, "at most the rig's 5 cameras, got 6"),
        ({"shift_px": -1.0}, ValueError, "disturbed.shift_px of at least 0"),
        ({"gain": float("nan")}, ValueError, "disturbed.gain from 0 to below 1"),
        ({"gain": "5 %"}, TypeError, "disturbed.gain as a number, got '5 %'"),
        ({"shift": 1.0}, TypeError, "no option 'shift'; did you mean 'shift_px'"),
        (3, TypeError, "disturbed is a mapping of views, shift_px, gain, got 3"),
    ],
)
def test_disturbances_that_make_no_sense_are_refused(options, error, message):
    """Rig errors of no view, of more views than there are, or without a size are refused."""
    with pytest.raises(error, match=message):
        disturbed = Acquisition.of({"disturbed": options}).disturbed
        assert disturbed is not None
        rig_errors(disturbed, RIGS["cone"], generator(0, 0))
