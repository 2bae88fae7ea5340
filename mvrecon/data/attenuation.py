"""Linear attenuation in 1/mm from Hounsfield units, at about 70 keV.

By definition HU = 1000 (mu - mu_water) / mu_water; that line serves up to water. Above, a second
line leads to bone, whose photoelectric share is larger: the bilinear form of CT-based attenuation
correction (Carney et al., Med. Phys. 33 (2006) 976), here with the constants of the DRR renderer
nanodrr.
"""

from jaxtyping import Float
from torch import Tensor

#: Water, in 1/mm.
WATER = 0.0192
#: What 1000 HU stands for, cortical bone, in 1/mm.
BONE = 0.0573


def attenuation(hu: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Linear attenuation in 1/mm of Hounsfield units: two lines that meet at water, never below
    zero.

    mu = WATER (1 + HU/1000) below 0 HU, WATER + (BONE - WATER) HU/1000 above. What scanners write
    outside of their field of view (-1024, -2048) becomes air, 0.
    """
    return WATER * (1 + hu.clamp(-1000, 0) / 1000) + (BONE - WATER) * hu.clamp(min=0) / 1000


def hounsfield(mu: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Hounsfield units of a linear attenuation in 1/mm: the inverse of `attenuation`.

    HU = 1000 (mu - WATER) / WATER up to water, 1000 (mu - WATER) / (BONE - WATER) above.
    """
    above = mu - WATER
    return 1000 * (above.clamp(max=0) / WATER + above.clamp(min=0) / (BONE - WATER))
