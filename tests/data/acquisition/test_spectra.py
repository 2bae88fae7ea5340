"""Polychromatic beams: water in closed form, hardening, and the limit of one energy."""

import math

import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.data.acquisition.detector import Acquisition, detected
from mvrecon.data.acquisition.spectra import PHOTONS, WATER, Spectrum, tube
from mvrecon.geometry.cameras.rigs import parallel

RIG = parallel(1, {"pixels": [4, 8], "pixel_mm": 1.0}, 100.0)


def measured(views, **options):
    return detected(views, Acquisition(photons=math.inf, **options), RIG, generator(0, 0))


@pytest.mark.parametrize("kv", [80.0, 120.0])
@pytest.mark.parametrize("integrating", [True, False])
def test_a_slab_of_water_transmits_the_mean_over_the_spectrum(kv, integrating):
    """Of 100 mm: the sum of N(E) E exp(-mu(E) 100 mm), written out, over that without the slab; a
    counting detector has no factor E.
    """
    energies = [15.0 + 5 * k for k in range(len(PHOTONS[kv]))]
    signal = [n * (e if integrating else 1) for n, e in zip(PHOTONS[kv], energies, strict=True)]
    through = sum(n * math.exp(-100 * mu) for n, mu in zip(signal, WATER, strict=False))
    integral = 100 * WATER[energies.index(70.0)]
    views = measured(torch.full((1, 1, 4, 8), integral), kv=kv, integrating=integrating)
    expected = -math.log(through / sum(signal))
    assert views.flatten().tolist() == pytest.approx([expected] * 32, rel=1e-6)


def test_water_attenuates_as_in_the_tables_of_nist():
    """Within 0.1 %, at the energies of Hubbell and Seltzer, NISTIR 5632, table 4, in cm^2/g."""
    table = {15: 1.673, 20: 0.8096, 30: 0.3756, 40: 0.2683, 50: 0.2269, 60: 0.2059, 80: 0.1837}
    for energy, value in {**table, 100: 0.1707}.items():
        assert 10 * WATER[(energy - 15) // 5] == pytest.approx(value, rel=1e-3)


def test_the_beam_hardens():
    """Each further millimetre attenuates less, down to the greatest energy's attenuation, and air
    nothing.
    """
    y = torch.linspace(0, 40, 4001, dtype=torch.float64)
    beam = tube(120.0)
    slope = (-beam.transmission(y).log()).diff() / y.diff()
    assert (slope.diff() < 0).all() and slope[-1] > WATER[-1] / WATER[11]
    assert beam.transmission(torch.zeros(1)).item() == pytest.approx(1, abs=1e-6)


def test_photons_of_one_energy_give_the_line_integrals():
    y = torch.linspace(0, 10, 32).reshape(1, 1, 4, 8)
    one = Spectrum(torch.ones(1), torch.ones(1))
    assert torch.equal(one.transmission(y), torch.exp(-y))
    assert torch.allclose(measured(y), y, atol=1e-5)


def test_unknown_tubes_and_tubes_without_photons_are_refused():
    with pytest.raises(ValueError, match="80 or 120 kV, got 100"):
        Acquisition(photons=1e5, kv=100)
    with pytest.raises(ValueError, match="Expected acquisition.photons"):
        Acquisition(kv=120)
    with pytest.raises(TypeError, match="integrating as true or false"):
        Acquisition(photons=1e5, kv=120, integrating=1)  # type: ignore[arg-type]
