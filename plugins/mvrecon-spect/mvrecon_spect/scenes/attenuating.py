"""Scenes of emission with attenuation, and their views in closed form."""

from abc import abstractmethod
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import generator
from mvrecon.data.scenes.analytic import AnalyticScene
from mvrecon.data.scenes.sample import Rays, Sample
from mvrecon.data.scenes.solids import PAIRS, Phantom, voxelise
from mvrecon.geometry.grid import Grid


@dataclass(frozen=True, kw_only=True)
class AttenuatingScene(AnalyticScene):
    """Emission phantoms with attenuation; see `AnalyticScene`."""

    map_names = ("mu",)

    @abstractmethod
    def matter(self, rng: torch.Generator, grid: Grid) -> Phantom:
        """Linear attenuation in 1/mm of the case whose `phantom` uses the same random numbers."""

    def sample(self, index: int, seed: int, grid: Grid, cameras: Rays) -> Sample:
        """Case `index` of the series `seed`: line integrals without attenuation, truth and
        attenuation on `grid`.

        Raises:
            IndexError: the case does not exist.
        """
        sample = super().sample(index, seed, grid, cameras)
        return replace(sample, maps=self.maps(index, seed, grid))

    def maps(
        self, index: int, seed: int, grid: Grid, factor: int = 1
    ) -> dict[str, Float[Tensor, "1 d h w"]]:
        """Linear attenuation "mu" of a case in 1/mm on `grid.refined(factor)`, averaged over at
        least 2^3 points per voxel.
        """
        matter = self.matter(generator(seed, index), grid)
        fine = grid.refined(factor) if factor > 1 else grid
        return {"mu": voxelise(matter, fine, max(2, -(-4 // factor))).clamp_min(0)[None]}


def attenuated_integrals(
    activity: Phantom,
    matter: Phantom,
    start: Float[Tensor, "*n 3"],
    end: Float[Tensor, "*n 3"],
    ray_extent: tuple[float, float] = (0.0, 1.0),
) -> Float[Tensor, "*n"]:
    """Attenuated line integrals, integral of lambda(s) exp(-integral of mu from s to the detector)
    ds, in (unit of the activity) * mm.

    lambda and mu are constant between the points at which a ray enters or leaves a solid: such a
    segment of length D contributes lambda exp(-A) (1 - exp(-mu D)) / mu, with A the optical depth
    between it and the detector (Gullberg et al., Phys. Med. Biol. 30 (1985) 799). Computed in
    float64, returned in the dtype of `start`.

    Convention: counts run along X = start + w (end - start) towards growing w, see `Cameras`.

    Args:
        activity: emitting phantom.
        matter: attenuating phantom, in 1/mm.
        start: start points of the rays in world mm.
        end: end points of the rays.
        ray_extent: range of w in which a ray accumulates counts; may be infinite.
    """
    first, last = (x.reshape(-1, 3).double() for x in torch.broadcast_tensors(start, end))
    solids = sum(len(part.values) for part in (*activity.parts, *matter.parts))
    rows = max(1, 4 * PAIRS // max(1, solids))
    rays = zip(first.split(rows), (last - first).split(rows), strict=True)
    total = torch.cat([_emitted(activity, matter, o, q, ray_extent) for o, q in rays])
    return total.reshape(torch.broadcast_shapes(start.shape, end.shape)[:-1]).to(start.dtype)


def _emitted(
    activity: Phantom,
    matter: Phantom,
    start: Float[Tensor, "r 3"],
    step: Float[Tensor, "r 3"],
    ray_extent: tuple[float, float],
) -> Float[Tensor, " r"]:
    emission, absorption = (_jumps(x, start, step, ray_extent) for x in (activity, matter))
    at, order = torch.cat([emission[0], absorption[0]]).sort(dim=0)
    rises = [
        torch.cat([emission[1], torch.zeros_like(absorption[1])]),
        torch.cat([torch.zeros_like(emission[1]), absorption[1]]),
    ]
    emitting, mu = (rise.expand_as(at).gather(0, order).cumsum(dim=0)[:-1] for rise in rises)
    length = at.diff(dim=0) * step.norm(dim=-1)
    depth = mu * length
    beyond = depth.flip(0).cumsum(dim=0).flip(0) - depth
    share = torch.where(depth == 0, 1.0, -torch.expm1(-depth) / depth)
    return (emitting * length * torch.exp(-beyond) * share).sum(dim=0)


def _jumps(
    phantom: Phantom,
    start: Float[Tensor, "r 3"],
    step: Float[Tensor, "r 3"],
    ray_extent: tuple[float, float],
) -> tuple[Float[Tensor, "j r"], Float[Tensor, "j 1"]]:
    """Parameters t at which rays enter and leave the solids, and the steps of the value there."""
    at, rise = [start.new_zeros(0, len(start))], [start.new_zeros(0)]
    for part in phantom.parts:
        chords, count = part.chords(start, step, ray_extent), len(part.values)
        met = chords.leave > chords.enter
        pair = chords.solid[met], chords.ray[met]
        ends = start.new_zeros(2, count, len(start))  # solids that a ray misses have zero length
        ends[0][pair], ends[1][pair] = chords.enter[met], chords.leave[met]
        at.append(ends.flatten(0, 1))
        values = part.values.to(start.device)
        rise.append(torch.cat([values, -values]))
    return torch.cat(at), torch.cat(rise)[:, None]
