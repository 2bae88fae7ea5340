"""Heads: from a network's logits in a camera's frustum to that camera's density.

A head says by `keeps_views` whether its density, in its own frustum, sums to the camera's own view
(3e-7 in float32). It is called with logits [b m 1 D v u] (zero logits mean: nothing to add to the
prior), the prior density of the same shape, the measured views and the frusta, and returns a
density [b m 1 D v u] in the unit of (views / mm).
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.methods.learned.view_frames import Frusta

#: A prior of exactly zero could never be raised by a finite logit; relative to the prior's mean
#: along the ray.
FLOOR = 1e-2


class SoftmaxDepth(nn.Module):
    """Shares the measured integral out along its ray: p * softmax_d(logits + log prior) / step.

    The sum over a ray's bins times the bins' lengths is the measurement, to rounding, whatever the
    logits; so in its own frustum every camera's density reproduces its own view, and a ray that
    measured nothing is empty. Warped to the world, it does so no longer (docs/model.md). Rays
    outside the region stay zero.
    """

    keeps_views = True

    def forward(
        self,
        logits: Float[Tensor, "b m 1 D v u"],
        prior: Float[Tensor, "b m 1 D v u"],
        views: Float[Tensor, "b 1 m v u"],
        frusta: Frusta,
    ) -> Float[Tensor, "b m 1 D v u"]:
        occupied = frusta.occupied
        prior = prior.clamp_min(0) * occupied
        level = prior.sum(dim=3, keepdim=True) / occupied.sum(dim=-3, keepdim=True).clamp_min(1)
        relative = prior / level.clamp_min(torch.finfo(prior.dtype).tiny)
        logits = logits + (relative + FLOOR).log()
        # Finite, not -inf: a ray with no bin in the region must not turn into NaN.
        masked = torch.where(occupied, logits, torch.finfo(logits.dtype).min)
        share = masked.softmax(dim=3) * occupied
        return share * views.transpose(1, 2)[:, :, :, None] / frusta.step


class Density(nn.Module):
    """A density with no constraint: softplus(logits + softplus^-1(prior)), in units of the mean
    lifted density.
    """

    keeps_views = False

    def forward(
        self,
        logits: Float[Tensor, "b m 1 D v u"],
        prior: Float[Tensor, "b m 1 D v u"],
        views: Float[Tensor, "b 1 m v u"],
        frusta: Frusta,
    ) -> Float[Tensor, "b m 1 D v u"]:
        lifted = frusta.spread(views)
        scale = (
            lifted.abs()
            .mean(dim=(1, 2, 3, 4, 5), keepdim=True)
            .clamp_min(torch.finfo(prior.dtype).tiny)
        )
        start = (prior / scale).clamp_min(FLOOR)
        inverse = (
            start + (-(-start).expm1()).log()
        )  # of softplus, written so that it overflows for no prior
        return nn.functional.softplus(logits + inverse) * scale * frusta.occupied
