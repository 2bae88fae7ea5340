"""Heads: map a network's logits in a camera's frustum to that camera's density.

A head is called with logits [b m 1 D v u] (zero logits leave the prior unchanged), the prior
density of the same shape, the measured views and the frusta, and returns a density [b m 1 D v u] in
the unit of (views / mm). Its attribute `keeps_views` states whether the density sums to the
camera's own view in its own frustum (3e-7 in float32).
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.numbers import divided
from mvrecon.methods.learned.view_frames import Frusta

#: Lower bound of the prior relative to its mean along the ray, as no finite logit raises a prior of
#: zero.
MIN_PRIOR = 1e-2


class SoftmaxDepth(nn.Module):
    """Distributes the measured integral along its ray: p * softmax_d(logits + log prior) / step.

    For any logits the integral over a ray's bins equals the measurement to rounding, so in its own
    frustum every camera's density reproduces its own view (not so after warping to the volume, see
    docs/model.md), and zero rays are empty. Rays outside the region stay zero.
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
        logits = logits + (divided(prior, level) + MIN_PRIOR).log()
        # finite, not -inf: a ray without bins in the region must not become NaN
        masked = torch.where(occupied, logits, torch.finfo(logits.dtype).min)
        share = masked.softmax(dim=3) * occupied
        return share * views.transpose(1, 2)[:, :, :, None] / frusta.step


class Density(nn.Module):
    """An unconstrained density: softplus(logits + softplus^-1(prior)), in units of the mean lifted
    density.
    """

    keeps_views = False

    def forward(
        self,
        logits: Float[Tensor, "b m 1 D v u"],
        prior: Float[Tensor, "b m 1 D v u"],
        views: Float[Tensor, "b 1 m v u"],
        frusta: Frusta,
    ) -> Float[Tensor, "b m 1 D v u"]:
        lifted, tiny = frusta.spread(views).abs(), torch.finfo(prior.dtype).tiny
        scale = lifted.mean(dim=(1, 2, 3, 4, 5), keepdim=True).clamp_min(tiny)
        start = (prior / scale).clamp_min(MIN_PRIOR)
        inverse = start + (-(-start).expm1()).log()  # of softplus, without overflow for any prior
        return nn.functional.softplus(logits + inverse) * scale * frusta.occupied
