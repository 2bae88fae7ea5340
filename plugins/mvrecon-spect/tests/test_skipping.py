"""`spect` skips what `drr` skips: zero bins, half of a mirrored rig, voxels outside a support."""

import pytest
import torch

from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.mlem import mlem
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.methods.classical.sirt import sirt_weights
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.operators.selection import RaySelection
from mvrecon_spect.operators.projector import Spect

GRID = Grid.centred(size=(8, 12, 10), spacing=12.0)


@pytest.fixture(scope="module")
def A() -> Spect:
    return Spect(GRID, dcspect80(pixels=[20, 18]), method="joseph")


@pytest.fixture
def counts(A) -> torch.Tensor:
    """Few: nearly all bins are zero."""
    views = A(torch.ones(1, 1, *GRID.shape))
    rng = torch.Generator().manual_seed(0)
    return torch.poisson(views * (0.05 / views.mean()), generator=rng)


@pytest.fixture
def n_rays(monkeypatch) -> list[int]:
    """How many rays each forward projection computes."""
    numbers, project = [], RayTransform.project_along

    def counted(self, volume, lines, detector):
        numbers.append(len(lines) * detector[0] * detector[1])
        return project(self, volume, lines, detector)

    monkeypatch.setattr(RayTransform, "project_along", counted)
    return numbers


def test_only_rays_of_nonzero_bins_are_computed(A, counts, n_rays):
    likelihood = PoissonLikelihood(A, counts)
    assert likelihood.why.startswith("bins with counts: ")
    likelihood.expected(torch.ones(1, 1, *GRID.shape))
    assert n_rays == [int((counts > 0).sum())]


@pytest.mark.parametrize("subsets", [1, 4])
def test_skipping_zero_bins_does_not_change_the_image(A, counts, subsets):
    counts = counts.double()
    images = [mlem(A, counts, 2, 0.1, subsets=subsets, skip_zero_bins=skip) for skip in (0, 1)]
    torch.testing.assert_close(images[0], images[1], rtol=1e-9, atol=0)


def test_a_list_of_rays_has_the_weights_of_its_pixels(A):
    chosen = torch.rand(A.range_shape, generator=torch.Generator().manual_seed(1)) < 0.1
    x = torch.rand(1, 1, *GRID.shape)
    part = A.subset(RaySelection(A.range_shape, chosen))
    torch.testing.assert_close(part(x), A(x)[..., chosen], rtol=1e-5, atol=0)


def test_sirt_weights_use_half_of_a_symmetric_rig(A, n_rays):
    R, C = sirt_weights(A, torch.float64)
    assert n_rays == [40 * 20 * 18]
    ones = torch.ones(1, 1, *GRID.shape, dtype=torch.float64)
    rows = A(ones)
    columns = A.T(torch.ones_like(rows))
    torch.testing.assert_close(R * rows, (R > 0).double(), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(C * columns, (C > 0).double(), rtol=1e-9, atol=1e-9)


def test_a_support_restricts_the_projector(A):
    support = torch.zeros(GRID.shape, dtype=torch.bool)
    support[2:5] = True
    x = torch.rand(1, 1, *GRID.shape)
    assert {"subset", "crop", "support"} <= A.capabilities
    torch.testing.assert_close(A.with_support(support)(x), A(x * support))


def test_zero_voxels_are_skipped_with_the_same_result():
    mu = torch.full(GRID.shape, 0.01, dtype=torch.float64)
    B = Spect(GRID, dcspect80(pixels=[40, 36], rows=[0], columns=[0, 7]), mu=mu, blur=True)
    x = torch.rand(1, 2, *GRID.shape, dtype=torch.float64)
    x[:, 0] = 0
    assert not B(x[:, :1]).any()
    x[0, 0, 3:6, 5:7, 5:7] = 1
    alone = B(x[:, :1])
    assert 0 < (alone != 0).double().mean() < 0.9
    torch.testing.assert_close(alone, B(x)[:, :1], rtol=0, atol=0)
    each = torch.func.vmap(B)(x[None])[0]
    torch.testing.assert_close(each, B(x), rtol=1e-12, atol=1e-15)
