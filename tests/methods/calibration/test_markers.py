"""A rig is recovered from images of known markers."""

import pytest
import torch

from mvrecon.geometry.cameras.random_rigs import perturbed
from mvrecon.geometry.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import pixel_centres
from mvrecon.methods.calibration.markers import centroids, dlt, from_markers, helix
from tests.geometry.cameras.rigs import same

SHAPE, PIXEL = (96, 128), (1.5, 1.0)
IDEAL = circular(4, 400.0, 600.0, {"pixels": SHAPE, "pixel_mm": PIXEL})
MARKERS = helix(20, 30.0, 60.0, 1.7)


@pytest.fixture(scope="module")
def rig():
    return perturbed(IDEAL, offset_px=3.0, tilt_degrees=2.0, source_mm=5.0, seed=1)


def images(rig):
    return rig.project(MARKERS)[..., :2]


def test_matrices_are_recovered_from_exact_images(rig):
    P = dlt(MARKERS, images(rig))
    expected = rig.matrix * (rig.distance[:, None, None])
    assert torch.allclose(P, expected, rtol=1e-7, atol=1e-7 * expected.abs().max())


def test_a_rig_is_recovered_from_exact_images_even_if_some_are_hidden(rig):
    uv = images(rig)
    uv[0, :7], uv[2, 4:9] = torch.nan, torch.nan
    fit = from_markers(MARKERS, uv, SHAPE, PIXEL)
    assert fit.rms_px.max() < 1e-8
    assert same(fit.cameras, rig, 1e-6)


def test_images_a_tenth_of_a_pixel_off_give_rays_a_tenth_of_a_pixel_off(rig):
    rng = torch.Generator().manual_seed(0)
    noise = 0.1 * torch.randn(images(rig).shape, generator=rng, dtype=torch.float64)
    fit = from_markers(MARKERS, images(rig) + noise, SHAPE, PIXEL)
    error = (fit.cameras.project(MARKERS)[..., :2] - images(rig)).norm(dim=-1)
    assert error.square().mean().sqrt() < 0.1
    expected_rms = (noise.square().sum(dim=(1, 2)) / 20).sqrt()
    assert (fit.rms_px < expected_rms).all()  # a least-squares fit is nearer than the truth


def test_markers_that_do_not_determine_a_rig_are_refused(rig):
    """A rig is not calibrated from fewer than six markers, from markers in a plane, or from views
    upside down.
    """
    uv = images(rig)
    few = uv.clone()
    few[1, 5:] = torch.nan
    with pytest.raises(ValueError, match="at least 6 markers in view 1, got 5"):
        from_markers(MARKERS, few, SHAPE, PIXEL)
    flat = MARKERS * torch.tensor([1.0, 1.0, 0.0])
    with pytest.raises(ValueError, match="not coplanar"):
        from_markers(flat, rig.project(flat)[..., :2], SHAPE, PIXEL)
    upside = torch.stack([uv[..., 0], SHAPE[0] - 1 - uv[..., 1]], dim=-1)
    with pytest.raises(ValueError, match="mirrored; reverse the rows"):
        from_markers(MARKERS, upside, SHAPE, PIXEL)


def test_a_blob_is_located_at_its_centroid():
    """Gaussian blobs on a linear background with initial guesses two pixels off; noise, edges and
    neighbours have no effect or result in NaN.
    """
    places = torch.tensor([[20.3, 15.8], [45.7, 30.2], [2.0, 20.0], [60.0, 20.0], [63.0, 22.0]])
    pixels = pixel_centres((48, 80))
    view = 0.02 * pixels[..., 0]
    for place in places[:2].double():
        view = view + 3 * torch.exp(-(pixels - place).square().sum(-1) / (2 * 1.3**2))
    guesses = (places + torch.tensor([1.4, -1.2]))[None]
    got = centroids(view[None], guesses.double(), radius_px=6.0)[0]
    assert torch.allclose(got[:2], places[:2].double(), atol=0.03)
    assert got[2:].isnan().all()
    nothing = centroids(torch.randn(1, 48, 80, generator=torch.Generator().manual_seed(0)), guesses)
    assert nothing[0, :2].isnan().all()


@pytest.mark.parametrize("radius", [5.0, 6.0, 6.5, 10.0])
def test_rounding_does_not_decide_which_pixels_are_a_blobs(radius):
    """In the middle of a pixel, or of two."""
    pixels = pixel_centres((41, 41))
    for u in (20.0, 20.5):
        guess = torch.tensor([[[u, 20.0]]], dtype=torch.float64)
        found = []
        for nudge in (0.0, 1e-13, -1e-13, 1e-11):
            away = (pixels - guess[0] - nudge).norm(dim=-1)
            found.append(centroids(torch.sigmoid((3 - away) / 0.3)[None], guess, radius)[0, 0])
        assert (torch.stack(found) - found[0]).abs().max() < 1e-8


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_markers_in_parallel_beams_are_refused(noise):
    """A source far away is none of them: 10 m for markers of 60 mm."""
    rig = parallel(3, {"pixels": list(SHAPE), "pixel_mm": 1.0}, start_degrees=10.0)
    rng = torch.Generator().manual_seed(0)
    images = rig.project(MARKERS)[..., :2]
    images = images + noise * torch.randn(images.shape, generator=rng)
    with pytest.raises(ValueError, match="parallel beams"):
        from_markers(MARKERS, images, SHAPE, (1.0, 1.0))
    far = circular(3, 1e4, 1.2e4, {"pixels": list(SHAPE), "pixel_mm": 1.0})
    fit = from_markers(MARKERS, far.project(MARKERS)[..., :2], SHAPE, (1.0, 1.0))
    assert fit.rms_px.max() < 1e-4
