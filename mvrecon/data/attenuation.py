"""Linear attenuation in 1/mm from Hounsfield units and back, at about 70 keV.

By definition HU = 1000 (mu - mu_water) / mu_water; that line serves up to water. Above, a second
line leads to bone, whose photoelectric share is larger: the bilinear form of CT-based attenuation
correction (Carney et al., Med. Phys. 33 (2006) 976), here with the constants of the DRR renderer
nanodrr.
"""

from typing import Literal

from jaxtyping import Float
from torch import Tensor

#: What the numbers in a file can be: Hounsfield units, linear attenuation, or activity in any unit.
StoredUnit = Literal["HU", "1/mm", "activity"]
UNITS: tuple[StoredUnit, ...] = ("HU", "1/mm", "activity")

#: Water, in 1/mm.
WATER = 0.0192
#: What 1000 HU stands for, cortical bone, in 1/mm.
BONE = 0.0573
#: Attenuation in 1/mm that no tissue or metal reaches at such energies: Hounsfield units do.
DENSE = 20.0


def physical(values: Float[Tensor, "*n"], stored: StoredUnit) -> Float[Tensor, "*n"]:
    """What is projected, attenuation in 1/mm or activity, from the numbers in a file.

    Raises:
        ValueError: values that are not finite, or that cannot be attenuation in 1/mm.
    """
    if bad := int((~values.isfinite()).sum()):
        raise ValueError(f"has {bad} values that are not finite {stored}")
    if stored == "1/mm" and values.abs().max() > DENSE:
        raise ValueError(
            f"has values up to {values.abs().max().item():g}, expected attenuation in 1/mm within "
            f"{DENSE:g}; are they HU?"
        )
    return attenuation(values) if stored == "HU" else values


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
