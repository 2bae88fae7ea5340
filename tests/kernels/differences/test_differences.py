"""The compiled steps of the total variation: the reference's, to rounding, on any threads."""

import pytest
import torch

from mvrecon.kernels import differences as reference
from mvrecon.kernels.differences import Shrinkage, Stride, cpu
from mvrecon.testing import inner_product_gap

STEPS = (1.5, 2.0, 0.5)
SHAPES = [(2, 3, 5, 6, 7), (1, 1, 1, 9, 11), (1, 2, 37, 3, 4), (1, 1, 16, 1, 5), (1, 1, 33, 4, 1)]
ROUNDING = {torch.float32: 2e-6, torch.float64: 4e-15}


def problem(shape, dtype, nonnegative=True):
    """A volume, two dual fields with vectors shorter and longer than 1, and a shrinkage."""
    torch.manual_seed(0)
    volume, (dual, last) = torch.randn(shape, dtype=dtype), torch.randn(2, 3, *shape, dtype=dtype)
    strength = torch.rand(1, 1, *shape[2:], dtype=dtype)
    return volume, dual, last, Shrinkage(strength, STEPS, nonnegative)


@pytest.mark.pairwise(shape=SHAPES, dtype=ROUNDING)
def test_compiled_steps_match_the_reference_to_rounding(shape, dtype):
    volume, dual, last, shrinkage = problem(shape, dtype, shape[2] > 1)
    stride, limit = Stride(0.3, 0.4), {"rtol": 0, "atol": ROUNDING[dtype]}
    ours, theirs = (m.primal(volume, dual, shrinkage) for m in (cpu, reference))
    torch.testing.assert_close(ours, theirs, rtol=0, atol=4 * ROUNDING[dtype])
    ours, theirs = (m.dual_step(volume, dual.clone(), 0.3, STEPS) for m in (cpu, reference))
    torch.testing.assert_close(ours, theirs, **limit)
    assert torch.linalg.vector_norm(ours, dim=0).max() <= 1 + ROUNDING[dtype]
    ours, theirs = (
        m.proximal_step(volume, dual, last.clone(), stride, shrinkage) for m in (cpu, reference)
    )
    torch.testing.assert_close(ours, theirs, **limit)


def test_scalar_strengths_and_non_contiguous_views_are_supported():
    volume, dual, _, shrinkage = problem((2, 1, 5, 6, 7), torch.float64)
    one = shrinkage._replace(strength=shrinkage.strength[..., :1, :1, :1])
    turned = volume.transpose(3, 4).contiguous().transpose(3, 4)
    ours, theirs = cpu.primal(turned, dual, one), reference.primal(volume, dual, one)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-14)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_compiled_divergence_is_minus_the_transpose_of_the_compiled_gradient(shape):
    """<D x, p> = -<x, div p>, with -D^T p the volume of a field over a volume of zeros, and D x a
    step of a field of zeros that is too short to be cut.
    """
    volume, dual, _, _ = problem(shape, torch.float64)
    rate = 1e-3
    gradient = cpu.dual_step(volume, torch.zeros_like(dual), rate, STEPS) / rate
    one = Shrinkage(torch.ones(1, 1, 1, 1, 1, dtype=torch.float64), STEPS, False)
    divergence = cpu.primal(torch.zeros_like(volume), dual, one)
    assert inner_product_gap(volume, gradient, dual, -divergence) < 1e-12


@pytest.mark.parametrize("dtype", ROUNDING)
def test_every_bit_is_the_same_on_any_number_of_threads(dtype, threads, monkeypatch):
    monkeypatch.setattr("mvrecon.kernels.threads.LEAST", 1)
    volume, dual, last, shrinkage = problem((2, 1, 37, 9, 20), dtype)
    results = []
    for count in (1, 2, 3):
        threads(count)
        volumes = cpu.primal(volume, dual, shrinkage)
        step = cpu.dual_step(volume, dual.clone(), 0.3, STEPS)
        ahead = cpu.proximal_step(volume, dual, last.clone(), Stride(0.3, 0.4), shrinkage)
        results.append((volumes, step, ahead))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_a_dual_field_of_another_volume_is_refused():
    """A dual field of another shape or type of number than its volume's is refused."""
    volume, dual, _, shrinkage = problem((1, 1, 5, 6, 7), torch.float64)
    for wrong in (dual[:2], dual[..., :-1].contiguous(), dual.float(), dual.mT):
        with pytest.raises(ValueError, match="Expected a contiguous dual field"):
            cpu.primal(volume, wrong, shrinkage)
        with pytest.raises(ValueError, match="Expected a contiguous dual field"):
            cpu.dual_step(volume, wrong, 0.3, STEPS)
