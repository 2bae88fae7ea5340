"""What a training's step keeps is told before the first, and refused where it cannot fit."""

import pytest
from mvrecon.engine.training_memory import check_training, step_bytes

from mvrecon.config import compose
from mvrecon.engine import fit, training_memory


@pytest.fixture(scope="module")
def module():
    """The smoke run's model on a grid of 24^3."""
    settings = compose("experiment=smoke", "grid={size: [24, 24, 24], spacing: 5.0}")
    return fit.build_module(settings, settings["model"], 1.0)


def test_a_coarse_grid_tells_what_the_grid_itself_would(module):
    exact = step_bytes(module, 1, edge=24)
    assert step_bytes(module, 1, edge=12) == pytest.approx(exact, rel=0.35)
    weights = 16 * sum(p.numel() for p in module.model.parameters())
    kept = [step_bytes(module, count, edge=12) - weights for count in (1, 3)]
    assert kept[1] == pytest.approx(3 * kept[0], rel=0.02)


def test_what_cannot_fit_is_refused_with_both_numbers(module, monkeypatch: pytest.MonkeyPatch):
    assert check_training(module, 1, "cpu") is None
    monkeypatch.setattr(training_memory, "SMALL", 0)
    assert check_training(module, 1, "cpu") == pytest.approx(step_bytes(module, 1), rel=0.02)
    monkeypatch.setattr(training_memory, "memory_at_hand", lambda: 2**20)
    with pytest.raises(ValueError, match=r"needs about .* GiB of memory; 0\.0 GiB are at hand: ta"):
        check_training(module, 1, "cpu")
