"""Iterative reconstruction and training take every registered projector: ours, a
plugin's, and other libraries' where they are installed.
"""

from typing import Any

import pytest
import torch
from torch.nn.functional import grid_sample

from mvrecon.core.parts import PROJECTORS, required
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Box, Grid
from mvrecon.methods.classical.mlem import mlem
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.methods.classical.sirt import sirt
from mvrecon.methods.method import build_method
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.operators.selection import ray_subset, view_subset
from mvrecon.testing.measures import gap

peers = pytest.importorskip("mvrecon_peers.base")

GRID = Grid.centred(size=(13, 11, 9), spacing=2.0)
SQUARE = {"pixels": [9, 12], "pixel_mm": 4.0}
#: One of them each projector takes: a cone, parallel beams in slices, pinholes.
RIGS = {
    "cone": circular(4, 60.0, 90.0, SQUARE, start_degrees=13.0),
    "stack": parallel(4, {"pixels": [9, 15], "pixel_mm": 2.0}, 60.0, start_degrees=11.0),
    "pinholes": dome(4, 60.0, 40.0, 120.0, SQUARE | {"pixel_mm": 2.0}),
}
#: mbirtorch's own default compiles for minutes.
OPTIONS = {"mbirtorch": {"compile_mode": "off"}}


class Pair(peers.Paired):
    """A peer without autograd, as an adapter of a library has it: always there to be tested."""

    def __init__(self, grid: Grid, cameras: Any):
        super().__init__(grid, cameras)
        self.A = RayTransform(self.box, self.rig)

    def project(self, volume):
        return self.A(volume[None, None])[0, 0].detach()

    def backproject(self, views):
        return self.A.T(views[None, None])[0, 0].detach()


class Graph(peers.Traced):
    """A peer in torch, samples along each ray, whose adjoint is autograd's."""

    def render(self, volume, first, last):
        way, share = last - first, (torch.arange(40.0) + 0.5) / 40
        half = torch.tensor(self.box.shape[::-1]) * torch.tensor(self.box.spacing) / 2
        points = (first[..., None, :] + share[:, None] * way[..., None, :]) / half
        samples = grid_sample(volume[None, None], points[None].to(volume), align_corners=False)
        return samples[0, 0].mean(dim=-1) * way.norm(dim=-1)


STAND_INS = {"a pair of calls": Pair, "a graph": Graph}
NAMES = [name for name in PROJECTORS.names() if not required("projector", name)] + [*STAND_INS]


@pytest.fixture(scope="module", params=NAMES)
def A(request) -> Any:
    """The projector, with the first rig that it takes."""
    refusals = []
    for rig in RIGS.values():
        try:
            if request.param in STAND_INS:
                return STAND_INS[request.param](GRID, rig)
            options = OPTIONS.get(request.param, {})
            return PROJECTORS.build(request.param, grid=GRID, cameras=rig, **options)
        except ImportError as error:
            pytest.skip(f"{request.param}: {error}")
        except ValueError as error:
            refusals.append(str(error))
    pytest.fail(f"{request.param} takes none of the rigs: {refusals}")


@pytest.fixture(scope="module")
def volume() -> torch.Tensor:
    """A block in a background, as counts or attenuation."""
    x = torch.full((1, 1, *GRID.shape), 0.2)
    x[..., 2:6, 3:7, 2:7] = 1.0
    return x


def test_sirt_lowers_the_residual(A, volume):
    views = A(volume)
    residuals = [(views - A(sirt(A, views, n))).norm() for n in (1, 3, 10)]
    assert residuals[0] > residuals[1] > residuals[2]


def test_mlem_raises_the_likelihood_and_keeps_the_counts(A, volume):
    counts = 100 * A(volume)
    likelihood = PoissonLikelihood(A, counts)
    values = [float(likelihood(x := mlem(A, counts, n))) for n in (0, 1, 5)]
    assert values[0] > values[1] > values[2]
    if getattr(A, "matched", True):
        kept = (likelihood.sensitivity(x.dtype) * x).sum()
        assert float(kept) == pytest.approx(float(counts.sum()), rel=1e-4)


def test_osem_converges_faster_than_mlem(A, volume):
    counts = 100 * A(volume)
    likelihood = PoissonLikelihood(A, counts)
    assert likelihood(mlem(A, counts, 2, subsets=4)) < likelihood(mlem(A, counts, 2))


def test_a_method_is_trained_with_it(A, volume):
    torch.manual_seed(0)
    method = build_method({"name": "cross_view"})
    optimiser = torch.optim.Adam(method.parameters(), lr=1e-3)
    before = [weight.detach().clone() for weight in method.parameters()]
    loss = (method(A(volume), A).volume - volume).square().mean()
    loss.backward()
    gradients = [weight.grad for weight in method.parameters() if weight.grad is not None]
    assert loss > 0 and gradients and all(g.isfinite().all() for g in gradients)
    optimiser.step()
    assert any(not torch.equal(*pair) for pair in zip(method.parameters(), before, strict=True))


def test_subsets_match_the_full_operator(A):
    rng = torch.Generator().manual_seed(0)
    x = torch.rand(2, 1, *A.domain_shape, generator=rng)
    whole = A(x)
    y = torch.rand(whole.shape, generator=rng)
    rays = torch.rand(A.range_shape, generator=rng) < 0.3
    support = torch.rand(A.domain_shape, generator=rng) < 0.5
    order, box = [2, 0], Box((1, 2, 1), (6, 8, 7))
    views = torch.zeros(A.range_shape).index_fill(0, torch.tensor(order), 1)
    inside = torch.zeros(A.domain_shape)
    inside[box.slices] = 1
    crop = (..., *box.slices)
    # of each part: the operator, what it acts on, what it ought to give
    acts = {
        "views": (view_subset(A, order), x, whole[:, :, order]),
        "views, adjoint": (view_subset(A, order).T, y[:, :, order], A.T(y * views)),
        "rays": (ray_subset(A, rays), x, whole[..., rays]),
        "rays, adjoint": (ray_subset(A, rays).T, y[..., rays], A.T(y * rays)),
        "crop": (A.cropped(box), x[crop], A(x * inside)),
        "crop, adjoint": (A.cropped(box).T, y, A.T(y)[crop]),
        "support": (A.with_support(support), x, A(x * support)),
        "support, adjoint": (A.with_support(support).T, y, A.T(y) * support),
    }
    gaps = {name: gap(part(tensor), expected) for name, (part, tensor, expected) in acts.items()}
    assert max(gaps.values()) < 1e-5, gaps
