"""Grey values are converted back to their line integrals, and the geometry follows the pixels."""

import math
import shutil
from dataclasses import fields

import numpy as np
import pytest
import SimpleITK as sitk
import torch
import yaml
from PIL import Image as Pillow

from mvrecon.core.files.checks import Refused
from mvrecon.core.parts import CAMERAS, PROJECTORS
from mvrecon.data.projections.faults import filled
from mvrecon.data.projections.opening import open_projections
from mvrecon.data.projections.stack import Region
from mvrecon.data.projections.views import Measured
from mvrecon.data.projections.writing import Exposure, write_projections
from mvrecon.geometry.grid import Grid
from tests.data.conftest import RIG
from tests.data.projections.conftest import VIEWS, grey, opened


def views(count=3, rows=20, columns=30):
    """Smooth line integrals from 0 to 4."""
    m, v, u = np.meshgrid(np.arange(count), np.arange(rows), np.arange(columns), indexing="ij")
    return torch.from_numpy(2 + 2 * np.sin(0.2 * u + 0.3 * v + m)).float()


def test_noise_free_images_round_trip_within_a_grey_value(tmp_path):
    integrals = views()
    write_projections(tmp_path / "scan", integrals, Exposure(photons=None))
    measured = opened(tmp_path / "scan")
    assert measured.kind == "intensities" and measured.names[1] == "view_00001"
    step = 0.5 / (50_000 - 100) * integrals.exp()  # half a grey value
    back = measured.whole()
    assert ((back.views - integrals).abs() <= 1.05 * step + 1e-5).all()
    assert back.mask.all() and back.odd["saturated"] == back.odd["floored"] == 0


@pytest.mark.parametrize("flat", [50_000, 30_000, 65_535])
def test_integrals_below_zero_are_read_back_or_refused(flat, tmp_path):
    """Down to those that saturate 16 bits; nothing of a refused scan is left."""
    exposure = Exposure(photons=None, flat=flat)
    least = -math.log((65_535 - 100) / (flat - 100))
    for integral in (0.98 * least, least - 0.02):
        integrals = torch.full((2, 4, 5), integral).double()
        integrals[0, 0, 0] = 1.0
        if integral < least:
            with pytest.raises(Refused, match=r"got -?\d.*lower `flat`"):
                write_projections(tmp_path / "scan", integrals, exposure)
            assert not list(tmp_path.iterdir())
        else:
            write_projections(tmp_path / "kept", integrals, exposure)
            grey = open_projections(tmp_path / "kept").read(0, 2).double()
            found = -((grey - 100) / (flat - 100)).log()
            torch.testing.assert_close(found, integrals.to(found), rtol=0, atol=1e-4)
            shutil.rmtree(tmp_path / "kept")


def test_noise_has_the_variance_of_the_photons(tmp_path):
    photons, integral = 1000.0, 1.0
    write_projections(tmp_path / "scan", torch.full((4, 100, 100), integral), Exposure(photons))
    got = opened(tmp_path / "scan").whole().views.neg().exp().double()
    expected = math.exp(-integral)
    deviation = (expected / photons) ** 0.5
    assert got.mean().item() == pytest.approx(expected, abs=5 * deviation / 200)
    assert got.std().item() == pytest.approx(deviation, rel=0.05)
    assert not torch.equal(got[0], got[1])
    write_projections(tmp_path / "again", torch.full((4, 100, 100), integral), Exposure(photons))
    again = open_projections(tmp_path / "again").read(0, 4)
    assert torch.equal(again, open_projections(tmp_path / "scan").read(0, 4))


def test_simple_itk_reads_the_images_that_are_written(tmp_path):
    write_projections(tmp_path / "scan", views())
    for number, view in enumerate(open_projections(tmp_path / "scan").read(0, 3)):
        image = sitk.ReadImage(str(tmp_path / "scan" / f"view_0000{number}.tif"))
        assert image.GetPixelIDTypeAsString() == "16-bit unsigned integer"
        assert np.array_equal(sitk.GetArrayFromImage(image), view.numpy())


def test_flat_fields_are_numbers_files_or_from_the_folder(scan, tmp_path):
    own = opened(scan).whole().views
    expected = -torch.log((torch.from_numpy(grey().astype("f4")) - 100) / 60_000)
    assert torch.allclose(own, expected, atol=1e-5)
    dark, flat = str(scan / "dark.tif"), str(scan / "flat.tif")
    for options in ({"dark": 100, "flat": 60_100.0}, {"dark": dark, "flat": flat}, {"flat": flat}):
        assert torch.equal(opened(scan, **options).whole().views, own)
    flats = tmp_path / "flats"
    flats.mkdir()
    for k, value in enumerate((60_000, 60_200)):  # their mean is the flat field
        Pillow.fromarray(np.full((6, 8), value, "u2")).save(flats / f"flat_{k}.tif")
    averaged = opened(scan, flat=str(flats)).whole().views
    assert torch.allclose(averaged, own, atol=1e-6)
    Pillow.fromarray(np.full((6, 8), 58_000, "u2")).save(flats / "flat_1.tif")
    with pytest.warns(UserWarning, match="flat field have means of 58000 to 60000"):
        opened(scan, flat=str(flats))
    Pillow.fromarray(np.full((6, 8), 60_200, "u2")).save(flats / "flat_1.tif")
    Pillow.fromarray(np.full((6, 8), 100, "u2")).save(flats / "dark_0.tif")  # of the other field
    assert torch.allclose(opened(scan, flat=str(flats)).whole().views, own, atol=1e-6)
    (flats / "dark_0.tif").unlink()
    with pytest.raises(Refused, match="of the flat field alone, got flat.tif and view_0.tif"):
        opened(scan, flat=str(scan))  # the mean of the views was their flat field
    (scan / "flat.tif").unlink()
    flats.rename(scan / "Flats_before")  # a folder of the views' own
    assert torch.equal(opened(scan).whole().views, averaged)
    Pillow.fromarray(np.full((6, 8), 60_000, "u2")).save(scan / "flat_0.tif")
    with pytest.raises(Refused, match="one folder of flat fields.*, got Flats_before, flat_0.tif"):
        opened(scan).whole()
    (scan / "flat_0.tif").unlink()
    (scan / "flats_after").mkdir()
    with pytest.raises(Refused, match="of flat fields, or images, got Flats_before, flats_after"):
        opened(scan).whole()


def test_views_can_be_skipped_cropped_and_binned(scan):
    options = {"every": 2, "rows": [2, 6], "columns": [1, 7], "binning": [2, 3]}
    part = opened(scan, **options)
    light = opened(scan).whole().views[::2, 2:6, 1:7].neg().exp()
    expected = -light.reshape(6, 2, 2, 2, 3).mean(dim=(2, 4)).log()  # as larger pixels measure
    assert (part.n_views, part.shape) == (6, (2, 2))
    assert torch.allclose(part.whole().views, expected, atol=1e-5)
    assert torch.equal(part.read(2, 4).views, part.whole().views[2:4])


def test_line_integrals_are_binned_by_their_mean(tmp_path):
    np.save(tmp_path / "p.npy", views().numpy())
    part = opened(tmp_path / "p.npy", kind="integrals", binning=2)
    expected = views().reshape(3, 10, 2, 15, 2).mean(dim=(2, 4))
    assert torch.allclose(part.whole().views, expected, atol=1e-6) and part.whole().mask.all()


@pytest.mark.parametrize("kind", ["u2", "f4"])
def test_binned_counts_are_sums_and_remain_poisson_distributed(tmp_path, kind):
    """No count is lost, and the variance of joined pixels is their mean, not a sixth of it."""
    counts = np.random.default_rng(0).poisson(3.0, (4, 60, 90)).astype(kind)
    np.save(tmp_path / "p.npy", counts)
    joined = opened(tmp_path / "p.npy", kind="counts", binning=[2, 3]).whole().views
    assert joined.shape == (4, 30, 30) and joined.double().sum() == counts.sum()
    assert (joined.var() / joined.mean()).item() == pytest.approx(1, abs=4 * (2 / 3600) ** 0.5)


@pytest.mark.parametrize("name", ["circular", "parallel"])
def test_a_binned_pixel_is_centred_on_its_pixels(name):
    parallel = {"depth_mm": 200.0, "detector": RIG["detector"], "n_views": 3, "name": "parallel"}
    cameras = CAMERAS.from_config(RIG if name == "circular" else parallel)
    region = Region(cameras.shape, rows=[1, 9], columns=[3, 12], binning=[2, 3])
    for got, whole in zip(region.seen_by(cameras).rays(), cameras.rays(), strict=True):
        expected = whole[:, 1:9, 3:12].reshape(3, 4, 2, 3, 3, 3).mean(dim=(2, 4))
        assert torch.allclose(got, expected, atol=1e-9)


@pytest.mark.parametrize("binning", [1, 2])
def test_cropped_views_match_cropped_cameras(binning):
    grid, cameras = Grid.centred(size=(12, 10, 8), spacing=9.0), CAMERAS.from_config(RIG)
    x = torch.rand(1, 1, *grid.shape, generator=torch.Generator().manual_seed(0)).double()
    region = Region(cameras.shape, rows=[2, 8], columns=[4, 12], binning=binning)
    whole = PROJECTORS.build("drr", grid=grid, cameras=cameras)(x)[0, 0]
    part = PROJECTORS.build(
        "drr", grid=grid, cameras=region.seen_by(cameras), rays_per_pixel=binning
    )
    got = region.binned(region.cropped(whole))
    assert got.shape == (3, *region.shape) and got.max() > 10
    assert torch.allclose(got, part(x)[0, 0], atol=1e-9)


def test_the_settings_are_the_options(root):
    settings = yaml.safe_load((root / "conf" / "views" / "measured.yaml").read_text())
    assert settings.pop("path") == "???"
    assert settings == {f.name: f.default for f in fields(Measured) if f.name != "path"}


def test_mirrored_images_are_read_unmirrored(scan):
    views = opened(scan, columns=[1, 5]).whole().views
    mirrored = opened(scan, columns=[3, 7], flip_columns=True).whole().views
    assert torch.equal(mirrored, views.flip(-1))


def test_cameras_match_the_selected_views(scan):
    cameras = CAMERAS.from_config(
        {**RIG, "n_views": VIEWS, "detector": {**RIG["detector"], "pixels": [6, 8]}}
    )
    part = opened(scan, every=3, columns=[0, 4])
    got = part.cameras(cameras)
    assert len(got) == part.n_views == 4 and got.shape == part.shape
    assert torch.equal(got.source, cameras.source[::3])
    with pytest.raises(ValueError, match="one camera for each of 12 views .*got 11 cameras"):
        part.cameras(cameras[:11])
    with pytest.raises(ValueError, match=r"the \(6, 8\) pixels.*got \(10, 12\)"):
        part.cameras(CAMERAS.from_config({**RIG, "n_views": VIEWS}))


def test_a_dead_pixel_in_a_ramp_is_interpolated():
    alive = torch.ones(9, 11, dtype=torch.bool)
    alive[4, 5] = alive[2, 2] = False
    v, u = torch.meshgrid(torch.arange(9.0), torch.arange(11.0), indexing="ij")
    slope = (2 * v - 3 * u + 7)[None].repeat(2, 1, 1)
    broken = torch.where(alive, slope, 1e6)
    assert torch.allclose(filled(broken, ~alive), slope, atol=1e-4)
    alive[:, 6] = alive[0:4, 0:4] = False  # a column and a corner
    constant = torch.where(alive, torch.full((1, 9, 11), 3.0), -50.0)
    assert torch.allclose(filled(constant, ~alive), torch.tensor(3.0))


def test_a_polynomial_of_line_integrals_corrects_grey_values_and_stored_integrals(tmp_path):
    """p + 0.05 p^2 of either, before the division by gains; of counts it is refused."""
    integrals = views()
    write_projections(tmp_path / "scan", integrals, Exposure(photons=None))
    np.save(tmp_path / "scan.npy", integrals.numpy())
    expected = integrals + 0.05 * integrals**2
    for path, kind in (("scan", None), ("scan.npy", "integrals")):
        measured = opened(tmp_path / path, kind=kind, linearise=[1.0, 0.05])
        torch.testing.assert_close(measured.whole().views, expected, rtol=0, atol=2e-3)
        halves = measured.divided_by(torch.full((3,), 2.0))
        torch.testing.assert_close(halves.read(0, 3).views, expected / 2, rtol=0, atol=1e-3)
    raw = opened(tmp_path / "scan.npy", kind="integrals", linearise="fit")
    assert torch.equal(raw.whole().views, integrals)  # an app fits it to these
    assert torch.equal(raw.linearised([1.0, 0.05]).whole().views, measured.whole().views)
    with pytest.raises(Refused, match="views.linearise, got counts"):
        opened(tmp_path / "scan.npy", kind="counts", linearise=[1.0])
