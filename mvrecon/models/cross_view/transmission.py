"""What reaches the detector of the emission in a camera's frustum, past what attenuates."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.frusta import Frusta
from mvrecon.reconstructors.division import divided

#: A bin of which less than this share reaches the detector counts as one of which so much does.
LEAST = 0.01


class Transmission(nn.Module):
    """From the density in frusta to what reaches the detector of it, and back; the same where
    nothing attenuates.

    Args:
        frusta: of the rig.
        mu: linear attenuation on their grid, in 1/mm; none: nothing attenuates.
    """

    share: Float[Tensor, "1 m 1 D v u"] | None

    def __init__(self, frusta: Frusta, mu: Float[Tensor, "1 1 d h w"] | None):
        super().__init__()
        share = None if mu is None else transmissions(frusta, mu)
        self.register_buffer("share", share, persistent=False)

    def attenuate(self, density: Float[Tensor, "b m 1 D v u"]) -> Float[Tensor, "b m 1 D v u"]:
        """What reaches the detector of a density: what views measure, and heads share out."""
        return density if self.share is None else density * self.share

    def restore(self, values: Float[Tensor, "b m 1 D v u"]) -> Float[Tensor, "b m 1 D v u"]:
        """The density of which so much reaches the detector."""
        return values if self.share is None else values / self.share

    def spread(
        self, frusta: Frusta, views: Float[Tensor, "b 1 m v u"]
    ) -> Float[Tensor, "b m 1 D v u"]:
        """The density, even along each ray, whose integrals of what reaches the detector are the
        views.
        """
        even = frusta.spread(views)
        if self.share is None:
            return even
        passed = (self.share * frusta.occupied * frusta.step).sum(dim=3, keepdim=True)
        return even * divided(frusta.chord, passed)


@torch.no_grad()
def transmissions(frusta: Frusta, mu: Float[Tensor, "b 1 d h w"]) -> Float[Tensor, "b m 1 D v u"]:
    """Transmission of each bin: the share of its emission that reaches the detector, from `LEAST`
    to 1.

    What attenuates between bin and detector counts, and in the bin, whose emission and attenuation
    are constant along the ray, (1 - exp(-mu D)) / (mu D) (Gullberg et al., Phys. Med. Biol. 30
    (1985) 799).

    Convention: counts run along a ray towards growing w, as in `AttenuatedTransform`: to bins of a
    greater index.

    Args:
        frusta: of the rig.
        mu: linear attenuation on their grid, in 1/mm.
    """
    inside = frusta.to_frusta(mu[:, None].to(frusta.slant.dtype)) * frusta.occupied * frusta.step
    beyond = inside.flip(3).cumsum(dim=3).flip(3) - inside
    of_bin = torch.where(inside > 0, -torch.expm1(-inside) / inside, 1.0)
    return ((-beyond).exp() * of_bin).clamp_min(LEAST)
