"""Extreme counts and line integrals: Poisson likelihood, MLEM, SIRT, noise, high attenuation,
logarithms of zero intensity, empty rays and voxels.

mvrecon processes line integrals p, not transmissions exp(-p), and computes no logarithms of
measured intensities; the cases test values that such logarithms, computed elsewhere, may leave in
the views.
"""

from collections.abc import Iterator
from functools import partial
from itertools import pairwise

import torch

from mvrecon.data.scenes.phantoms import derenzo
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.methods.classical.mlem import mlem
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.methods.classical.sirt import sirt, sirt_weights
from mvrecon.methods.classical.solver import Iterate
from mvrecon.operators.visual_hull.hull import visual_hull
from mvrecon.operators.visual_hull.support import noise_threshold
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.case import DOUBLE, EVERY, PRECISE, SINGLE, bound, case, refused
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, Subject

#: Shift of the detector for which half of its pixels miss `GRID`, which is only partly visible.
ASIDE = {"pixels": [6, 5], "pixel_mm": [2.1, 2.3], "offset_mm": [7.0, -0.3]}


def generator(subject: Subject) -> torch.Generator:
    """Random generator of a case."""
    return torch.Generator(subject.device).manual_seed(0)


@case("projector", 43, 1e-4, SINGLE)
def single_precision(subject: ProjectorSubject) -> float:
    """MLEM in float32: the volume of float64, after 50 iterations."""
    grid = Grid.centred((16, 16, 16), 4.0)
    detector = {"pixels": [12, 12], "pixel_mm": 1.1, "offset_mm": 0.0}
    A = subject.projector(grid, subject.rig(grid, detector, n_views=4))
    phantom = derenzo(radius=30.0, height=40.0, background=0.1)
    bright = A(phantom.values(voxel_centres(grid)).to(subject.device)[None, None])
    counts = torch.poisson(bright * (200 / bright.max()), generator=generator(subject))
    return gap(mlem(A, counts.float(), 50), mlem(A, counts, 50))


@case("projector", 50, bound(1e-12, 1e-6), EVERY)
def thick_matter(subject: ProjectorSubject) -> Iterator[float]:
    """Line integrals up to 200: finite, equal to float64; exp(-p) underflows at 9.7 in float16 and
    at 87 in float32.
    """
    A = subject.projector(GRID, subject.rig())
    ones = A(torch.ones(1, 1, *GRID.shape, dtype=torch.float64, device=subject.device))
    for p in (0.0, 1e-6, 9.7, 87.0, 200.0):
        level = torch.tensor(p / float(ones.max()), dtype=torch.float64).to(subject.dtype)
        x = level.expand(1, 1, *GRID.shape).to(subject.device).clone().requires_grad_()
        views = A(x)
        (change,) = torch.autograd.grad(views.sum(), x)
        yield gap(views, float(level) * ones)
        yield float((~change.isfinite()).sum())


@case("mvrecon", 50)
def dense_rays(subject: Subject) -> Iterator[float]:
    """Noise behind dense matter: no dense ray becomes empty, up to p = 200."""
    p = torch.linspace(0, 200, 401, dtype=torch.float64)
    for photons in (1e2, 1e4, 1e6):
        for sigmas in (3.0, 4.0, 6.0):
            threshold = noise_threshold(p.to(subject.dtype), photons, sigmas).double()
            dense = p > threshold
            empty = ~dense[int(dense.int().argmax()) :]
            yield int((~threshold.isfinite()).sum() + empty.sum())


@case("projector", 51)
def no_numbers(subject: ProjectorSubject) -> float:
    """Logarithms of zero intensity, bad counts and starts: an error that counts them."""
    A = subject.projector(GRID, subject.rig())
    views = A(subject.random(1, 1, *GRID.shape).double())
    zero, acts, words = 0 * A.T(views), {}, {}
    for bad in (torch.inf, torch.nan):  # log(0) and I0 = 0; log(-1) and 0 / 0
        spoilt = views.clone()
        spoilt[0, 0, 1, 2, :2] = bad
        acts[f"SIRT, {bad}"] = partial(sirt, A, spoilt, 1)
        acts[f"MLEM, {bad}"] = partial(mlem, A, spoilt, 1)
        acts[f"hull, {bad}"] = partial(visual_hull, spoilt, A.cameras, GRID, 2)
        words |= {f"{name}, {bad}": "finite, got 2 of" for name in ("SIRT", "hull")}
        words[f"MLEM, {bad}"] = "finite.*got 2 bins"
    negative, words["MLEM, p < 0"] = views - views.max() / 2, "not negative, got"
    acts["MLEM, p < 0"] = partial(mlem, A, negative, 1)
    starts = {0.0: "allow none", -1.0: "non-negative start"}
    for value, text in (starts | dict.fromkeys((torch.nan, torch.inf), "finite")).items():
        for skip in (True, False):
            name = f"a start of {value}, skip_zero_bins={skip}"
            acts[name] = partial(mlem, A, views, 1, start=zero + value, skip_zero_bins=skip)
            words[name] = text
    free = sirt(A, negative, 3, nonnegative=False)
    assert free.isfinite().all() and free.min() < 0, "negative line integrals are lost"
    return refused(acts, words.__getitem__)


@case("projector", 53, PRECISE)
def odd_counts(subject: ProjectorSubject) -> Iterator[float]:
    """MLEM with unusual counts: total counts preserved, finite, non-negative."""
    A = subject.projector(GRID, subject.rig())
    every = A(subject.random(1, 1, *GRID.shape))
    whole, some, one, empty = (torch.ones_like(every) * c for c in (1, 0, 0, 1))
    some[..., ::2, 1::2] = 1
    one.flatten()[every.argmax()] = 1
    empty[:, :, 1] = 0
    every = every * (every > 1e-3 * every.max())
    for level in (1e-3, 1e9):
        for mask in (whole, some, one, empty, 1e-12 + one, 0 * whole):
            counts = level * mask * every
            x = mlem(A, counts, 1)
            sensitivity = PoissonLikelihood(A, counts).sensitivity(x.dtype).double()
            total = float(counts.double().sum())
            yield abs(float((sensitivity * x.double()).sum()) - total) / (total or 1.0)
            x = mlem(A, counts, 2, start=x)
            yield float((~((x >= 0) & x.isfinite())).sum())


@case("projector", 53)
def unseen(subject: ProjectorSubject) -> float:
    """MLEM with unseen voxels and rays: zero, unchanged, or an error."""
    A = subject.projector(GRID, subject.rig(detector=ASIDE))
    s = A.T(torch.ones_like(A(subject.random(1, 1, *GRID.shape))))
    start = subject.random(1, 1, *GRID.shape) + 0.1
    frozen = subject.random(1, 1, *GRID.shape, seed=1) < 0.2
    counts = A(start)
    assert (counts == 0).any() and (s == 0).any(), "the rig sees all of the grid"
    x = mlem(A, counts, 3, background=0.1, start=torch.where(frozen, 0, start))
    alone = torch.zeros_like(start)
    alone.flatten()[s.argmax()] = 1  # most rays have neither expected nor measured counts
    lost = int((~mlem(A, A(alone), 3, start=alone, skip_zero_bins=False).isfinite()).sum())
    lost += int(((s == 0) & (x != 0)).sum() + (frozen & (x != 0)).sum() + (~x.isfinite()).sum())
    blind = {"counts where none can be": lambda: mlem(A, torch.where(counts == 0, 7, counts), 1)}
    return lost + refused(blind, "bins hold counts where .* allow none")


@case("projector", 53)
def empty_rows_and_columns(subject: ProjectorSubject) -> float:
    """SIRT with empty rows and columns: zero; their values have no effect."""
    A = subject.projector(GRID, subject.rig(detector=ASIDE))
    views = A(subject.random(1, 1, *GRID.shape))
    R, C = sirt_weights(A, views.dtype)
    blind = (R == 0).any() and (C == 0).any()
    assert blind and R.isfinite().all() and C.isfinite().all(), "expected weights of zero"
    x, other = sirt(A, views, 5), sirt(A, torch.where(R == 0, 1e6, views), 5)
    violations = (x != other).sum() + (~x.isfinite()).sum() + ((C == 0) & (x != 0)).sum()
    return float(violations + (not x.any()))


@case("projector", 54, 1e-12, DOUBLE)
def rising(subject: ProjectorSubject) -> float:
    """100 iterations of MLEM: the likelihood never decreases."""
    A = subject.projector(GRID, subject.rig())
    rates = 9 * A(subject.random(1, 1, *GRID.shape).double())
    counts = torch.poisson(rates, generator=generator(subject))
    likelihood = PoissonLikelihood(A, counts, 0.1)
    values = [float(likelihood(mlem(A, counts, 0)))]

    def keep(iterate: Iterate) -> None:
        values.append(float(likelihood(iterate.volume)))

    mlem(A, counts, 100, 0.1, skip_zero_bins=False, monitor=keep)
    return greatest((new - old) / abs(old) for old, new in pairwise(values))


@case("projector", 56)
def drawn(subject: ProjectorSubject) -> float:
    """Counts of 0, 1e-9, 1e8 and NaN: finite, or an error; none of nothing."""
    A, bad = subject.projector(GRID, subject.rig()), 0
    rates = A(subject.random(1, 1, *GRID.shape).double())
    rates = rates / rates.max()
    for level in (0.0, 1e-9, 1e8):
        counts = torch.poisson(level * rates, generator=generator(subject)).to(subject.dtype)
        x = mlem(A, counts, 3)
        value = PoissonLikelihood(A, counts, 1e-3)(x)
        bad += int((~(x >= 0)).sum() + (~x.isfinite()).sum() + (~value.isfinite()).sum())
        bad += int((x != 0).sum()) if not counts.any() else 0
    acts = {}
    for value in (torch.nan, torch.inf, -1.0):
        spoilt = rates.clone()
        spoilt[0, 0, 0, 0, 0] = value
        acts[f"a count of {value}"] = partial(mlem, A, spoilt, 1)
    return bad + refused(acts, "got 1 bins that are not")
