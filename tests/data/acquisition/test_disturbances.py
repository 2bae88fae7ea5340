"""Rig errors that methods do not know: which views, by how much, and that they are those of a moved
detector."""

from dataclasses import asdict, replace

import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.core.parts import CAMERAS, PROJECTORS, SCENES
from mvrecon.data.acquisition.acquired import Acquired
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.data.acquisition.disturbances import Disturbance, RigErrors, rig_errors
from mvrecon.geometry.grid import Grid
from mvrecon.operators.drr import Drr
from mvrecon.report.result_table import remarks

GRID = Grid.centred((12, 12, 12), 10.0)
DETECTOR = {"pixels": [12, 16], "pixel_mm": 20.0}
RIGS = {
    "cone": CAMERAS.build("circular", n_views=5, sid=400.0, sdd=800.0, detector=DETECTOR),
    "parallel": CAMERAS.build("parallel", n_views=5, detector=DETECTOR),
}

ZERO, THREE = torch.zeros(5, dtype=torch.float64), torch.zeros(5, 3, dtype=torch.float64)
NONE = RigErrors(
    shift_px=THREE[:, :2],
    gain=ZERO + 1,
    tilt_deg=THREE,
    motion_mm=THREE,
    saturated=ZERO,
    truncated=ZERO,
    rod=torch.zeros(5, 4, dtype=torch.float64),
    scatter=ZERO,
    columns=torch.zeros(5, 16, dtype=torch.float64),
    breathing_mm=ZERO,
)


def measured(rig="cone", index=0, projector="drr", detector=None, **options):
    disturbed = Disturbance(**options) if options else None
    scene = SCENES.build("ellipsoids", value=0.02)
    acquisition = Acquisition(disturbed=disturbed, **detector or {})
    acquired = Acquired(scene, {"name": projector}, acquisition)
    return acquired.sample(index, 0, GRID, RIGS[rig])


@pytest.mark.parametrize("rig", RIGS)
def test_the_shift_of_the_image_is_that_of_detector_tilt_and_motion_together(rig):
    """In pixels of 20 mm; the cone's detector is magnified twice."""
    volume, offset = torch.zeros(GRID.shape), torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    volume[5:7, 5:7, 5:7] = 1.0  # about the centre, where all rays are perpendicular
    shift = replace(NONE, shift_px=offset.expand(5, 2))
    torch.testing.assert_close(shift.image_shift(RIGS[rig], volume, GRID), shift.shift_px)
    rise = replace(NONE, motion_mm=torch.tensor([0.0, 0.0, 5.0]).expand(5, 3))
    pixels = 5.0 / 20.0 * (2.0 if rig == "cone" else 1.0)
    along = rise.image_shift(RIGS[rig], volume, GRID)
    assert along.abs().amax(dim=1).tolist() == pytest.approx([pixels] * 5, rel=1e-2)
    assert torch.allclose(along[:, 0], torch.zeros(5, dtype=torch.float64), atol=1e-9)


@pytest.mark.parametrize("rig", RIGS)
def test_a_detector_shifted_by_whole_pixels_measures_shifted_views(rig):
    scene = SCENES.build("ellipsoids")
    offset = torch.tensor([[1.0, 2.0]]).expand(5, 2)
    moved = replace(NONE, shift_px=offset).rig(RIGS[rig])
    views = scene.sample(0, 0, GRID, RIGS[rig]).views
    seen = scene.sample(0, 0, GRID, moved).views
    assert torch.allclose(seen[..., :-2, :-1], views[..., 2:, 1:], atol=1e-4 * float(views.max()))


def test_the_given_number_of_views_is_disturbed_for_the_same_object():
    plain = measured()
    for index in range(3):
        plain, wrong = measured(index=index), measured(index=index, views=2, shift_px=1.0)
        changed = (wrong.views != plain.views).flatten(2).any(dim=2)[0]
        assert int(changed.sum()) == 2
        assert torch.equal(wrong.volume, plain.volume)


def test_a_gain_is_a_factor_of_a_view_within_its_bounds():
    plain, wrong = measured().views, measured(views=5, gain=0.05).views
    factor = (wrong.double().sum(dim=(0, 2, 3)) / plain.double().sum(dim=(0, 2, 3)))[:, None, None]
    assert torch.allclose(wrong.double(), plain.double() * factor, rtol=1e-5)
    assert 0.001 < float((factor - 1).abs().max()) <= 0.05


def test_shifts_differ_between_cases_and_are_reproducible():
    options = {"views": 5, "shift_px": 0.7}
    errors = [rig_errors(Disturbance(**options), RIGS["cone"], generator(0, i)) for i in range(40)]
    offsets = torch.stack([one.shift_px for one in errors])
    assert float(offsets.abs().max()) <= 0.7
    # of a uniform number: 200 draws along each axis, within 4 standard errors
    assert float(offsets.square().mean()) == pytest.approx(0.7**2 / 3, rel=0.18)
    assert torch.equal(measured(index=4, **options).views, measured(index=4, **options).views)


class Halved(Drr):
    """A projector that does not declare how its pixels depend on line integrals."""

    def forward(self, volume):
        return super().forward(volume) / 2


def test_a_projector_on_a_finer_grid_is_disturbed_as_line_integrals_are(monkeypatch):
    """Its operator is that of the moved detectors; without the shift the views are far off."""
    monkeypatch.setitem(PROJECTORS._parts, "halved", Halved)
    options = {"views": 5, "shift_px": 3.0}
    views, line = measured(projector="halved", **options).views, measured(**options).views / 2
    still = measured(projector="halved").views
    assert (views - line).norm() < 0.15 * line.norm() < 0.5 * (views - still).norm()


def test_views_of_a_motion_equal_views_of_the_moved_object():
    """A scene shifted by one voxel along x, y and z, compared with a motion by the same vector."""
    motion = torch.tensor([[10.0, -10.0, 20.0]]).expand(5, 3)
    volume = torch.zeros(1, 1, 12, 12, 12)
    volume[..., 4:7, 5:8, 3:7] = 1.0
    moved = volume.roll((2, -1, 1), dims=(2, 3, 4))
    still = Drr(GRID, RIGS["cone"], method="siddon")
    rig = replace(NONE, motion_mm=motion).rig(RIGS["cone"])
    seen = Drr(GRID, rig, method="siddon")(volume)
    assert torch.allclose(seen, still(moved), rtol=1e-4, atol=1e-3)


def test_a_detector_rotated_about_its_normal_measures_the_rotated_view():
    """By 180 degrees: columns and rows are reversed; the middle of the detector stays."""
    turn = torch.tensor([[0.0, 0.0, 180.0]]).expand(5, 3)
    turned = replace(NONE, tilt_deg=turn).rig(RIGS["cone"])
    scene = SCENES.build("ellipsoids")
    views = scene.sample(0, 0, GRID, RIGS["cone"]).views
    seen = scene.sample(0, 0, GRID, turned).views
    assert torch.allclose(seen.flip(2, 3), views, atol=1e-4 * float(views.max()))


def test_lost_overexposed_and_truncated_views_are_cut_from_correct_ones():
    plain, index = measured().views, torch.arange(16)
    for options in ({"lost": 1}, {"saturated": 0.25}, {"truncated": 0.25}):
        wrong, known = measured(**options), measured(**options).errors["wrong"]
        assert int(known.sum()) == 1
        view, right = wrong.views[0, known][0], plain[0, known][0]
        assert torch.equal(wrong.views[:, ~known], plain[:, ~known])
        if "lost" in options:
            assert not view.any() and float(wrong.errors["gain"][known]) == 0
        elif "saturated" in options:
            assert torch.equal(view, right.clamp_min(0.25 * float(right.max())))
        else:
            ends = right * (index < 12), right * (index >= 4)
            assert any(torch.equal(view, end) for end in ends)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0])
def test_a_rod_adds_the_chords_of_a_cylinder(degrees):
    """Chords of a radius of 8 mm, through parallel rays at a distance of 1 mm."""
    rod = torch.tensor([[0.5, degrees, 0.1, 0.2]])
    plain = torch.full((1, 1, 40, 40), 2.0)
    one = replace(NONE, rod=rod, gain=ZERO[:1] + 1, saturated=ZERO[:1], truncated=ZERO[:1])
    shadow = (one.views(plain) - plain)[0, 0]
    assert float(shadow.max()) == pytest.approx(0.5 * 2.0, rel=0.01)
    along = torch.arange(40.0) - 19.5
    normal = torch.tensor(degrees).deg2rad()
    apart = along * normal.cos() + along[:, None] * normal.sin() - 0.1 * 40
    chord = 2 * (8.0**2 - apart.square()).clamp_min(0).sqrt()  # in mm, of a radius of 8 mm
    torch.testing.assert_close(shadow, chord / 16.0, atol=1e-5, rtol=1e-4)


def test_scatter_of_a_view_is_that_of_an_acquisition_of_this_ratio():
    """From an eighth of the option to the option; line integrals behind matter fall."""
    exact = {"photons": float("inf")}
    plain = measured(detector=exact).views
    wrong = measured(detector=exact, views=2, scatter=0.15)
    ratio = wrong.errors["scatter"]
    assert int((ratio > 0).sum()) == 2 and torch.equal(wrong.errors["wrong"], ratio > 0)
    for m, share in enumerate(ratio.tolist()):
        assert share == 0 or 0.15 / 8 <= share <= 0.15
        same = measured(detector={**exact, "scatter": share}).views
        torch.testing.assert_close(wrong.views[:, m], same[:, m], rtol=1e-5, atol=1e-6)
    behind = plain > 0.1 * plain.max()
    assert (wrong.views < plain)[behind & (ratio > 0)[:, None, None]].all()


def test_dead_and_hot_columns_read_zero_and_the_greatest_value_of_their_view():
    """After the detector's blur, which does not spread them."""
    blurred, kinds = {"blur_mm": 30.0}, set()
    for index in range(4):
        plain = measured(detector=blurred, index=index).views
        wrong = measured(detector=blurred, index=index, views=2, dead=0.25)
        columns = wrong.errors["columns"][:, None].expand(5, 12, 16)
        assert (columns[:, 0] != 0).sum(dim=1).sort().values.tolist() == [0, 0, 0, 4, 4]
        greatest = plain.amax(dim=(2, 3), keepdim=True).expand_as(plain)[0]
        assert torch.equal(wrong.views[0][columns == 0], plain[0][columns == 0])
        assert not wrong.views[0][columns < 0].any()
        reached = (wrong.views[0] == wrong.views[0].amax(dim=(1, 2), keepdim=True))[columns > 0]
        assert reached.all() and (wrong.views[0] <= greatest).all()
        kinds |= set(columns.unique().tolist())
    assert kinds == {-1, 0, 1}


def test_each_fault_of_some_pixels_has_views_of_its_own_and_is_drawn_anew_for_each_case():
    faults = Disturbance(views=2, rod=0.3, scatter=0.1, dead=0.1, probability=0.5)
    errors = [rig_errors(faults, RIGS["cone"], generator(2, i)) for i in range(60)]
    hit = torch.stack(
        [torch.stack([e.rod[:, 0], e.scatter, e.columns.abs().amax(dim=1)]) > 0 for e in errors]
    )
    assert int(hit.sum(dim=2).max()) == 2
    # 120 draws of each, within 4 standard errors
    assert (hit.sum(dim=(0, 2)) / 120 - 0.5).abs().max() < 0.183
    assert (hit[:, 0] != hit[:, 1]).any() and (hit[:, 0] != hit[:, 2]).any()
    again = rig_errors(faults, RIGS["cone"], generator(2, 7))
    assert torch.equal(again.rod, errors[7].rod) and torch.equal(again.columns, errors[7].columns)


def test_views_are_wrong_with_their_probability_and_only_so_many():
    options = {"views": 3, "shift_px": 1.0, "lost": 5, "probability": 0.3}
    errors = [rig_errors(Disturbance(**options), RIGS["cone"], generator(1, i)) for i in range(60)]
    lost = torch.stack([one.gain == 0 for one in errors]).double()
    moved = torch.stack([one.shift_px.any(dim=1) for one in errors])
    # 300 and 180 draws, within 4 standard errors
    assert float(lost.mean()) == pytest.approx(0.3, abs=0.106)
    assert float(moved.sum()) / 180 == pytest.approx(0.3, abs=0.137)
    assert int(moved.sum(dim=1).max()) <= 3


def test_faults_act_on_expected_counts_and_leave_the_other_views_as_many_as_before():
    """Poisson numbers of gain times the expectation; none of a lost view; the same exposure."""
    faults = Disturbance(views=1, gain=0.5, lost=1)
    scene, total = SCENES.build("ellipsoids"), 2e6
    for index in range(3):
        case = index, 0, GRID, RIGS["cone"]
        ideal = Acquired(scene).sample(*case).views.double()
        acquired = Acquired(scene, None, Acquisition(counts=total, disturbed=faults))
        sample = acquired.sample(*case)
        assert sample.errors is not None
        gain = sample.errors["gain"].double()
        assert (gain == 0).sum() == 1 and (gain != 1).sum() >= 1
        dose = total / ideal.sum()
        expected = gain[:, None, None] * ideal * dose
        counts = sample.views.double() * dose
        assert (counts - counts.round()).abs().max() < 1e-2
        assert not counts[0, gain == 0].any()
        of_view, mean = counts.sum(dim=(0, 2, 3)), expected.sum(dim=(0, 2, 3))
        assert ((of_view - mean).abs() <= 5 * mean.sqrt()).all()
        # Poisson: variance over mean of all pixels
        bright = expected > 20
        ratio = ((counts - expected)[bright] ** 2 / expected[bright]).mean()
        assert ratio.item() == pytest.approx(1, abs=5 * (2 / int(bright.sum())) ** 0.5)


def test_a_table_reports_disturbed_views():
    """By each option's name and value."""
    acquisition = asdict(Acquisition(disturbed=Disturbance(views=3, shift_px=1.0, gain=0.05)))
    (line,) = remarks({"acquisition": acquisition})
    assert line.endswith("disturbed.views 3, disturbed.shift_px 1, disturbed.gain 0.05")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"views": 0}, ValueError, "disturbed.views as a whole number of at least 1, got 0"),
        ({"views": 6}, ValueError, "at most the rig's 5 cameras, got 6"),
        ({"shift_px": -1.0}, ValueError, "disturbed.shift_px as a number of at least 0"),
        ({"gain": float("nan")}, ValueError, "disturbed.gain as a number from 0 to below 1"),
        ({"lost": 1.5}, ValueError, "disturbed.lost as a whole number of at least 0, got 1.5"),
        ({"truncated": 1.0}, ValueError, "disturbed.truncated as a number from 0 to below 1"),
        ({"dead": 1.0}, ValueError, "disturbed.dead as a number from 0 to below 1"),
        ({"breathing_mm": -1.0}, ValueError, "disturbed.breathing_mm as a number of at least 0"),
        ({"gain": "5 %"}, TypeError, "disturbed.gain as a number, got '5 %'"),
        ({"shift": 1.0}, TypeError, "no option 'shift'; did you mean 'shift_px'"),
        (3, TypeError, "disturbed is a mapping of views, shift_px, .*, got 3"),
    ],
)
def test_invalid_disturbances_are_refused(options, error, message):
    """Rig errors of no view, of more views than there are, or without a size are refused."""
    with pytest.raises(error, match=message):
        disturbed = Acquisition.of({"disturbed": options}).disturbed
        assert disturbed is not None
        rig_errors(disturbed, RIGS["cone"], generator(0, 0))
