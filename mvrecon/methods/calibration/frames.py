"""Shifts of an object between the frames of gated counts, from the counts themselves."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.mlem import osem
from mvrecon.methods.classical.solver import spread_background
from mvrecon.operators.operator import LinearOperator

#: Background in mean counts of a bin, so that an activity moved out of a bin with counts leaves
#: them possible.
MIN_BACKGROUND = 1e-3
#: Steps end below this part of a voxel, and are at most `MAX_STEP` voxels.
MAX_SETTLED_STEP, MAX_STEP = 0.01, 2.0
#: Added to the variance of each bin, in mean counts: the volume's edge is not sharp enough for the
#: weights of bins beside it that expect nothing.
ADDED_VARIANCE = 0.1
#: Least eigenvalue of the Fisher information relative to the greatest, far above rounding.
MIN_EIGENVALUE = 1e-9
#: Shifts of the eight octants of the activity show that it does not move as a whole where their
#: chi^2, of 24 numbers, is above this (1 in 40,000 by chance), and one is above this part of a
#: voxel, which discretisation may explain.
MAX_CHI2, MAX_PART_STEP = 63.0, 0.15


class FrameShifts(NamedTuple):
    """Shifts of the object in each frame relative to the first.

    Args:
        shift_mm: shift of each frame along x, y and z of the world, in mm; zeros for the first
            frame.
        sigma_mm: their standard deviation by the Poisson noise, as if the activity were known;
            the weights W make it up to a third larger.
        rounds: number of rounds that were computed; `settled` if the last one moved nothing any
            more.
    """

    shift_mm: Float[Tensor, "g 3"]
    sigma_mm: Float[Tensor, "g 3"]
    rounds: int
    settled: bool


def frame_shifts(
    operator_of: Callable[[Float[Tensor, "g 3"]], LinearOperator],
    grid: Grid,
    counts: Float[Tensor, "1 1 m v u"],
    views: Sequence[int],
    background: float | Float[Tensor, "1 1 m v u"] | None = None,
    iterations: int = 4,
    subsets: int | None = None,
    rounds: int = 20,
) -> FrameShifts:
    """Estimate how far the object is shifted in each frame of gated counts.

    Each round reconstructs the counts of all frames with the current shifts by OSEM, and then takes
    a step of Fisher scoring in the shifts t of the Poisson likelihood, with the volume held: with
    the expected counts ybar, J = d ybar / d t = -A grad x, W = 1 / (ybar + 0.1 mean(y)),

        t <- t + (J^T W J)^-1 J^T W (y - ybar).

    The first frame defines the position of the activity. Blume, Navab and Rafecas, Phys. Med. Biol.
    57 (2012) 8249, estimate activity and (non-rigid) motion jointly from all frames.

    Args:
        operator_of: shifts in mm -> the operator of all frames of an object that is shifted so,
            such as `Stacked` of the cameras `rig.moved(torch.eye(3), -shift)` of each.
        grid: grid of the volume.
        counts: counts of all frames, one after the other.
        views: number of the views of each frame.
        background: expected counts of other origin, such as scatter.
        iterations, subsets: number of OSEM's iterations in each round, and of its subsets.
        rounds: maximum number of rounds.

    Warns:
        UserWarning: parts of the activity move unlike the rest, as a heart in a body at rest: the
            shift describes neither; shifts that still change in the last round.

    Raises:
        ValueError: fewer than two frames, other numbers of views than the counts have, a frame
            whose counts do not determine its shift; as `osem`.
    """
    if len(views) < 2 or sum(views) != counts.shape[2]:
        raise ValueError(
            f"Expected the numbers of views of at least two frames, {counts.shape[2]} in all, got "
            f"{list(views)}"
        )
    added = spread_background(0.0 if background is None else background, counts)
    added = added + MIN_BACKGROUND * counts.mean()
    to_world = torch.linalg.inv(grid.affine[:3, :3]).to(counts)
    shifts = torch.zeros(len(views), 3, dtype=torch.float64)
    variance, voxels, settled, number = shifts, 0.0, False, 0
    while not settled and number < rounds:
        A, number = operator_of(shifts), number + 1
        x = osem(A, counts, iterations, subsets, added)
        along = torch.stack(torch.gradient(x[0, 0], dim=(2, 1, 0)))  # x, y, z in voxels
        moving = -torch.einsum("kj,kdhw->jdhw", to_world, along)
        ybar = (A(x) + added)[0]
        steps = [_step(*frame) for frame in _frames(counts[0], ybar, A(moving[None])[0], views)]
        step, variance = (torch.stack(part).cpu() for part in list(zip(*steps, strict=True))[:2])
        step = step - step[0]
        voxels = (step.norm(dim=1).max() / min(grid.spacing)).item()
        shifts = shifts + step * min(1.0, MAX_STEP / max(voxels, MAX_SETTLED_STEP))
        settled = voxels < MAX_SETTLED_STEP
        if settled or number == rounds:
            parts = (moving * _octants(x[0, 0])[:, None]).flatten(0, 1)
            frames = _frames(counts[0], ybar, A(parts[None])[0], views)
            _warn_of_parts([_step(*frame) for frame in frames], min(grid.spacing))
    if not settled:
        warnings.warn(
            f"The shifts of the frames still changed by {voxels:.2g} voxels in round {rounds}, the "
            f"last",
            stacklevel=2,
        )
    sigma = (variance + variance[0]).sqrt()
    sigma[0] = 0
    return FrameShifts(shifts, sigma, number, settled)


def _frames(
    counts: Float[Tensor, "1 m v u"],
    expected: Float[Tensor, "1 m v u"],
    slopes: Float[Tensor, "k m v u"],
    views: Sequence[int],
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Counts, expected counts and slopes of each frame."""
    return zip(*(part.split(list(views), 1) for part in (counts, expected, slopes)), strict=True)


def _step(
    counts: Float[Tensor, "1 m v u"],
    expected: Float[Tensor, "1 m v u"],
    slopes: Float[Tensor, "k m v u"],
) -> tuple[Float[Tensor, " k"], Float[Tensor, " k"], float]:
    """Fisher scoring's step in k shifts in mm, the variances of their results, and its chi^2."""
    J, y, ybar = (part.flatten(1).double() for part in (slopes, counts, expected))
    weighted = J / (ybar + ADDED_VARIANCE * y.mean())
    fisher, score = weighted @ J.mT, weighted @ (y - ybar)[0]
    rank = torch.linalg.matrix_rank(fisher, hermitian=True, rtol=MIN_EIGENVALUE)
    if not y.any() or len(J) == 3 and rank < 3:
        raise ValueError("Expected frames whose counts determine a shift along each axis")
    covariance = torch.linalg.pinv(fisher, hermitian=True, rtol=MIN_EIGENVALUE)
    step = covariance @ score
    return step, covariance.diagonal(), (score @ step).item()


def _octants(volume: Float[Tensor, "d h w"]) -> Float[Tensor, "8 d h w"]:
    """One in each octant of a volume about its centre of mass, and else zero."""
    above = []
    for dim, n in enumerate(volume.shape):
        others = [other for other in range(3) if other != dim]
        places = torch.arange(n, device=volume.device)
        mass = volume.sum(dim=others)
        above.append(places > (mass * places).sum() / mass.sum())
    z, y, x = torch.meshgrid(*above, indexing="ij")
    return torch.stack([(4 * z + 2 * y + x) == n for n in range(8)]).to(volume)


def _warn_of_parts(steps: Sequence[tuple[Tensor, Tensor, float]], spacing: float) -> None:
    """Warn where shifts of single octants explain more than noise would."""
    apart = max(step.abs().max().item() * (chi2 > MAX_CHI2) for step, _, chi2 in steps)
    if apart > MAX_PART_STEP * spacing:
        warnings.warn(
            f"Expected frames of an object that moves as a whole, got parts of it that are up to "
            f"{apart:.2g} mm elsewhere: one shift does not describe a heart in a body at rest",
            stacklevel=3,
        )
