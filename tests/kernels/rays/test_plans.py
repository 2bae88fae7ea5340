"""Plans of small scenes are cached by their dependencies; results equal those of new plans."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from mvrecon.geometry.cameras.rigs import circular, dome
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays.cpu import plan
from mvrecon.kernels.rays.cpu.operators import backproject, project
from mvrecon.kernels.rays.lines import lines_of
from mvrecon.kernels.rays.occupancy import Occupancy

SHAPE, DETECTOR = (10, 11, 12), (9, 10)
PIXELS = {"pixels": [9, 10], "pixel_mm": 2.0}
GRID = Grid.centred(shape=SHAPE, spacing=1.0)
LINES = {
    "circular": lines_of(circular(4, 40.0, 70.0, PIXELS, start_degrees=13.0), GRID),
    "dome": lines_of(dome(4, 40.0, 70.0, 50.0, PIXELS), GRID),
}


@pytest.fixture(autouse=True)
def empty():
    """No plan is kept before a test."""
    plan.kept_plan.cache_clear()


def scene(lines: torch.Tensor, method: str = "joseph") -> plan.Scene:
    return plan.Scene(lines, [0.0, 1.0], DETECTOR, method)


def plan_of(lines: torch.Tensor, method: str = "joseph", volumes: int = 1, part=None) -> plan.Plan:
    return plan.plan_of(scene(lines, method), part or Occupancy.whole(SHAPE), volumes, 4)


def test_a_plan_depends_on_the_content_of_lines():
    """A copy of the lines has the same plan; lines that were written to have another."""
    lines = LINES["circular"].clone()
    first = plan_of(lines)
    assert plan_of(lines.clone()) is first
    lines[0, 0, 0, 0] += 1e-9
    second = plan_of(lines)
    assert second is not first
    assert second.rig.lines[0, 0, 0, 0] == lines[0, 0, 0, 0] != first.rig.lines[0, 0, 0, 0]


def test_a_plan_is_keyed_by_everything_it_depends_on(monkeypatch):
    """Method, volumes side by side, the part of the volume and the size of pieces make others."""
    lines, box = LINES["dome"], Occupancy.whole(SHAPE).box
    part = Occupancy(SHAPE, type(box)((1, 1, 1), (5, 6, 7)))
    plans = [plan_of(lines), plan_of(lines, "siddon"), plan_of(lines, volumes=3)]
    plans += [plan_of(lines, part=part)]
    monkeypatch.setattr(plan, "BUDGET", 1)
    plans += [plan_of(lines)]
    assert len({id(one) for one in plans}) == 5
    assert [len(one.pieces) for one in plans] == [1, 1, 1, 1, 2]


@pytest.mark.parametrize("method", ["joseph", "siddon", "trilinear:20"])
@pytest.mark.parametrize("kind", LINES)
def test_cached_plans_change_no_bit(kind, method, monkeypatch):
    """Views and volumes by a plan that was kept, by one that is, and without."""
    x = torch.rand(2, *SHAPE, generator=torch.Generator().manual_seed(0))

    def results() -> list[torch.Tensor]:
        views = project(x, LINES[kind], [0.0, 1.0], DETECTOR, method)
        return [views, backproject(views, LINES[kind], [0.0, 1.0], SHAPE, method)]

    made, kept = results(), results()
    assert plan.kept_plan.cache_info().hits == 3
    monkeypatch.setattr(plan, "kept_plan", plan.plan_by_content)
    for one, two, three in zip(made, kept, results(), strict=True):
        assert torch.equal(one, two) and torch.equal(one, three)


def test_plans_are_few_and_small(monkeypatch):
    """No more plans than `PLANS`, and none of many rays or of bricks."""
    for step in range(plan.PLANS + 3):
        plan_of(LINES["dome"] * (1 + step))
    assert plan.kept_plan.cache_info().currsize == plan.PLANS
    before = plan.kept_plan.cache_info().misses
    monkeypatch.setattr(plan, "SMALL", 4)
    assert plan_of(LINES["dome"]) is not plan_of(LINES["dome"])
    assert plan.kept_plan.cache_info().misses == before


def test_threads_share_plans():
    """Many threads that ask at once get equal plans, and one of them from then on."""
    with ThreadPoolExecutor(8) as pool:
        plans = list(pool.map(lambda _: plan_of(LINES["circular"]), range(64)))
    assert len({tuple(one.oblique) + tuple(one.upright.views) for one in plans}) == 1
    assert plan_of(LINES["circular"]) is plan_of(LINES["circular"])
