"""Counts of a Derenzo phantom by GATE, their random halves, and the contrast of its rods."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.operators.operator import LinearOperator

GRID, PIXELS, HOLE = mv.Grid.centred(size=(92, 92, 20), spacing=1.5), 25, 2.3
SUBSETS, BACKGROUND, SEEDS = 8, 0.05, 5
#: Most iterations, and those after the best.
MOST, PATIENCE = 200, 4
#: Distance in mm of a sector's first rod from the axis, and the lattices of the sectors whose rods
#: some reconstruction separates: direction in degrees, distance of neighbours in mm, rows.
FIRST = 20.4
SECTORS = ((-30, 21.0, 2), (-90, 16.6, 3), (-150, 12.8, 4), (150, 10.4, 4))


def counts_of(path: Path) -> Tensor:
    """The counts [1 1 m v u] of a file, in the order and orientation of `dcspect80`."""
    values = np.fromfile(path, "<f8").reshape(1, 1, 80, PIXELS, PIXELS)
    return torch.from_numpy(values).float().flip(-1)


def halves(counts: Tensor) -> Tensor:
    """Binomial halves [s 1 m v u] of the counts, one for each seed."""
    half = torch.full_like(counts, 0.5)
    seeds = [torch.Generator().manual_seed(seed) for seed in range(SEEDS)]
    return torch.cat([torch.binomial(counts, half, generator=seed) for seed in seeds])


def run(
    file: Path, names: dict[str, str], A: LinearOperator, method: Callable, path: Path, batch: int
) -> None:
    """Reconstruct the halves and all counts, and write the log-likelihoods of the other halves by
    iteration and seed, and the volumes of all counts by iteration.

    Halves stop `PATIENCE` iterations after the greatest likelihood.

    Args:
        file: what to write.
        names: of the reconstruction.
        A: the operator.
        method: of (A, counts, monitor).
        path: the counts.
        batch: counts that are reconstructed at once.
    """
    counts = counts_of(path)
    given = torch.cat([halves(counts), counts])
    others = (counts - given).double()
    likelihood, volumes = torch.full((MOST, SEEDS), -torch.inf).double(), []
    for some in torch.arange(len(given)).split(batch):
        seeds = some[some < SEEDS]

        def watch(iterate, some=some, seeds=seeds) -> bool:
            mean = (given[some] - iterate.residual).double().clamp_min(1e-9)
            values = (others[some] * mean.log() - mean).flatten(1).sum(dim=1)
            likelihood[iterate.number - 1, seeds] = values[: len(seeds)]
            if len(seeds) < len(some):
                volumes.append(iterate.volume[-1, 0])
            best = likelihood[:, seeds].mean(dim=1).argmax().item()
            return len(seeds) > 0 and iterate.number > best + PATIENCE

        method(A, given[some], watch)
    file.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"names": names, "likelihood": likelihood, "volumes": torch.stack(volumes)}, file)


def contrasts(volume: Tensor) -> dict[str, float]:
    """1 - valley / peak of neighbouring rods, by their distance in mm.

    Peaks and valleys are means over discs about the rods and the midpoints between neighbours; the
    discs' radius is a sixth of the distance.
    """
    flat = volume.sum(dim=0)
    places = [(torch.arange(n) - (n - 1) / 2) * 1.5 for n in GRID.size[:2]]
    points = torch.cartesian_prod(places[1], places[0]).flip(-1)  # x, y of each pixel of `flat`
    found = {}
    for direction, step, rows in SECTORS:
        turn = math.radians(direction)
        along = torch.tensor([math.cos(turn), math.sin(turn)])
        across = torch.tensor([-math.sin(turn), math.cos(turn)])
        rods = torch.stack(
            [
                (FIRST + n * step * math.sqrt(3) / 2) * along + (i - n / 2) * step * across
                for n in range(rows)
                for i in range(n + 1)
            ]
        )
        one, other = (torch.cdist(rods, rods) < 1.01 * step).triu(1).nonzero().unbind(1)
        peak, valley = (
            flat.flatten()[(torch.cdist(points, at) < step / 6).any(dim=1)].mean()
            for at in (rods, (rods[one] + rods[other]) / 2)
        )
        found[f"{step:g} mm"] = 1 - (valley / peak).item()
    return found
