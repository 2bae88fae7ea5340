"""Extreme line integrals p: high attenuation, logarithms of zero intensity, empty rays and
voxels.

mvrecon processes p, not transmissions exp(-p), and does not compute logarithms of measured
intensities. The cases test values that such logarithms, computed elsewhere, may leave in the views.
"""

import torch

from mvrecon.methods.classical.mlem import mlem
from mvrecon.methods.classical.sirt import sirt, sirt_weights
from mvrecon.operators.visual_hull.hull import visual_hull
from mvrecon.operators.visual_hull.support import noise_threshold
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.cases.counts import ASIDE, operator
from mvrecon_bench.stresses.refusals import none_of, refusal
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, Subject

HALVES = (torch.bfloat16, torch.float16)
FLOATS = (torch.float64, torch.float32)
#: Half precision is storage only, summed in float32.
VIEWS = {torch.float64: 1e-12, torch.float32: 1e-6, torch.bfloat16: 1e-6, torch.float16: 1e-6}


def thick_matter(subject: ProjectorSubject) -> float:
    """Line integrals from 0 to 200 and their gradients; transmissions underflow at 9.7 in float16
    and at 87 in float32.
    """
    A = operator(subject)
    ones = A(torch.ones(1, 1, *GRID.shape, dtype=torch.float64, device=subject.device))
    worst = 0.0
    for p in (0.0, 1e-6, 9.7, 87.0, 200.0):
        level = torch.tensor(p / float(ones.max()), dtype=torch.float64).to(subject.dtype)
        x = level.expand(1, 1, *GRID.shape).to(subject.device).clone().requires_grad_()
        views = A(x)
        (change,) = torch.autograd.grad(views.sum(), x)
        if not (views.isfinite().all() and change.isfinite().all()):
            raise AssertionError(f"at p = {p} some views or gradients are not finite")
        worst = greatest([worst, gap(views, float(level) * ones)])
    return worst


def dense_rays(subject: Subject) -> float:
    """A noise threshold must not classify highly attenuated rays, up to p = 200, as empty."""
    p = torch.linspace(0, 200, 401, dtype=torch.float64)
    violations = 0
    for photons in (1e2, 1e4, 1e6):
        for sigmas in (3.0, 4.0, 6.0):
            threshold = noise_threshold(p.to(subject.dtype), photons, sigmas).double()
            dense = p > threshold
            first = int(dense.int().argmax())
            violations += int((~threshold.isfinite()).sum() + (~dense[first:]).sum())
    return float(violations)


def logarithms(subject: ProjectorSubject) -> float:
    """Results of log(0), log(-1), I0 = 0 and dead pixels are rejected with their number; I > I0,
    i.e. p < 0, is accepted.
    """
    A = operator(subject)
    views = subject.random(1, 1, *A.range_shape).double()
    bad = {}
    for name, (intensity, open_beam) in {
        "log(0)": (0.0, 1e4),
        "log(-1)": (-1.0, 1e4),
        "I0 = 0": (65535.0, 0.0),
        "0 / 0": (0.0, 0.0),
    }.items():
        spoiled = views.clone()
        spoiled[0, 0, 1, 2, :2] = -(torch.tensor(intensity) / torch.tensor(open_beam)).log()
        bad[f"SIRT, {name}"] = refusal(lambda y=spoiled: sirt(A, y, 1), "finite, got 2 of")
        bad[f"MLEM, {name}"] = refusal(lambda y=spoiled: mlem(A, y, 1), "finite.*got 2 bins")
        bad[f"hull, {name}"] = refusal(
            lambda y=spoiled: visual_hull(y, A.cameras, GRID, 2), "finite, got 2 of"
        )
    bad["MLEM, p < 0"] = refusal(lambda: mlem(A, views - 2, 1), "not negative, got")
    free = sirt(A, views - 0.5, 3, nonnegative=False)
    bad["SIRT, p < 0"] = (
        "" if free.isfinite().all() and free.min() < 0 else "negative line integrals are lost"
    )
    return none_of(bad)


def empty_rows_and_columns(subject: ProjectorSubject) -> float:
    """SIRT on a rig that misses part of the grid, with rays outside the grid that measured
    arbitrary values.
    """
    A = operator(subject, detector=ASIDE)
    views = A(subject.random(1, 1, *GRID.shape))
    R, C = sirt_weights(A, views.dtype)
    if not ((R == 0).any() and (C == 0).any() and R.isfinite().all() and C.isfinite().all()):
        raise AssertionError("expected empty rows and columns with a weight of zero")
    wild = torch.where(R == 0, 1e6, views)
    x, other = sirt(A, views, 5), sirt(A, wild, 5)
    return float(
        (x != other).sum() + (~x.isfinite()).sum() + ((C == 0) & (x != 0)).sum() + (not x.any())
    )


CASES = (
    Case(
        50,
        "line integrals up to 200",
        "finite, equal to float64",
        "projector",
        thick_matter,
        VIEWS,
        (*FLOATS, *HALVES),
    ),
    Case(50, "noise behind dense matter", "no dense ray becomes empty", "mvrecon", dense_rays),
    Case(51, "logarithms of zero intensity", "an error that counts them", "projector", logarithms),
    Case(
        53,
        "SIRT with empty rows and columns",
        "zero; their values have no effect",
        "projector",
        empty_rows_and_columns,
    ),
)
