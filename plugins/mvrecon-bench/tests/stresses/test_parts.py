"""Parts unknown to the plan: the options they are built with, and the reasons reported if these do
not suffice.
"""

from dataclasses import replace

import pytest
import torch

from mvrecon.core.parts import CAMERAS, HEADS, METHODS, PROJECTORS, SCENES
from mvrecon.data.scenes.phantoms import RandomEllipsoids
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.operators.drr import Drr
from mvrecon.operators.operator import Wrapped
from mvrecon_bench.stresses import plan
from mvrecon_bench.stresses.case import DoesNotApply
from mvrecon_bench.stresses.subjects import subject_of
from mvrecon_bench.stresses.verdict import FAIL, LEFT_OUT, judge

DETECTOR = {"pixels": 4, "pixel_mm": 2.0}


def helix(pitch_mm: float, n_views: int):
    """A camera with an option of an unknown name."""
    return circular(n_views, 40.0 + pitch_mm, 70.0, DETECTOR)


def many(n_views: int, detector):
    """A camera that refuses a small number of views."""
    if n_views < 5:
        raise ValueError(f"n_views must be at least 5, got {n_views}")
    return circular(n_views, 40.0, 70.0, detector)


def unsteady(n_views: int):
    """A camera that breaks its contract."""
    return circular(n_views, 40.0 + float(torch.rand(())), 70.0, DETECTOR)


@pytest.fixture
def plugin(monkeypatch):
    for part in (helix, many, unsteady):
        monkeypatch.setitem(CAMERAS._parts, part.__name__, part)


def verdicts(name, **options):
    subject = subject_of("camera", name, options, "cpu", torch.float64)
    return {case.name: judge(case, subject) for case, _ in plan.jobs([subject])}


@pytest.mark.parametrize(("name", "note"), [("helix", "it needs pitch_mm"), ("many", "at least 5")])
def test_a_camera_that_needs_other_options_is_skipped_with_the_reason(plugin, name, note):
    rows = verdicts(name)
    assert rows and all(row["verdict"] == LEFT_OUT and note in row["note"] for row in rows.values())


@pytest.mark.parametrize(
    ("name", "options"), [("helix", {"pitch_mm": 2.0}), ("many", {"n_views": 6})]
)
def test_a_camera_with_user_options_is_measured(plugin, name, options):
    assert all(row["verdict"] != LEFT_OUT for row in verdicts(name, **options).values())


def test_a_camera_that_breaks_its_contract_fails(plugin):
    assert "differs from call to call" in verdicts("unsteady")["check_camera"]["note"]


def test_invalid_user_options_are_a_failure(plugin):
    assert verdicts("many", n_views=3, detector=DETECTOR)["Cameras far away"]["verdict"] == FAIL


class OfAnAtlas(torch.nn.Module):
    """A method with a required option of its own."""

    def __init__(self, atlas):
        super().__init__()


def test_a_method_that_needs_other_options_is_skipped(monkeypatch):
    monkeypatch.setitem(METHODS._parts, "mine", OfAnAtlas)
    with pytest.raises(DoesNotApply, match="it needs atlas"):
        subject_of("method", "mine", {}, "cpu", torch.float32).method()


class Fussy(Drr):
    """A projector that refuses cameras of one pixel, and whose adjoint is twice one."""

    matched = False

    def __init__(self, grid, cameras):
        if cameras.shape == (1, 1):
            raise ValueError("takes more than one pixel")
        super().__init__(grid, cameras)

    def adjoint(self, views):
        return 2 * super().adjoint(views)


def judged(name, case):
    subject = subject_of("projector", name, {}, "cpu", torch.float32)
    return next(
        judge(candidate, subject) for candidate, _ in plan.jobs([subject]) if candidate.name == case
    )


@pytest.mark.parametrize(
    ("case", "note"),
    [
        ("Rays through corners, permuted axes", "refuses: takes more"),
        ("The adjoint in twenty geometries", "transpose"),
    ],
)
def test_plugins_may_opt_out_of_cases_and_mvrecon_may_not(monkeypatch, case, note):
    monkeypatch.setitem(PROJECTORS._parts, "fussy", Fussy)
    row = judged("fussy", case)
    assert row["verdict"] == LEFT_OUT and note in row["note"]
    assert judged("fussy", "Linearity, zero")["verdict"] == "pass"
    monkeypatch.setattr(Fussy, "__module__", "mvrecon.fussy")
    assert judged("fussy", case)["verdict"] == FAIL


class Blurring(Wrapped):
    """Line integrals that a detector blurs along its columns, a quarter of each pixel upwards and
    downwards, with its adjoint.
    """

    pixelwise = False

    def __init__(self, grid, cameras):
        super().__init__(Drr(grid, cameras))

    def forward(self, x):
        return self._blurred(self.A(x))

    def adjoint(self, y):
        return self.A.T(self._blurred(y.float() if y.dtype.itemsize < 4 else y))

    @staticmethod
    def _blurred(y):
        above, below = torch.zeros_like(y), torch.zeros_like(y)
        above[..., 1:, :], below[..., :-1, :] = y[..., :-1, :], y[..., 1:, :]
        return 0.25 * above + 0.5 * y + 0.25 * below


class Unsaid(Blurring):
    """The same, without a word of it."""

    pixelwise = True


def test_a_blurring_projector_passes_the_plan_if_declared(monkeypatch):
    """Without the word it fails where a detector is taken apart, and at a letter's edges."""
    monkeypatch.setitem(PROJECTORS._parts, "blurring", Blurring)
    monkeypatch.setitem(PROJECTORS._parts, "unsaid", Unsaid)
    apart = {"A large detector", "A detector inside the volume, in tiles"}
    apart |= {"The letter F from six sides, each way up"}
    for name, expected in (("blurring", LEFT_OUT), ("unsaid", FAIL)):
        subject = subject_of("projector", name, {}, "cpu", torch.float64)
        cases = [case for case, _ in plan.jobs([subject], (8, 20, 28)) if case.name in apart]
        assert [judge(case, subject)["verdict"] for case in cases] == [expected] * 3


class Drifting(RandomEllipsoids):
    """A scene that keeps count of its cases, and draws from torch's own series."""

    def __init__(self):
        super().__init__()
        self.calls = 0

    def sample(self, *arguments):
        self.calls += 1
        case = super().sample(*arguments)
        return replace(case, volume=case.volume * (1 - 1e-3 * self.calls * float(torch.rand(()))))


class Dimming(RandomEllipsoids):
    """A scene whose views grow dim with the number of cameras, and whose finer object is denser."""

    def sample(self, index, seed, grid, cameras):
        case = super().sample(index, seed, grid, cameras)
        return replace(case, views=case.views * (1 - 0.01 * len(cameras)))

    def finer(self, index, seed, grid, cameras, factor):
        return 2 * self.sample(index, seed, grid.refined(factor), cameras).volume


def test_an_impure_scene_fails_and_one_that_needs_a_file_is_skipped(monkeypatch):
    for scene in (Drifting, Dimming):
        monkeypatch.setitem(SCENES._parts, scene.__name__, scene)

    def failed(name):
        subject = subject_of("scene", name, {}, "cpu", torch.float32)
        rows = [judge(case, subject) for case, _ in plan.jobs([subject])]
        return {row["case"] for row in rows if row["verdict"] == FAIL}, rows

    assert failed("Drifting")[0] >= {
        "Cases in any order",
        "A case on 1, 2 and 3 threads",
        "Global random generators",
        "Contract of a scene",
    }
    assert failed("Dimming")[0] == {"Views of single cameras", "The object on a finer grid"}
    _, rows = failed("volumes")
    assert all(row["verdict"] == LEFT_OUT and "it needs path" in row["note"] for row in rows)


class Bounded(torch.nn.Module):
    """A head that bounds its logits: infinite ones have a finite density."""

    keeps_views = False

    def forward(self, logits, prior, views, frusta):
        return prior.clamp_min(0) * logits.clamp(-3, 3).exp() * frusta.occupied


class Hiding(Bounded):
    """A head that hides a network's NaN."""

    def forward(self, logits, *given):
        return super().forward(logits.nan_to_num(), *given)


class Spreading(Bounded):
    """A head that subtracts the mean of all logits, infinite ones included."""

    def forward(self, logits, *given):
        return super().forward(logits - logits.mean(), *given)


@pytest.mark.parametrize(
    ("head", "verdict", "note"),
    [
        (Bounded, "pass", ""),
        (Hiding, FAIL, "1 of 6: logit nan, its own ray: a finite density"),
        (Spreading, FAIL, "logit nan, other rays: "),
    ],
)
def test_a_head_may_bound_logits_but_not_hide_or_spread_a_nan(monkeypatch, head, verdict, note):
    monkeypatch.setitem(HEADS._parts, "mine", head)
    subject = subject_of("head", "mine", {}, "cpu", torch.float32)
    (row,) = (judge(case, subject) for case, _ in plan.jobs([subject], (47,)))
    assert row["verdict"] == verdict and note in row["note"]
