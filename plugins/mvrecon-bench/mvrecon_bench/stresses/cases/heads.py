"""Heads: extreme logits, priors and views."""

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from mvrecon.methods.learned.view_frames import Frusta, fuse
from mvrecon.testing import check_head
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.learned_subjects import GRID, HeadSubject, small_rig
from mvrecon_bench.stresses.refusals import none_of
from mvrecon_bench.stresses.subject import Subject

#: Tolerance of a sum over the bins of a ray.
SUMS = {torch.float64: 1e-12, torch.float32: 1e-5}


def contract(subject: HeadSubject) -> float:
    """`mvrecon.testing.check_head`."""
    check_head(subject.name, Frusta.of(GRID, small_rig(), depth=10), **subject.options)
    return 0.0


def extremes(subject: HeadSubject) -> Iterator[tuple[str, tuple[Tensor, Tensor, Tensor]]]:
    """Logits, priors and views that are large, small, equal or zero."""
    logits, prior, views = subject.given
    one = torch.full_like(logits, -1e4)
    one[:, :, :, 4] = 1e4
    for name, bad in (
        ("1e4", torch.full_like(logits, 1e4)),
        ("-1e4", torch.full_like(logits, -1e4)),
    ):
        yield f"logits of {name}", (bad, prior, views)
    yield "logits of 1e6 and -1e6", (1e6 * logits.sign(), prior, views)
    yield "logits of 1e4 in one bin", (one, prior, views)
    yield "logits of nought", (logits * 0, prior, views)
    yield "a prior of nought", (logits, prior * 0, views)
    yield "a prior below nought", (logits, -prior, views)
    yield "a prior of 1e-30", (logits, 1e-30 * prior, views)
    yield "a prior of 1e12", (logits, 1e12 * prior, views)
    yield "a prior in one bin", (logits, prior * (one > 0), views)
    yield "zero views", (logits, prior, views * 0)
    yield "views of nothing, no prior", (logits, prior * 0, views * 0)
    yield "views of 1e-30", (logits, 1e-30 * prior, 1e-30 * views)
    yield "views of 1e12", (logits, prior, 1e12 * views)
    yield "negative views", (logits, prior, -views)


def at_the_ends(subject: HeadSubject) -> float:
    """Finite densities, zero outside the region, and finite gradients."""
    failures = {}
    for name, operands in extremes(subject):
        leaves = [tensor.clone().requires_grad_() for tensor in operands]
        density = subject.head(*leaves, subject.frusta)
        slopes = torch.autograd.grad(density.sum(), leaves, allow_unused=True)
        masks = {
            "densities not finite": ~density.isfinite(),
            "densities outside": (density * ~subject.frusta.occupied) != 0,
            "gradients not finite": torch.cat(
                [~tensor.isfinite().flatten() for tensor in slopes if tensor is not None]
            ),
        }
        failures |= {
            f"{name}, {what}": str(int(hit.sum())) for what, hit in masks.items() if hit.any()
        }
    return none_of(failures)


def views_kept(subject: HeadSubject) -> float:
    """For the same inputs: view-preserving heads integrate to the views; all heads return zero for
    zero views.
    """
    errors = [0.0]
    for _, (logits, prior, views) in extremes(subject):
        density = subject.head(logits, prior, views, subject.frusta)
        if subject.head.keeps_views:
            errors.append(gap(subject.frusta.integrate(density), views))
        elif not views.any() and not prior.any():
            errors.append(float(density.abs().max()))
    return greatest(errors)


def bad_logits(subject: HeadSubject) -> float:
    """A NaN logit makes the density of its own ray not finite, and of no other; an infinite logit,
    which a head may bound, leaves the other rays finite.
    """
    logits, prior, views = subject.given
    *_, d, v, u = (int(i) for i in subject.frusta.occupied[0, 0].nonzero()[0])
    faults = {}
    for bad in (math.nan, math.inf, -math.inf):
        spoilt = logits.clone()
        spoilt[0, 0, 0, d, v, u] = bad
        density = subject.head(spoilt, prior, views, subject.frusta)
        wrong = ~density.isfinite()
        hidden = math.isnan(bad) and not wrong[0, 0, 0, :, v, u].any()
        wrong[0, 0, 0, :, v, u] = False
        touched = int(wrong.any(dim=3).sum())
        faults[f"logit {bad}, its own ray"] = "a finite density" if hidden else ""
        faults[f"logit {bad}, other rays"] = f"{touched} not finite" if touched else ""
    return none_of(faults)


def no_ray_hits(subject: HeadSubject) -> float:
    """Frusta without permitted bins."""
    frusta = Frusta.of(GRID, small_rig(), depth=10).to(subject.device, subject.dtype)
    none = replace(frusta, bins=replace(frusta.bins, end=0 * frusta.bins.end))
    density = subject.head(*subject.given, none)
    return float((density != 0).sum())  # also true for NaN


def fused_weights(subject: Subject) -> float:
    """Weights of three cameras from logits of any size sum to one at visible voxels."""
    visible = subject.random(3, 1, 4, 5, 6) < 0.5
    errors = []
    for size in (0.0, 1e4, -1e4, 1e30, -1e30):
        logits = torch.full((2, 3, 1, 4, 5, 6), size, dtype=subject.dtype)
        volume, weights = fuse(subject.random(2, 3, 1, 4, 5, 6), logits, visible)
        expected = visible.to(subject.dtype) / visible.sum(dim=0).clamp_min(1)
        errors += [float((weights - expected).abs().max()), float(volume.isnan().sum())]
    return greatest(errors)


CASES = (
    Case(19, "rays that miss", "zero density", "head", no_ray_hits),
    Case(
        47, "a logit that is NaN", "its own ray is not finite, every other is", "head", bad_logits
    ),
    Case(
        53,
        "extreme logits, priors and views",
        "finite, zero outside of the grid",
        "head",
        at_the_ends,
    ),
    Case(
        53,
        "re-projection of extreme inputs",
        "matches the views if claimed; zero from zero",
        "head",
        views_kept,
        SUMS,
    ),
    Case(53, "fusion by logits of any size", "weights sum to one", "mvrecon", fused_weights, SUMS),
    Case(61, "check_head", "passes", "head", contract),
)
