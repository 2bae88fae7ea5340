"""Every built-in method keeps the contract; methods that break it are caught."""

import pytest
import torch

from mvrecon.core.parts import CAMERAS, METHODS, PROJECTORS
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.operator import check_views
from mvrecon.testing import check_method
from tests.methods.learned.rig import SMALL, small_projector, small_rig, stirred

QUICK = {"name": "align", "alternations": 1, "iterations": 2}
OPTIONS = {
    **SMALL,
    **{name: {"iterations": 4} for name in ("fista_tv", "pdhg_tv", "mlem")},
    "aligned": {"method": {"name": "sirt", "iterations": 3}, "correct": QUICK},
    "uncertain": {"method": {"name": "world_unet", **SMALL["world_unet"]}},
}
#: Methods of parallel beams, and methods that name a file.
ELSEWHERE = {"fbp", "trained"}
NAMES = [
    name
    for name in METHODS.names()
    if METHODS.origin(name).startswith("mvrecon.") and name not in ELSEWHERE
]


@pytest.mark.parametrize("name", NAMES)
def test_built_in_methods_keep_the_contract(name):
    check_method(name, small_projector(), **OPTIONS.get(name, {}))


def test_parallel_beams_keep_the_contract_too():
    grid, _ = small_rig()
    cameras = CAMERAS.build("parallel", n_views=4, detector={"pixels": [12, 12], "pixel_mm": 3.0})
    A = PROJECTORS.build("radon", grid=grid, cameras=cameras)
    check_method("fbp", A)
    check_method("cross_view", A, **SMALL["cross_view"])


def test_a_mistyped_option_names_the_nearest_and_all():
    for name, typed, meant in (
        ("cross_view", "suport", "support"),
        ("mean_fusion", "consistancy", "consistency"),
        ("fdk", "cutof", "cutoff"),
        ("sirt", "nonegative", "nonnegative"),
        ("osem", "suport", "support"),
    ):
        with pytest.raises(TypeError, match=f"no option '{typed}'; did you mean '{meant}'"):
            stirred(name, **{typed: 1})


class Sound(torch.nn.Module):
    """A back-projection with a weight."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))

    def volume(self, views, A):
        return self.weight * A.T(views)

    def forward(self, views, A):
        check_views(views, A.cameras)
        return Reconstruction(self.volume(views, A))


class Idle(Sound):
    """A parameter that nothing depends on."""

    def __init__(self):
        super().__init__()
        self.spare = torch.nn.Parameter(torch.ones(1))


class Lenient(Sound):
    """Takes whatever its operator takes."""

    def forward(self, views, A):
        return Reconstruction(self.volume(views.nan_to_num(0.0, 0.0, 0.0), A))


class Remembering(Sound):
    """Keeps the first operator that it meets."""

    def volume(self, views, A):
        self.A = getattr(self, "A", A)
        return super().volume(views, self.A) * (1 + 0.1 * (self.A is not A))


#: A change of the volumes of a sound method, and the message about it.
BROKEN = {
    "shape": (lambda x: x[..., 1:], "the volume is .*, expected"),
    "dtype": (lambda x: x.float(), "float64 views is torch.float32"),
    "NaN": (lambda x: x.where(x < x.max(), torch.nan), "not finite"),
    "random": (lambda x: x * torch.rand(1), "same bits"),
    "square": (lambda x: x**2, r"f\(.* y\) is not .* f\(y\)"),
    "offset": (lambda x: x + (x.abs().sum() == 0), "views of zero"),
    "order": (
        lambda x: x * torch.arange(1, 1 + len(x)).reshape(-1, 1, 1, 1, 1),
        "order of a batch",
    ),
    "mean": (lambda x: x + x.mean(dim=0), "others of its batch"),
    "detached": (lambda x: x.detach().requires_grad_(), "no gradient reaches weight"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_method_that_breaks_its_contract_is_caught(name, monkeypatch):
    change, message = BROKEN[name]
    monkeypatch.setattr(Sound, "volume", lambda self, views, A: change(self.weight * A.T(views)))
    monkeypatch.setitem(METHODS._parts, "broken", Sound)
    with pytest.raises(AssertionError, match=message):
        check_method("broken", small_projector())


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (Idle, "no gradient reaches spare"),
        (Lenient, "views with NaN are not refused"),
        (Remembering, "a batch of operators"),
        (lambda A, views: 0 * A.T(views), "no better than zero"),
    ],
)
def test_other_contract_violations_are_caught(part, message, monkeypatch):
    monkeypatch.setitem(METHODS._parts, "sound", Sound)
    check_method("sound", small_projector())
    monkeypatch.setitem(METHODS._parts, "broken", part)
    with pytest.raises(AssertionError, match=message):
        check_method("broken", small_projector())
