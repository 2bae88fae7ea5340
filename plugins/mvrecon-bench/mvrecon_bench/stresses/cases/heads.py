"""Heads: extreme logits, priors and views."""

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from mvrecon.methods.learned.view_frames import Frusta, fuse
from mvrecon.testing import check_head
from mvrecon.testing.measures import gap
from mvrecon_bench.stresses.case import PRECISE, case, none_of
from mvrecon_bench.stresses.subject import Subject
from mvrecon_bench.stresses.subjects import GRID, HeadSubject, small_rig


@case("head", 19)
def no_ray_hits(subject: HeadSubject) -> float:
    """Rays that miss: zero density."""
    bins = subject.frusta.bins
    none = replace(subject.frusta, bins=replace(bins, end=0 * bins.end))
    return float((subject.head(*subject.given, none) != 0).sum())  # also true for NaN


@case("head", 47)
def bad_logits(subject: HeadSubject) -> float:
    """A logit that is NaN: its own ray is not finite, every other is; a head may bound infinity."""
    logits, prior, views = subject.given
    *_, d, v, u = (int(i) for i in subject.frusta.occupied[0, 0].nonzero()[0])
    faults = {}
    for bad in (math.nan, math.inf, -math.inf):
        spoilt = logits.clone()
        spoilt[0, 0, 0, d, v, u] = bad
        wrong = ~subject.head(spoilt, prior, views, subject.frusta).isfinite()
        hidden = math.isnan(bad) and not wrong[0, 0, 0, :, v, u].any()
        wrong[0, 0, 0, :, v, u] = False
        touched = int(wrong.any(dim=3).sum())
        faults[f"logit {bad}, its own ray"] = "a finite density" if hidden else ""
        faults[f"logit {bad}, other rays"] = f"{touched} not finite" if touched else ""
    return none_of(faults)


def extremes(subject: HeadSubject) -> Iterator[tuple[str, tuple[Tensor, Tensor, Tensor]]]:
    """Logits, priors and views that are large, small, equal or zero."""
    logits, prior, views = subject.given
    one = torch.full_like(logits, -1e4)
    one[:, :, :, 4] = 1e4
    for name, other in {
        **{f"{c:g}": torch.full_like(logits, c) for c in (1e4, -1e4, 0.0)},
        **{"1e6 and -1e6": 1e6 * logits.sign(), "1e4 in one bin": one},
    }.items():
        yield f"logits of {name}", (other, prior, views)
    for factor in (0.0, -1.0, 1e-30, 1e12):
        yield f"a prior times {factor:g}", (logits, factor * prior, views)
    yield "a prior in one bin", (logits, prior * (one > 0), views)
    yield "views of nothing, no prior", (logits, prior * 0, views * 0)
    yield "prior and views of 1e-30", (logits, 1e-30 * prior, 1e-30 * views)
    for factor in (0.0, 1e12, -1.0):
        yield f"views times {factor:g}", (logits, prior, factor * views)


@case("head", 53)
def at_the_ends(subject: HeadSubject) -> float:
    """Extreme logits, priors and views: finite, also gradients, zero outside of the grid."""
    faults = {}
    for name, operands in extremes(subject):
        leaves = [tensor.clone().requires_grad_() for tensor in operands]
        density = subject.head(*leaves, subject.frusta)
        slopes = torch.autograd.grad(density.sum(), leaves, allow_unused=True)
        hits = {
            "densities not finite": int((~density.isfinite()).sum()),
            "densities outside": int(((density * ~subject.frusta.occupied) != 0).sum()),
            "gradients not finite": sum(
                int((~s.isfinite()).sum()) for s in slopes if s is not None
            ),
        }
        faults |= {f"{name}, {what}": str(hit) for what, hit in hits.items() if hit}
    return none_of(faults)


@case("head", 53, PRECISE)
def views_kept(subject: HeadSubject) -> Iterator[float]:
    """Re-projection of extreme inputs: matches the views if claimed; zero from zero."""
    yield 0.0
    for _, (logits, prior, views) in extremes(subject):
        density = subject.head(logits, prior, views, subject.frusta)
        if subject.head.keeps_views:
            yield gap(subject.frusta.integrate(density), views)
        elif not views.any() and not prior.any():
            yield float(density.abs().max())


@case("mvrecon", 53, PRECISE)
def fused_weights(subject: Subject) -> Iterator[float]:
    """Fusion by logits of any size: weights sum to one."""
    visible = subject.random(3, 1, 4, 5, 6) < 0.5
    for size in (0.0, 1e4, -1e4, 1e30, -1e30):
        logits = torch.full((2, 3, 1, 4, 5, 6), size, dtype=subject.dtype, device=subject.device)
        volume, weights = fuse(subject.random(2, 3, 1, 4, 5, 6), logits, visible)
        expected = visible.to(subject.dtype) / visible.sum(dim=0).clamp_min(1)
        yield float((weights - expected).abs().max())
        yield float(volume.isnan().sum())


@case("head", 61)
def contract(subject: HeadSubject) -> float:
    """check_head: passes."""
    check_head(subject.name, Frusta.of(GRID, small_rig(), depth=10), **subject.options)
    return 0.0
