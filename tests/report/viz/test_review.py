"""What sheets of a review show: errors, differences from the mean, weights."""

import pytest
import torch

from mvrecon.geometry.grid import Grid
from mvrecon.report.viz import review

GRID = Grid.centred(size=(8, 6, 4), spacing=(1.0, 1.0, 2.0))
CASE = review.CaseSheets("patient 7", GRID, 2.0, "1/mm", "1")


@pytest.fixture(autouse=True)
def columns(monkeypatch):
    """A sheet is its columns."""
    monkeypatch.setattr(review, "sheet", lambda title, columns, rows: columns)


def test_every_volume_is_shown_above_its_error():
    truth = torch.rand(GRID.shape)
    shown = review.planes(CASE, truth, {"ours": truth + 0.5, "sirt": 0.5 * truth})
    assert [column.name for column in shown] == ["truth", "ours", "sirt"]
    volumes, errors = shown[1].panels[::2], shown[1].panels[1::2]
    for before, volume, error in zip(shown[0].panels[::2], volumes, errors, strict=True):
        torch.testing.assert_close(volume.pixels - before.pixels, error.pixels)
        assert (volume.scale.low, volume.scale.high) == (0.0, 2.0)
        assert error.scale.low == -error.scale.high and "1/mm" in error.scale.name


def test_per_view_estimates_are_differences_from_their_mean():
    volumes = torch.rand(5, *GRID.shape)
    mean, *others = review.per_view(CASE, volumes)
    assert len(others) == 5
    for k, plane in enumerate(mean.panels):
        together = sum(column.panels[k].pixels for column in others)
        torch.testing.assert_close(together, torch.zeros_like(plane.pixels), atol=1e-5, rtol=0)


@pytest.mark.parametrize("count", [2, 5])
def test_equal_weights_are_at_one_third_of_the_scale(count):
    for column in review.weights(CASE, torch.full((count, *GRID.shape), 1 / count)):
        panel = column.panels[0]
        assert panel.pixels.max() / panel.scale.high == pytest.approx(1 / 3)
        assert panel.pixels.max() == pytest.approx(panel.scale.mark)


def test_a_few_of_many_cameras_are_shown_with_the_nrmse_of_their_views():
    measured = torch.rand(80, 3, 4) + 1
    shown = review.views(measured, 1.1 * measured)
    assert [column.name.split("\n") for column in shown] == [
        [f"camera {10 * k}", "0.100"] for k in range(review.MAX_CAMERAS)
    ]


def test_a_title_states_how_many_cameras_a_sheet_shows(monkeypatch):
    monkeypatch.setattr(review, "sheet", lambda title, columns, rows: title)
    for count, end in (
        (review.MAX_CAMERAS - 1, "per-view estimates"),
        (8, "per-view estimates, 7 of 8 cameras"),
    ):
        assert review.per_view(CASE, torch.rand(count, *GRID.shape)).endswith(end)
    views = torch.rand(80, 3, 4)
    assert review.views(views, views).endswith("views, 8 of 80 cameras")
    assert review.weights(CASE, torch.rand(8, *GRID.shape)).endswith("weights of cameras")


def test_a_stack_of_slices_is_the_volume():
    truth = torch.rand(GRID.shape)
    stack = [review.slices(CASE, truth, {"x": truth}, z)[0].panels[0] for z in range(len(truth))]
    shown = torch.stack([panel.pixels for panel in stack])
    torch.testing.assert_close(shown, truth.flip(1, 2))
    assert [panel.name for panel in stack] == [f"z = {mm} mm" for mm in (-3, -1, 1, 3)]


def test_a_hot_voxel_does_not_darken_a_scan():
    """The scale ends where the content does, and below 0 only if more than single voxels do."""
    grid = Grid.centred(40, spacing=2.0)
    volume = torch.rand(grid.shape)
    case = review.CaseSheets("", grid, 1.0, "activity", centre=grid.centre)
    expected = review.scan(case, volume)[0].panels[0].scale
    assert expected.low == 0 and expected.high == pytest.approx(1.0, abs=0.02)
    volume[20, 0, 0], volume[20, 0, 1] = 1e3, -1e3
    scale = review.scan(case, volume)[0].panels[0].scale
    assert scale.low == 0 and scale.high == pytest.approx(expected.high, abs=0.01)
    assert review.scan(case, volume - 1)[0].panels[0].scale.low == pytest.approx(-1.0, abs=0.02)
