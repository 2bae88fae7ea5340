"""Extreme counts: Poisson likelihood, MLEM, noise."""

from itertools import pairwise

import torch

from mvrecon.data.scenes.phantoms import derenzo
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.methods.classical.mlem import mlem
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.methods.classical.solver import Iterate
from mvrecon.operators.operator import Projector
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.case import PRECISE, Case
from mvrecon_bench.stresses.refusals import none_of, refusal
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, Subject

DOUBLE = (torch.float64,)
#: Shift of the detector for which half of its pixels miss `GRID`, which is only partly visible.
ASIDE = {"pixels": [6, 5], "pixel_mm": [2.1, 2.3], "offset_mm": [7.0, -0.3]}


def operator(subject: ProjectorSubject, grid: Grid = GRID, **rig) -> Projector:
    """The operator for the iterative methods."""
    return subject.projector(grid, subject.rig(grid, **rig))


def single_precision(subject: ProjectorSubject) -> float:
    """50 iterations of MLEM on counts of a Derenzo phantom on 16^3 voxels: float32 against
    float64.
    """
    grid = Grid.centred((16, 16, 16), 4.0)
    A = operator(
        subject, grid, detector={"pixels": [12, 12], "pixel_mm": 1.1, "offset_mm": 0.0}, n_views=4
    )
    phantom = derenzo(radius=30.0, height=40.0, background=0.1)
    truth = phantom.values(voxel_centres(grid)).to(subject.device)[None, None]
    bright = A(truth)
    counts = torch.poisson(bright * (200 / bright.max()), generator=generator(subject))
    return gap(mlem(A, counts.float(), 50), mlem(A, counts, 50))


def odd_counts(subject: ProjectorSubject) -> float:
    """Conservation of counts by MLEM for zero bins, an empty view, no counts, one bright bin, and
    counts of 1e-3 to 1e9.
    """
    A, worst = operator(subject), 0.0
    every = A(subject.random(1, 1, *GRID.shape))
    visible = every > 1e-3 * every.max()
    some = torch.zeros_like(every)
    some[..., ::2, 1::2] = 1
    one = torch.zeros_like(every)
    one.flatten()[every.argmax()] = 1
    empty = torch.ones_like(every)
    empty[:, :, 1] = 0
    for level in (1e-3, 1e9):
        for mask in (
            torch.ones_like(every),
            some,
            one,
            empty,
            1e-12 + one,
            torch.zeros_like(every),
        ):
            counts = level * mask * every * visible
            x = mlem(A, counts, 1)
            kept = float(
                (PoissonLikelihood(A, counts).sensitivity(x.dtype).double() * x.double()).sum()
            )
            total = float(counts.double().sum())
            worst = greatest([worst, abs(kept - total) / (total or 1.0)])
            x = mlem(A, counts, 2, start=x)
            if not (x >= 0).all() or not x.isfinite().all():
                raise AssertionError(
                    f"a voxel is negative or not finite at counts up to {float(counts.max()):.3g}"
                )
    return worst


def unseen(subject: ProjectorSubject) -> float:
    """Voxels without rays are 0, frozen voxels remain 0, and bins that no voxel explains are
    rejected.
    """
    A = operator(subject, detector=ASIDE)
    s = A.T(torch.ones_like(A(subject.random(1, 1, *GRID.shape))))
    start = subject.random(1, 1, *GRID.shape) + 0.1
    frozen = subject.random(1, 1, *GRID.shape, seed=1) < 0.2
    counts = A(start)
    x = mlem(A, counts, 3, background=0.1, start=torch.where(frozen, 0, start))
    alone = torch.zeros_like(start)
    alone.flatten()[s.argmax()] = 1  # most rays have neither expected nor measured counts
    lost = int((~mlem(A, A(alone), 3, start=alone, skip_zero_bins=False).isfinite()).sum())
    lost += int(((s == 0) & (x != 0)).sum() + (frozen & (x != 0)).sum() + (~x.isfinite()).sum())
    blind = torch.where(counts == 0, 7, counts)
    shown = {
        "rays that miss": ""
        if bool((counts == 0).any() and (s == 0).any())
        else "the rig sees all of the grid"
    }
    shown["counts where none can be"] = refusal(
        lambda: mlem(A, blind, 1), "bins hold counts where .* allow none"
    )
    return lost + none_of(shown)


def rising(subject: ProjectorSubject) -> float:
    """Maximum relative decrease of the likelihood in any of 100 MLEM iterations."""
    A = operator(subject)
    counts = torch.poisson(
        9 * A(subject.random(1, 1, *GRID.shape).double()), generator=generator(subject)
    )
    likelihood, volumes = PoissonLikelihood(A, counts, 0.1), [mlem(A, counts, 0)]

    def keep(iterate: Iterate) -> None:
        volumes.append(iterate.volume)

    mlem(A, counts, 100, 0.1, skip_zero_bins=False, monitor=keep)
    values = [float(likelihood(x)) for x in volumes]
    return greatest((new - old) / abs(old) for old, new in pairwise(values))


def generator(subject: Subject) -> torch.Generator:
    """Random generator of this case."""
    return torch.Generator(subject.device).manual_seed(0)


def zero_start(subject: ProjectorSubject) -> float:
    """Multiplicative updates preserve zeros: MLEM initialised with zeros, negative values or NaN,
    with and without zero bins.
    """
    A = operator(subject)
    counts = A(subject.random(1, 1, *GRID.shape))
    starts = {
        "zeros": (0.0, "allow none"),
        "below zero": (-1.0, "non-negative start"),
        "NaN": (torch.nan, "finite"),
        "infinite": (torch.inf, "finite"),
    }
    failures = {}
    for name, (value, words) in starts.items():
        start = torch.full((1, 1, *GRID.shape), value, dtype=counts.dtype, device=subject.device)
        for skip in (True, False):
            failures[f"{name}, skip_zero_bins={skip}"] = refusal(
                lambda start=start, skip=skip: mlem(A, counts, 1, start=start, skip_zero_bins=skip),
                words,
            )
    return none_of(failures)


def drawn(subject: ProjectorSubject) -> float:
    """Reconstruction of counts with rates of 0, 1e-9 and 1e8; NaN rates and counts are rejected."""
    A = operator(subject)
    rates = A(subject.random(1, 1, *GRID.shape).double())
    rates = rates / rates.max()
    bad = 0
    for level in (0.0, 1e-9, 1e8):
        counts = torch.poisson(level * rates, generator=generator(subject)).to(subject.dtype)
        x = mlem(A, counts, 3)
        value = PoissonLikelihood(A, counts, 1e-3)(x)
        bad += int((~(x >= 0)).sum() + (~x.isfinite()).sum() + (~value.isfinite()).sum())
    failures = {
        "no counts": ""
        if not mlem(A, torch.zeros_like(rates), 2).any()
        else "something came of nothing"
    }
    for name, value in (("NaN", torch.nan), ("infinity", torch.inf), ("-1", -1.0)):
        spoiled = rates.clone()
        spoiled[0, 0, 0, 0, 0] = value
        failures[f"a count of {name}"] = refusal(
            lambda y=spoiled: mlem(A, y, 1), "got 1 bins that are not"
        )
        # torch raises an error for negative rates, and may return anything for NaN
        draw = generator(subject)
        failures[f"a rate of {name}"] = refusal(
            lambda y=spoiled, draw=draw: PoissonLikelihood(A, torch.poisson(y, generator=draw)),
            kinds=(ValueError, RuntimeError),
        )
    return bad + none_of(failures)


CASES = (
    Case(
        43,
        "MLEM in float32",
        "the volume of float64",
        "projector",
        single_precision,
        1e-4,
        (torch.float32,),
    ),
    Case(
        53,
        "MLEM with unusual counts",
        "total counts preserved, finite, non-negative",
        "projector",
        odd_counts,
        PRECISE,
    ),
    Case(
        53, "MLEM with unseen voxels and rays", "zero, unchanged, or an error", "projector", unseen
    ),
    Case(
        54,
        "100 iterations of MLEM",
        "the likelihood never decreases",
        "projector",
        rising,
        1e-12,
        DOUBLE,
    ),
    Case(55, "MLEM from zero", "an error", "projector", zero_start),
    Case(56, "counts of 0, 1e-9, 1e8 and NaN", "finite, or an error", "projector", drawn),
)
