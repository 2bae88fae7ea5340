"""Pixels of several rays, and rays given one by one."""

from dataclasses import replace

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.testing import adjoint_gap, gap, gradient_gap
from tests.operators.cases import CASES, DIFFERENTIABLE, GRID, METHODS, OPTIONS, Case, curved, noise

FLAT = {kind: case for kind, case in CASES.items() if isinstance(case.rays, Cameras)}


@pytest.mark.pairwise(kind=FLAT, factor=[2, 3])
def test_binning_reverts_refined_pixels(kind, factor):
    rig = FLAT[kind].rays
    fine = rig.refined(factor)
    assert (
        fine.shape == (factor * rig.shape[0], factor * rig.shape[1]) and fine.extent == rig.extent
    )
    for name in ("source", "origin", "u", "v"):
        assert torch.allclose(
            getattr(fine.binned(factor), name), getattr(rig, name), rtol=1e-14, atol=1e-13
        )
    # the rays of a pixel's parts are spread evenly about its own
    for points, parts in zip(rig.rays(), fine.rays(), strict=True):
        blocks = parts.unflatten(1, (-1, factor)).unflatten(3, (-1, factor))
        assert torch.allclose(blocks.mean(dim=(2, 4)), points, rtol=0, atol=1e-10)
    with pytest.raises(ValueError, match="positive number of rays each way, got 0"):
        rig.refined(0)


@pytest.mark.pairwise(
    backend=["cpu", "reference"], kind=["cone", "stack", "dome", "inside"], option=OPTIONS
)
def test_a_pixel_is_the_mean_of_its_rays(kind, option, backend):
    case = CASES[kind]
    x, y = noise(case, channels=2)
    A = case.build(rays_per_pixel=3, backend=backend, **OPTIONS[option])
    fine = replace(case, rays=case.rays.refined(3)).build(backend=backend, **OPTIONS[option])
    mean = fine(x).unflatten(4, (-1, 3)).unflatten(3, (-1, 3))
    assert gap(A(x), mean.mean(dim=(4, 6))) < 1e-13
    assert adjoint_gap(A, x, y) < 1e-12


def test_the_mean_over_a_pixel_is_differentiable_in_the_pose():
    case = DIFFERENTIABLE["cone"]
    x = torch.rand(1, 1, *case.grid.shape, dtype=torch.float64)
    vectors = [vector.clone().requires_grad_() for vector in case.vectors.values()]
    assert gradient_gap(lambda *v: case.moved(*v).build(rays_per_pixel=2)(x), *vectors) < 1e-6


@pytest.mark.pairwise(
    1, kind=[kind for kind, case in FLAT.items() if case.rays.extent == "segment"], option=OPTIONS
)
def test_explicit_rays_match_the_flat_detector(kind, option):
    case = FLAT[kind]
    x, y = noise(case)
    flat = case.build(**OPTIONS[option])
    each = replace(case, rays=ExplicitRays(*(points.clone() for points in case.rays.rays()))).build(
        **OPTIONS[option]
    )
    # an axial ray runs on the cells' faces, where one rounding error decides between two of them
    if (kind, option) != ("axial", "siddon"):
        assert gap(each(x), flat(x)) < 1e-12 and gap(each.T(y), flat.T(y)) < 1e-12


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_curved_detector_measures_the_chords_of_a_box(backend):
    sizes = zip(GRID.shape[::-1], GRID.spacing, strict=True)
    half = torch.tensor([[n * mm / 2 for n, mm in sizes]], dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)[None]
    box = Phantom((Solids("box", GRID.centre[None], eye, half, torch.ones(1)),))
    rays = curved(columns=14, rows=9, n_views=5)
    chords = box.integrals(rays.source, rays.target)
    A = PROJECTORS.build("drr", grid=GRID, cameras=rays, method="siddon", backend=backend)
    assert chords.max() > 6 and (chords == 0).any()
    assert torch.allclose(
        A(torch.ones(1, 1, *GRID.shape, dtype=torch.float64))[0, 0], chords, rtol=0, atol=1e-11
    )


def test_a_ray_and_its_reverse_have_the_same_integral():
    case = CASES["explicit"]
    x, _ = noise(case)
    back = replace(case, rays=ExplicitRays(case.rays.target, case.rays.source))
    for method in METHODS:
        assert gap(back.build(method=method)(x), case.build(method=method)(x)) < 1e-12


def points(*shape: int, value: float = 0.0) -> torch.Tensor:
    return torch.full(shape, value, dtype=torch.float64)


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        (points(2, 3), points(1, 2, 3, 3), r"source as \[m v u 3\], got \[2, 3\]"),
        (points(1, 2, 3, 3), points(1, 2, 3, 2), r"target as \[m v u 3\], got \[1, 2, 3, 2\]"),
        (points(0, 2, 3, 3), points(0, 2, 3, 3), r"source as \[m v u 3\], got \[0, 2, 3, 3\]"),
        (points(1, 2, 3, 3), points(1, 2, 3, 3, value=torch.nan), "finite mm, but target holds"),
        (points(1, 2, 3, 3, value=torch.inf), points(1, 2, 3, 3), "finite mm, but source holds"),
        (
            points(1, 2, 3, 3),
            points(1, 1, 3, 3, value=1),
            r"one shape .* got .*1, 2, 3, 3.*1, 1, 3, 3",
        ),
        (points(1, 2, 3, 3), points(1, 2, 3, 3), "6 have no length"),
    ],
)
def test_invalid_rays_are_refused(source, target, message):
    with pytest.raises(ValueError, match=message):
        ExplicitRays(source, target)


@pytest.mark.parametrize(
    ("rays", "options", "message"),
    [
        (None, {"method": "joseph:5"}, "Samples go with method 'trilinear', got 'joseph:5'"),
        (
            None,
            {"method": "trilinear:0"},
            "positive number of samples, as in 'trilinear:300', got 'trilinear:0'",
        ),
        (None, {"rays_per_pixel": 0}, "positive number of rays each way, got 0"),
        (curved(), {"rays_per_pixel": 2}, "one per pixel, got rays_per_pixel=2"),
        (None, {"backend": "gpu"}, "Unknown backend 'gpu'. Known: auto, cpu, cuda, reference"),
    ],
)
def test_invalid_options_are_refused(rays, options, message):
    case = Case(Grid.centred(size=(7, 6, 5), spacing=1.0), rays or CASES["dome"].rays)
    with pytest.raises(ValueError, match=message):
        case.build(**options)


def test_a_back_end_refuses_tensors_of_another_memory():
    A = CASES["dome"].build(backend="cuda")
    with pytest.raises(ValueError, match="'cuda' needs tensors in a GPU's memory, got cpu"):
        A(torch.zeros(1, 1, *GRID.shape))
    with pytest.raises(ValueError, match="'cuda' needs tensors in a GPU's memory, got cpu"):
        A.T(torch.zeros(1, 1, len(A.lines), *CASES["dome"].rays.shape))


def test_parallel_beams_are_refused_as_explicit_rays():
    with pytest.raises(ValueError, match="parallel rig"):
        PROJECTORS.build("radon", grid=GRID, cameras=curved())


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_ray_nearly_along_a_face_crosses_it_at_the_exact_position(backend):
    """In float32, too: a place in it is rounded to 4e-6 voxels, 60 times as much along a ray of
    slope 1/60.
    """
    grid, height = (
        Grid.centred(size=(96, 96, 4), spacing=1.0),
        torch.linspace(-0.5, 0.5, 41, dtype=torch.float64)[None, None],
    )
    start = torch.stack(
        [torch.full_like(height, -70), 31 + height - 70 / 60, torch.zeros_like(height) + 0.3],
        dim=-1,
    )
    end = start + start.new_tensor([140, 140 / 60, 0])
    volume = torch.zeros(1, 1, *grid.shape)
    volume[..., 79:, :] = 1  # y > 31
    A = PROJECTORS.build(
        "drr", grid=grid, cameras=ExplicitRays(start, end), method="siddon", backend=backend
    )
    expected = (48 + 60 * height[0]) * (1 + 1 / 60**2) ** 0.5
    assert (A(volume)[0, 0].double() - expected).abs().max() <= 1e-6 * expected.max()


def test_explicit_rays_keep_their_end_points():
    start, end = torch.zeros(2, 1, 3, 2, 3, dtype=torch.float64)
    end += 1
    rays = ExplicitRays(start.numpy(), end)
    start += 7
    end += 7
    assert not rays.source.any() and torch.equal(rays.target, torch.ones_like(rays.target))
