"""Conversion between Hounsfield units and linear attenuation in 1/mm, at about 70 keV or at the
energy of an isotope.

By definition HU = 1000 (mu - mu_water) / mu_water, which is used up to water. Above, a second line
leads to bone, with its larger photoelectric share: the bilinear form of CT-based attenuation
correction (Carney et al., Med. Phys. 33 (2006) 976), with the constants of the DRR renderer
nanodrr. For emission the lines lead to attenuation at the isotope's energy: at 140.5 keV (Tc-99m)
0.01536 / mm for water and 0.0295 / mm for cortical bone (NIST XCOM).
"""

import re
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused, shown

#: Units of the numbers in a file: Hounsfield units, linear attenuation, or any unit of activity.
StoredUnit = Literal["HU", "1/mm", "activity"]
#: Unit of a concentration of activity, 1 Bq / mm^3; "activity" is in any unit.
CONCENTRATION = "kBq/ml"
UNITS: tuple[StoredUnit, ...] = ("HU", "1/mm", "activity")
#: Units of line integrals, as of mvrecon's scenes or without, and of another projector's output.
UNIT_OF_VIEWS = re.compile(r"1|1/mm|\S.* \* mm|\S+ of \S.*")

#: Water, in 1/mm.
WATER = 0.0192
#: Cortical bone at 1000 HU, in 1/mm.
BONE = 0.0573
#: Upper bound of attenuation in 1/mm of tissue and metal at such energies; HU exceed it.
MAX_ATTENUATION = 20.0
#: Least spread of a patient's Hounsfield units, air and tissue.
MIN_HU_SPREAD = 10.0


class Tissue(NamedTuple):
    """Linear attenuation in 1/mm of water, and of cortical bone at 1000 HU."""

    water: float
    bone: float


#: Of CT, about, and of Tc-99m, in keV.
CT_KEV, SPECT_KEV = 70.0, 140.5
#: By the energy in keV.
TISSUES = {CT_KEV: Tissue(WATER, BONE), SPECT_KEV: Tissue(0.01536, 0.0295)}


def check_unit_of_views(unit: str, where: str = "") -> None:
    """Check that the unit of views is one of line integrals, or of a projector's output.

    Args:
        unit: unit of the views, of counts divided by their dose.
        where: the views, for the message.

    Raises:
        Refused: another unit, in which mvrecon does not know what the values are.
    """
    if not UNIT_OF_VIEWS.fullmatch(unit):
        raise Refused(
            f"{where}expected a unit of views such as '1/mm * mm' (line integrals) or 'spect of "
            f"activity', got {shown(unit)}; of another program's values, remove the attribute "
            f"unit, and say views.dataset=/views and views.kind"
        )


def physical(
    values: Float[Tensor, "*n"], stored: StoredUnit, energy_kev: float = 70.0
) -> Float[Tensor, "*n"]:
    """Convert the numbers in a file to attenuation in 1/mm or activity; HU become attenuation at an
    energy in keV.

    Raises:
        ValueError: values that are not finite, or that cannot be attenuation in 1/mm.
    """
    ends = torch.stack(values.aminmax())  # NaN where any value is; a tenth of the time of isfinite
    if not ends.isfinite().all():
        bad = int((~values.isfinite()).sum())
        raise ValueError(f"has {bad} values that are not finite {stored}")
    if stored == "1/mm" and (largest := ends.abs().max().item()) > MAX_ATTENUATION:
        raise ValueError(
            f"has values up to {largest:g}, expected attenuation in 1/mm within "
            f"{MAX_ATTENUATION:g}; are they HU?"
        )
    return attenuation(values, energy_kev) if stored == "HU" else values


def check_spread(low: float, high: float) -> None:
    """Check that the values of a non-uniform volume can be Hounsfield units.

    Raises:
        ValueError: their spread is so small that all would become water.
    """
    if 0 < high - low < MIN_HU_SPREAD:
        raise ValueError(
            f"has values from {low:.4g} to {high:.4g}, expected HU (air -1000, water 0); "
            f"stored_unit=1/mm is for attenuation"
        )


def attenuation(hu: Float[Tensor, "*n"], energy_kev: float = 70.0) -> Float[Tensor, "*n"]:
    """Return the linear attenuation in 1/mm of Hounsfield units: two lines that meet at water,
    clamped at zero.

    mu = water (1 + HU/1000) below 0 HU, water + (bone - water) HU/1000 above, at 70 or 140.5 keV.
    Padding outside of the scanner's field of view (-1024, -2048) becomes air, 0.

    Raises:
        ValueError: an unknown energy.
    """
    water, bone = tissue_at(energy_kev)
    return water * (1 + hu.clamp(-1000, 0) / 1000) + (bone - water) * hu.clamp(min=0) / 1000


def hounsfield(mu: Float[Tensor, "*n"], energy_kev: float = 70.0) -> Float[Tensor, "*n"]:
    """Return the Hounsfield units of a linear attenuation in 1/mm at an energy in keV, the inverse
    of `attenuation`.

    HU = 1000 (mu - water) / water up to water, 1000 (mu - water) / (bone - water) above.

    Raises:
        ValueError: an unknown energy.
    """
    water, bone = tissue_at(energy_kev)
    above = mu - water
    return 1000 * (above.clamp(max=0) / water + above.clamp(min=0) / (bone - water))


def tissue_at(energy_kev: float) -> Tissue:
    """Linear attenuation of water and bone at an energy in keV, in 1/mm.

    Raises:
        ValueError: an unknown energy.
    """
    if energy_kev not in TISSUES:
        raise ValueError(f"Expected one of the energies {sorted(TISSUES)} keV, got {energy_kev}")
    return TISSUES[energy_kev]
