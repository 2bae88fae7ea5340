"""A method, head or weighting network that breaks its contract is caught, with the reason."""

import pytest
import torch
from torch import nn

from mvrecon.core.parts import HEADS, METHODS, WEIGHTINGS
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.checks import check_views
from mvrecon.testing import check_head, check_method, check_weighting
from tests.methods.learned.rig import small_projector, small_rig


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
    "shape": (lambda x: x[..., 1:], "of broken a volume"),
    "dtype": (lambda x: x.float(), "float64 views is torch.float32"),
    "NaN": (lambda x: x.where(x < x.max(), torch.nan), "not finite"),
    "random": (lambda x: x * torch.rand(1), "same bits"),
    "square": (lambda x: x**2, r"f\(.* y\) is not .* f\(y\)"),
    "offset": (lambda x: x + (x.abs().sum() == 0), "views of zero"),
    "order": (
        lambda x: x * torch.arange(1, 1 + len(x)).reshape(-1, 1, 1, 1, 1),
        "others of its batch",
    ),
    "mean": (lambda x: x + x.mean(dim=0), "others of its batch"),
    "detached": (lambda x: x.detach().requires_grad_(), "no gradient reaches weight"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_method_that_breaks_its_contract_is_caught(name, monkeypatch):
    change, message = BROKEN[name]
    monkeypatch.setattr(Sound, "volume", lambda self, views, A: change(self.weight * A.T(views)))
    monkeypatch.setitem(METHODS._parts, "broken", Sound)
    with pytest.raises((AssertionError, ValueError), match=message):
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


class Spread(nn.Module):
    """A head that divides by the length of a ray in the region, which may be zero."""

    keeps_views = True

    def forward(self, logits, prior, views, frusta):
        return (views / frusta.chord[:, 0, 0]).transpose(1, 2)[:, :, :, None] * frusta.occupied


class Rooted(nn.Module):
    """A head whose density is finite, but not its gradient where the prior is zero."""

    keeps_views = False

    def forward(self, logits, prior, views, frusta):
        return (prior * logits.exp()).sqrt() * frusta.occupied


class Undeclared(Spread):
    keeps_views = None


@pytest.mark.parametrize(
    ("head", "why"),
    [
        (Spread, "density is not finite"),
        (Rooted, "gradient is not finite"),
        (Undeclared, "must define keeps_views, .* got None from Undeclared"),
        (lambda: torch.relu, "must be a torch.nn.Module, got builtin"),
    ],
)
def test_a_head_without_the_contract_is_refused_with_the_reason(head, why: str, monkeypatch):
    monkeypatch.setattr(HEADS, "_parts", {"wrong": head})
    frusta = Frusta.of(*small_rig(pixels=4), depth=12)
    assert (frusta.chord > 0).all()  # the check itself makes rays miss
    with pytest.raises(AssertionError, match=why):
        check_head("wrong", frusta)


class Plain(nn.Module):
    """A sound weighting network; each case breaks one law of its logits."""

    def __init__(self, inputs):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(inputs))

    def forward(self, inputs, visible):
        return (inputs * self.weight[:, None, None, None]).sum(dim=2, keepdim=True)


class SixChannels(Plain):
    """Needs the confidence, which a model without a depth network lacks."""

    def __init__(self, inputs):
        super().__init__(6)


class Spare(Plain):
    def __init__(self, inputs):
        super().__init__(inputs)
        self.spare = nn.Parameter(torch.ones(1))


#: A change of a sound network's logits, and the message about it.
LOGITS = {
    "tensor": (lambda x, seen: [x], "return logits as a tensor, got list"),
    "broadcast": (lambda x, seen: x.mean(dim=(3, 4, 5), keepdim=True), "logits are .*, expected"),
    "no camera": (lambda x, seen: x[:, 0], "logits are .*, expected"),
    "dtype": (lambda x, seen: x.float(), "torch.float64 inputs are torch.float32"),
    "mask": (lambda x, seen: x.masked_fill(~seen, -torch.inf), "logits are not finite"),
    "random": (lambda x, seen: x * torch.rand(1), "same bits"),
    "batch": (lambda x, seen: x - x.mean(dim=0), "other samples"),
    "first": (lambda x, seen: x - x[:, :1], "cameras' order"),
    "number": (
        lambda x, seen: x * torch.arange(x.shape[1]).reshape(-1, 1, 1, 1, 1),
        "cameras' order",
    ),
    "ratio": (lambda x, seen: x / x.abs().amax(dim=1, keepdim=True), "zero inputs are not finite"),
    "root": (lambda x, seen: x.square().sqrt(), "gradient is not finite"),
    "detached": (lambda x, seen: x.detach().requires_grad_(), "no gradient reaches weight"),
}


@pytest.mark.parametrize("name", LOGITS)
def test_a_weighting_network_that_breaks_its_contract_is_caught(name, monkeypatch):
    change, message = LOGITS[name]
    own = Plain.forward
    monkeypatch.setitem(WEIGHTINGS._parts, "broken", Plain)
    check_weighting("broken")
    monkeypatch.setattr(
        Plain, "forward", lambda self, inputs, seen: change(own(self, inputs, seen), seen)
    )
    with pytest.raises(AssertionError, match=message):
        check_weighting("broken")


@pytest.mark.parametrize(
    ("part", "error", "message"),
    [
        (Spare, AssertionError, "no gradient reaches spare"),
        (lambda inputs: torch.relu, AssertionError, "must be a torch.nn.Module, got builtin"),
        (SixChannels, RuntimeError, "must match"),
    ],
)
def test_other_weighting_networks_are_refused(part, error, message, monkeypatch):
    monkeypatch.setitem(WEIGHTINGS._parts, "broken", part)
    with pytest.raises(error, match=message):
        check_weighting("broken")
