"""Learning rates against their formulas."""

import pytest
import torch

from mvrecon.core.parts import OPTIMIZERS
from mvrecon.training.module import build_schedule, lr_factor


def rates(name, steps, **options):
    optimizer = OPTIMIZERS.build("sgd", [torch.zeros(1, requires_grad=True)], lr=2.0, momentum=0.9)
    schedule, found = build_schedule(optimizer, name, steps, **options), []
    for _ in range(steps):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return found


def test_cosine_is_half_at_half_time_and_zero_at_the_end():
    assert lr_factor("cosine", 0, 100, 0.0) == 1
    assert lr_factor("cosine", 50, 100, 0.0) == pytest.approx(0.5)
    assert lr_factor("cosine", 100, 100, 0.0) == pytest.approx(0.0)
    assert lr_factor("cosine", 1000, 100, 0.0) == pytest.approx(0.0)


def test_warm_up_rises_evenly_to_the_top():
    found = rates("cosine", 20, warmup=0.25)
    assert found[:6] == pytest.approx([2 * k / 6 for k in (1, 2, 3, 4, 5, 6)])
    assert all(a > b for a, b in zip(found[5:-1], found[6:], strict=True))


def test_the_constant_schedule_is_constant_and_one_cycle_peaks_at_the_given_rate():
    assert set(rates("constant", 5)) == {2.0}
    found = rates("one_cycle", 20, warmup=0.5)
    assert (
        found[0] == pytest.approx(2 / 25)
        and found[10] == pytest.approx(2.0)
        and found[15] == pytest.approx(1.0)
    )
    assert found[5] == pytest.approx((2 + 2 / 25) / 2) and found[-1] < 0.05


def test_unknown_names_report_the_nearest():
    weights = [torch.zeros(1, requires_grad=True)]
    with pytest.raises(LookupError, match="did you mean 'adamw'"):
        OPTIMIZERS.build("adamww", weights, lr=1.0)
    optimizer = OPTIMIZERS.build("adamw", weights, lr=1.0)
    with pytest.raises(LookupError, match="did you mean 'cosine'"):
        build_schedule(optimizer, "cosin", 10)
    with pytest.raises(ValueError, match="number of steps, got 0"):
        build_schedule(optimizer, "cosine", 0)
    with pytest.raises(ValueError, match=r"\[0, 1\), got 1.5"):
        build_schedule(optimizer, "cosine", 10, warmup=1.5)


def test_schedules_have_plain_state(tmp_path):
    for name in ("cosine", "one_cycle", "constant"):
        optimizer = OPTIMIZERS.build("adamw", [torch.zeros(1, requires_grad=True)], lr=1.0)
        torch.save(build_schedule(optimizer, name, 10, 0.1).state_dict(), tmp_path / "state")
        assert torch.load(tmp_path / "state")["last_epoch"] == 0
