"""Every built-in model keeps the contract; models that break it are caught."""

import pytest
import torch

from mvrecon.models.output import Reconstruction
from mvrecon.parts import MODELS
from mvrecon.projectors.checks import check_views
from mvrecon.testing import check_model
from tests.models.rig import small_projector
from tests.models.test_single_pass import OPTIONS


@pytest.mark.parametrize(
    "name", [name for name in MODELS.names() if MODELS.origin(name).startswith("mvrecon.")]
)
def test_built_in_models_keep_the_contract(name):
    check_model(name, small_projector(), **OPTIONS.get(name, {}))


class Sound(torch.nn.Module):
    """A back-projection with a weight."""

    def __init__(self, projector):
        super().__init__()
        self.projector, self.weight = projector, torch.nn.Parameter(torch.ones(1))

    def volume(self, views):
        return self.weight * self.projector.T(views)

    def forward(self, views):
        check_views(views, self.projector.cameras)
        return Reconstruction(self.volume(views))


class Idle(Sound):
    """A parameter that nothing depends on."""

    def __init__(self, projector):
        super().__init__(projector)
        self.spare = torch.nn.Parameter(torch.ones(1))


class Lenient(Sound):
    """Takes whatever its projector takes."""

    def forward(self, views):
        return Reconstruction(self.volume(views.nan_to_num(0.0, 0.0, 0.0)))


#: What is done to the volumes of a sound model, and what is told.
BROKEN = {
    "shape": (lambda x: x[..., 1:], "the volume is .*, expected"),
    "dtype": (lambda x: x.double(), "float32 views is torch.float64"),
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
def test_a_model_that_breaks_its_contract_is_caught(name, monkeypatch):
    change, message = BROKEN[name]
    monkeypatch.setattr(
        Sound, "volume", lambda self, views: change(self.weight * self.projector.T(views))
    )
    monkeypatch.setitem(MODELS._parts, "broken", Sound)
    with pytest.raises(AssertionError, match=message):
        check_model("broken", small_projector())


@pytest.mark.parametrize(
    ("part", "message"),
    [(Idle, "no gradient reaches spare"), (Lenient, "views with NaN are not refused")],
)
def test_an_idle_parameter_and_bad_views_let_in_are_caught(part, message, monkeypatch):
    monkeypatch.setitem(MODELS._parts, "sound", Sound)
    check_model("sound", small_projector())
    monkeypatch.setitem(MODELS._parts, "broken", part)
    with pytest.raises(AssertionError, match=message):
        check_model("broken", small_projector())
