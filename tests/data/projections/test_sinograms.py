"""Sinograms, the angles as rows: in every form they are the same views."""

import h5py
import numpy as np
import pytest
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.training.export import save_views
from tests.data.projections.conftest import COLUMNS, FORMS, ROWS, VIEWS, grey, opened
from tests.data.projections.test_nexus import exchange
from tests.data.projections.test_tiff import written


@pytest.mark.parametrize("form", FORMS)
def test_sinograms_of_slices_are_the_views_of_their_angles(form, tmp_path):
    """One file a slice, or one file in all: row v of view m is row m of sinogram v."""
    scan = FORMS[form](tmp_path, np.ascontiguousarray(grey().swapaxes(0, 1)))
    views = opened(scan, layout="sinogram", kind=None if form == "h5" else "counts")
    assert (views.n_views, views.shape) == (VIEWS, (ROWS, COLUMNS))
    assert torch.equal(views.whole().views, torch.from_numpy(grey().astype("f4")))
    assert torch.equal(views.read(3, 7).views, views.whole().views[3:7])


def test_what_a_file_states_of_all_views_holds_for_its_sinograms(tmp_path):
    """Counts keep their unit, dose and duration, and views an exposure that all slices have: their
    flat field has another. One of each slice is none of a view.
    """
    counts = torch.from_numpy(grey().astype("f4")).swapaxes(0, 1)
    save_views(tmp_path, "a", counts / 10, "spect of activity", True, 10.0, 60.0)
    stack = opened(tmp_path / "a" / "views.h5", layout="sinogram").stack
    stated = (stack.kind, stack.unit, stack.dose, stack.duration_s, stack.attenuated)
    assert stated == ("counts", "spect of activity", 10.0, 60.0, True)
    assert torch.equal(stack.read(0, VIEWS), counts.swapaxes(0, 1))
    times = {"alike": [10] * ROWS, "apart": list(range(10, 10 + ROWS))}
    for name, own in times.items():
        (tmp_path / name).mkdir()
        for k, (image, ms) in enumerate(zip(grey().swapaxes(0, 1), own, strict=True)):
            tag = [(33434, "2I", 1, (ms, 1000), True)]
            written(tmp_path / name / f"{k}.tif", image, extratags=tag)
    tag = [(33434, "2I", 1, (20, 1000), True)]
    written(tmp_path / "flat.tif", np.full((ROWS, COLUMNS), 60_000, "u2"), extratags=tag)
    options = {"layout": "sinogram", "flat": str(tmp_path / "flat.tif"), "find_bad_pixels": False}
    with pytest.warns(UserWarning, match="flat field has the ExposureTime 20, its views have 10,"):
        plain = opened(tmp_path / "alike", **options).whole().views
    exposed = opened(tmp_path / "alike", exposure="ExposureTime", **options).whole().views
    assert torch.allclose(exposed, plain - np.log(2), atol=1e-5)
    with pytest.warns(UserWarning, match="several values of ExposureTime"):
        assert opened(tmp_path / "apart", **options).stack.exposure("ExposureTime") is None


def test_fields_of_sinograms_are_views_or_sinograms(tmp_path):
    """Flat fields are given as one image of a view's shape, or as sinograms of several."""
    np.save(tmp_path / "scan.npy", grey().swapaxes(0, 1))
    flat = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS) + 60_000
    np.save(tmp_path / "one.npy", flat)
    several = np.stack([flat - 1, flat + 1])
    np.save(tmp_path / "several.npy", several.swapaxes(0, 1))
    np.save(tmp_path / "wrong.npy", several[:, 1:])
    np.save(tmp_path / "either.npy", np.stack([flat + k for k in range(ROWS)]))
    expected = torch.from_numpy(-np.log(grey() / flat)).float()
    for name in ("one", "several"):
        views = opened(tmp_path / "scan.npy", layout="sinogram", flat=tmp_path / f"{name}.npy")
        assert torch.allclose(views.whole().views, expected, atol=1e-6)
    with pytest.raises(Refused, match="expected a flat field of the views'"):
        opened(tmp_path / "scan.npy", layout="sinogram", flat=tmp_path / "wrong.npy")
    with pytest.raises(Refused, match="of which the axis of rows is known, got 6 images"):
        opened(tmp_path / "scan.npy", layout="sinogram", flat=tmp_path / "either.npy")


def test_sinograms_of_data_exchange(tmp_path):
    """Data Exchange in the order y:theta:x, with fields in that order and an angle a row."""
    angles = np.linspace(0, 180, VIEWS)
    fields = {"data": grey().swapaxes(0, 1), "data_white": np.full((ROWS, 2, COLUMNS), 60_000.0)}
    path = exchange(tmp_path / "a.h5", theta=angles, data_dark=None, **fields)
    with h5py.File(path, "a") as file:
        file["exchange/data"].attrs["axes"] = np.bytes_("y:theta:x")
    views = opened(path, layout="sinogram")
    assert views.stack.rig["angles"] == angles.tolist()
    expected = torch.from_numpy(-np.log(grey() / 60_000)).float()
    assert torch.allclose(views.whole().views, expected, atol=1e-6)
