"""The likelihood of counts is that of all bins, whichever are computed, and MLEM raises it."""

from dataclasses import replace

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.rigs import circular, dome
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical import mlem as steps
from mvrecon.methods.classical.mlem import mlem
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.operators.drr import Drr
from mvrecon.operators.selection import RaySelection, ViewSelection
from mvrecon.testing import gap, gradient_gap

GRID = Grid.centred(size=(10, 8, 9), spacing=2.0)
#: Detector columns that stand upright over the volume, and pinholes from above.
RIGS = {
    "circular": circular(6, 60.0, 100.0, {"pixels": [12, 11], "pixel_mm": 2.7}, start_degrees=5.0),
    "dome": dome(6, 40.0, 25.0, 120.0, {"pixels": [10, 11], "pixel_mm": 1.3}),
}
TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-6}


def operator(kind: str, **options):
    return PROJECTORS.build("drr", grid=GRID, cameras=RIGS[kind], **options)


def measured(A, level: float, dtype: torch.dtype = torch.float64, batch: int = 1) -> torch.Tensor:
    """Counts of two hot boxes; a level of 0.05 leaves nine bins of ten empty."""
    truth = torch.zeros(batch, 1, *GRID.shape, dtype=dtype)
    truth[..., 2:7, 2:6, 2:7] = level
    truth[:1, :, 6:8, 5:7, 1:3] = 2 * level
    return torch.poisson(A(truth), generator=torch.Generator().manual_seed(2))


def naive(A, counts, x, background=0.0):
    """All of it by torch, from whole views."""
    expected = A(x) + background
    logs = torch.where(counts > 0, counts * torch.where(counts > 0, expected, 1).log(), 0)
    return (expected - logs).flatten(1).sum(dim=1)


@pytest.mark.pairwise(kind=RIGS, background=["none", "number", "views"], skip=[True, False])
def test_value_and_gradient_equal_those_over_all_bins(kind, background, skip):
    A = operator(kind)
    counts = measured(A, 0.05, batch=2)
    added = {"none": 0.0, "number": 0.07, "views": torch.rand_like(counts[:1])}[background]
    L = PoissonLikelihood(A, counts, added, skip_zero_bins=skip)
    assert isinstance(L.bins.selection, RaySelection if skip else ViewSelection)
    x = (0.01 + torch.rand(2, 1, *GRID.shape, dtype=torch.float64)).requires_grad_()
    expected, value = naive(A, counts, x, added), L(x)
    assert value.shape == (2,) and ((value - expected) / expected).abs().max() < 1e-12
    (exact,) = torch.autograd.grad(expected.sum(), x)
    (slope,) = torch.autograd.grad(value.sum(), x)
    assert gap(slope, exact) < 1e-10 and gap(L.gradient(x), exact) < 1e-10


@pytest.mark.parametrize("moving", ["source", "origin"])
def test_derivatives_equal_finite_differences(moving):
    grid = Grid.centred(size=(3, 4, 3), spacing=(6.0, 6.6, 5.1))
    rig = dome(2, 40.0, 25.0, 120.0, {"pixels": [5, 6], "pixel_mm": 2.1, "offset_mm": [0.3, -0.2]})
    counts = torch.zeros(1, 1, 2, 5, 6, dtype=torch.float64)
    counts[..., 2:4, 2:4] = torch.tensor([[3.0, 1.0], [0.0, 2.0]], dtype=torch.float64)

    def likelihood(x, vector):
        A = PROJECTORS.build("drr", grid=grid, cameras=replace(rig, **{moving: vector}))
        return PoissonLikelihood(A, counts)(x)

    x = 0.2 + torch.rand(
        1, 1, *grid.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    vector = getattr(rig, moving).clone().requires_grad_()
    assert gradient_gap(likelihood, x.requires_grad_(), vector) < 1e-6


@pytest.mark.pairwise(kind=RIGS, dtype=TOLERANCE, subsets=[1, 3])
def test_skipping_empty_bins_changes_nothing(kind, dtype, subsets):
    A = operator(kind)
    counts = measured(A, 0.05, dtype, batch=2)
    assert 0.8 < (counts == 0).double().mean() < 0.95
    for background in (0.0, 0.01):
        with_all, without = (
            mlem(A, counts, 4, background, subsets=subsets, skip_zero_bins=skip)
            for skip in (False, True)
        )
        assert without.dtype == dtype and without.max() > 0.01
        # every step, of four or of four for each subset, hands its rounding on to the next
        assert gap(without, with_all) < TOLERANCE[dtype] * subsets
        # subsets may have left bins with counts that no voxel explains
        x = with_all + (1e-3 if subsets > 1 else 0)
        one, other = (
            PoissonLikelihood(A, counts, background, skip_zero_bins=skip)(x)
            for skip in (False, True)
        )
        assert ((one - other) / one).abs().max() < TOLERANCE[dtype]


@pytest.mark.parametrize("background", [0.0, 0.05])
@pytest.mark.parametrize("kind", RIGS)
def test_every_iteration_raises_the_likelihood(kind, background):
    A = operator(kind)
    counts = measured(A, 0.05)
    L = PoissonLikelihood(A, counts, background)
    values = [L(mlem(A, counts, n, background)).item() for n in range(6)]
    assert all(later < earlier for earlier, later in zip(values, values[1:], strict=False))
    assert L(mlem(A, counts, 2, background, subsets=2)) < values[2]


@pytest.mark.parametrize("kind", RIGS)
def test_counts_are_conserved(kind):
    A = operator(kind)
    counts = measured(A, 0.05, batch=2)
    s = PoissonLikelihood(A, counts).sensitivity(torch.float64)
    start = 0.1 + torch.rand(2, 1, *GRID.shape, dtype=torch.float64)
    for x in (
        mlem(A, counts, 0),
        mlem(A, counts, 1),
        mlem(A, counts, 1, start=start),
        mlem(A, counts, 3),
    ):
        assert (
            (s * x).sum(dim=(1, 2, 3, 4)) / counts.sum(dim=(1, 2, 3, 4)) - 1
        ).abs().max() < 1e-12


def test_no_voxel_becomes_subnormal(monkeypatch):
    """Values below 1e-38, which slow processors down, become zero without affecting other
    voxels.
    """
    A = operator("dome")
    counts = measured(A, 0.05, torch.float32, batch=2)
    volumes = []
    for part in (steps.MIN_ACTIVITY, 0.0):
        monkeypatch.setattr(steps, "MIN_ACTIVITY", part)
        x = mlem(A, counts, 300)
        fewer = (x > 0) & (x < torch.finfo(x.dtype).tiny)
        assert bool(fewer.any()) == (part == 0)
        volumes.append(x)
    assert gap(*volumes) < 1e-4


@pytest.mark.parametrize("kind", RIGS)
def test_voxels_without_counts_are_zero_after_one_iteration(kind):
    A = operator(kind)
    counts = measured(A, 0.01)
    nothing = A.T(counts) == 0
    assert 0.05 < nothing.double().mean() < 0.95
    assert torch.equal(mlem(A, counts, 1) == 0, nothing) and torch.equal(
        mlem(A, counts, 5) == 0, nothing
    )
    start = torch.ones(1, 1, *GRID.shape, dtype=torch.float64)
    start[..., 4, 3, :4] = 0
    assert not mlem(A, counts, 2, 0.1, start=start)[start == 0].any()


def test_voxels_without_rays_are_zero_without_division_by_zero():
    wide = Grid.centred(size=(40, 8, 9), spacing=4.0)
    A = PROJECTORS.build("drr", grid=wide, cameras=RIGS["circular"])
    truth = torch.zeros(1, 1, *wide.shape)
    truth[..., 4, 4, 20] = 1
    unseen = A.T(torch.ones_like(A(truth))) == 0
    for subsets in (1, 6):
        x = mlem(A, A(truth), 3, start=torch.ones_like(truth), subsets=subsets)
        assert unseen.any() and not x[unseen].any() and x.isfinite().all() and x.any()
    assert not mlem(A, torch.zeros_like(A(truth)), 1).any()


def test_the_truth_is_a_fixed_point():
    A = operator("dome")
    truth = torch.rand(1, 1, *GRID.shape, dtype=torch.float64)
    for subsets in (1, 3):
        x = mlem(A, A(truth) + 0.3, 3, 0.3, start=truth, subsets=subsets)
        sensitive = PoissonLikelihood(A, A(truth)).sensitivity(torch.float64) > 0
        assert torch.allclose(x[sensitive], truth[sensitive], rtol=1e-12, atol=0)
        assert PoissonLikelihood(A, A(truth) + 0.3, 0.3).gradient(truth).abs().max() < 1e-12


def test_subsets_of_the_views_share_the_likelihood():
    A = operator("dome")
    counts, x = measured(A, 0.05), torch.rand(1, 1, *GRID.shape, dtype=torch.float64)
    added = torch.rand_like(counts)
    parts = [PoissonLikelihood(A, counts, added, views) for views in ([0, 4], [1, 2, 5], [3])]
    whole = PoissonLikelihood(A, counts, added)
    assert (sum(L(x) for L in parts) - whole(x)).abs() < 1e-12 * whole(x).abs()
    assert gap(torch.stack([L.gradient(x) for L in parts]).sum(dim=0), whole.gradient(x)) < 1e-12


@pytest.mark.parametrize("kind", RIGS)
def test_the_used_bins_are_reported_with_the_reason(kind):
    A = operator(kind)
    few, many = PoissonLikelihood(A, measured(A, 0.05)), PoissonLikelihood(A, measured(A, 30.0))
    assert (
        few.why.startswith("bins with counts: ")
        and "20%" in few.why
        and isinstance(few.bins.selection, RaySelection)
    )
    assert (
        many.why.startswith("all bins: ")
        and "20%" in many.why
        and isinstance(many.bins.selection, ViewSelection)
    )
    assert "asked for" in PoissonLikelihood(A, measured(A, 0.05), skip_zero_bins=False).why


def test_a_custom_projector_uses_its_own_forward_in_the_likelihood():
    class Sensitive(Drr):
        def forward(self, volume):
            return 0.25 * super().forward(volume)

        def adjoint(self, views):
            return super().adjoint(0.25 * views)

    A = Sensitive(GRID, RIGS["dome"])
    counts, x = measured(A, 0.05), 0.1 + torch.rand(1, 1, *GRID.shape, dtype=torch.float64)
    L = PoissonLikelihood(A, counts)
    assert "Sensitive" in L.why and (L(x) - naive(A, counts, x)).abs() < 1e-12 * L(x).abs()


def counted(value: float = 1.0) -> torch.Tensor:
    return torch.full((1, 1, 6, 10, 11), value)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (
            lambda A: PoissonLikelihood(A, counted(-1.0)),
            "counts that are finite and not negative, got 660 bins",
        ),
        (
            lambda A: PoissonLikelihood(A, counted(torch.nan)),
            "counts that are finite and not negative, got 660 bins",
        ),
        (
            lambda A: PoissonLikelihood(A, counted(), -0.1),
            "background that are finite .* got 660 bins",
        ),
        (
            lambda A: PoissonLikelihood(A, counted(), torch.inf),
            "background that are finite .* got 660 bins",
        ),
        (
            lambda A: PoissonLikelihood(A, counted(), torch.ones(5)),
            r"broadcast to \(1, 1, 6, 10, 11\), got \(5,\)",
        ),
        (
            lambda A: PoissonLikelihood(A, counted()[:, :, 1:]),
            r"counts .*\(6, 10, 11\), got \(1, 1, 5, 10, 11\)",
        ),
        (
            lambda A: PoissonLikelihood(A, counted(), views=[6]),
            r"different views from 0 to 5, got \[6\]",
        ),
        (
            lambda A: PoissonLikelihood(A, counted())(torch.ones(2, 1, *GRID.shape)),
            r"\[b c\] \(1, 1\), got \(2, 1",
        ),
        (
            lambda A: PoissonLikelihood(A, counted())(torch.ones(1, 1, 9, 8, 9)),
            r"volume .*\(9, 8, 10\), got",
        ),
        (
            lambda A: PoissonLikelihood(A, counted())(torch.zeros(1, 1, *GRID.shape)),
            "660 bins hold counts where .* allow none: .* background > 0, a grid or support",
        ),
        (
            lambda A: mlem(A, counted(), 1, start=torch.zeros(1, 1, *GRID.shape)),
            "660 bins hold counts",
        ),
        (
            lambda A: mlem(A, counted(), 1, 1.0, start=-torch.ones(1, 1, *GRID.shape)),
            "non-negative start",
        ),
        (lambda A: mlem(A, counted(), 1, 1.0, subsets=7), "1 to 6 subsets .* got 7"),
    ],
)
def test_inconsistent_input_is_refused(act, message):
    with pytest.raises(ValueError, match=message):
        act(operator("dome"))


def test_integer_counts_are_supported():
    A = operator("dome")
    counts = measured(A, 0.05, torch.float32)
    assert torch.equal(mlem(A, counts.long(), 2), mlem(A, counts, 2))
