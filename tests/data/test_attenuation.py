"""Hounsfield units and attenuation."""

import pytest
import torch

from mvrecon.data.attenuation import BONE, WATER, attenuation, hounsfield


@pytest.mark.parametrize(
    ("hu", "mu"),
    [
        (-2048, 0.0),
        (-1024, 0.0),
        (-1000, 0.0),
        (-500, 0.0096),
        (0, 0.0192),
        (500, 0.03825),
        (1000, 0.0573),
    ],
)
def test_attenuation_at_known_tissues(hu, mu):
    assert attenuation(torch.tensor(float(hu), dtype=torch.float64)).item() == pytest.approx(
        mu, abs=1e-12
    )


def test_the_two_lines_meet_at_water_with_their_own_slopes():
    hu = torch.tensor([-1e-3, 0.0, 1e-3], dtype=torch.float64)
    below, above = attenuation(hu).diff() / 1e-3
    assert below.item() == pytest.approx(WATER / 1000)
    assert above.item() == pytest.approx((BONE - WATER) / 1000)


def test_at_the_energy_of_technetium_water_and_bone_are_those_of_nist():
    hu = torch.tensor([-1000.0, 0.0, 400.0, 1000.0], dtype=torch.float64)
    mu = attenuation(hu, 140.5)
    assert mu[[0, 1, 3]].tolist() == pytest.approx([0, 0.01536, 0.0295])
    torch.testing.assert_close(hounsfield(mu, 140.5), hu)
    with pytest.raises(ValueError, match="energies"):
        attenuation(hu, 141.0)
