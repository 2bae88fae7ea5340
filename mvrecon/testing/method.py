"""Checks that every learned method must pass."""

from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.method import build_method
from mvrecon.models.output import Reconstruction
from mvrecon.projectors.operator import Projector
from mvrecon.testing.projector import close

#: Relative, of float32 sums of some thousand products a voxel.
TOLERANCE = 1e-5


def check_method(name: str, A: Projector, seed: int = 0, **options: Any) -> None:
    """Raise AssertionError unless the named method keeps its promises for views of this operator.

    A finite volume of the grid's shape and of the views' dtype, the same bits when it is called
    twice; a multiple of the views gives that multiple of the volume, views of zero a volume of
    zero; a sample's volume depends neither on the other samples of its batch nor on their order;
    gradients of the volume reach every parameter; views of another shape, or with a value that is
    not finite, are refused by a ValueError that names the views. All of this with random weights,
    so that layers that start at zero take part.

    Args:
        name: of the method.
        A: the operator; at least two cameras.
        seed: of weights and volumes.
        options: of the method.
    """
    torch.manual_seed(seed)
    module = build_method({"name": name, **options}).eval()
    method = partial(module, A=A)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
        views = A(torch.rand(2, 1, *A.grid.shape))
        _check_volume(method, views, A.grid.shape)
        _check_scale(method, views)
        _check_batch(method, views)
        check_refusals(method, views)
    check_gradients(module, method(views).volume)


def _check_volume(
    method: Callable[[Tensor], Reconstruction],
    views: Float[Tensor, "2 1 m v u"],
    shape: tuple[int, ...],
) -> None:
    out = method(views)
    assert isinstance(out, Reconstruction), f"expected a Reconstruction, got {type(out).__name__}"
    expected = (2, 1, *shape)
    assert out.volume.shape == expected, (
        f"the volume is {tuple(out.volume.shape)}, expected {expected}"
    )
    assert out.volume.dtype == views.dtype, (
        f"the volume of {views.dtype} views is {out.volume.dtype}"
    )
    assert out.volume.isfinite().all(), "the volume is not finite"
    assert torch.equal(method(views).volume, out.volume), "not the same bits when called twice"


def _check_scale(
    method: Callable[[Tensor], Reconstruction], views: Float[Tensor, "2 1 m v u"]
) -> None:
    volume = method(views).volume
    for factor in (2.0**-10, 2.0**10):
        multiple = method(factor * views).volume
        assert close(multiple / factor, volume, TOLERANCE), f"f({factor} y) is not {factor} f(y)"
    assert not method(torch.zeros_like(views)).volume.any(), (
        "views of zero do not give a volume of zero"
    )


def _check_batch(
    method: Callable[[Tensor], Reconstruction], views: Float[Tensor, "2 1 m v u"]
) -> None:
    volume = method(views).volume
    assert close(method(views.flip(0)).volume.flip(0), volume, TOLERANCE), (
        "the order of a batch changes its volumes"
    )
    assert close(method(views[1:]).volume, volume[1:], TOLERANCE), (
        "a volume depends on the others of its batch"
    )


def check_gradients(network: nn.Module, answer: Tensor) -> None:
    """Raise AssertionError unless gradients of an answer reach every parameter, and are finite."""
    parameters = {
        name: p for name, p in network.named_parameters() if p.requires_grad and p.numel()
    }
    if not parameters:
        return
    values = torch.autograd.grad(
        answer.square().sum(), list(parameters.values()), allow_unused=True
    )
    gradients = dict(zip(parameters, values, strict=True))
    idle = [name for name, value in gradients.items() if value is None or not value.any()]
    assert not idle, f"no gradient reaches {', '.join(idle)}"
    bad = [name for name, value in gradients.items() if not value.isfinite().all()]
    assert not bad, f"gradients are not finite: {', '.join(bad)}"


def check_refusals(
    method: Callable[[Tensor], Any],
    views: Float[Tensor, "2 1 m v u"],
    only: Collection[str] | None = None,
) -> None:
    """Raise AssertionError unless a method refuses spoiled views by a ValueError that speaks of
    views.

    Args:
        method: called with the views.
        views: good ones.
        only: the kinds of spoiled views that are tried; None: all.
    """
    spoiled = {"NaN": views.clone(), "inf": views.clone()}
    for value, copy in spoiled.items():
        copy[0, 0, 1, 0, 0] = float(value)
    shapes = {
        "no batch": views[0],
        "no channel": views[:, 0],
        "a camera less": views[:, :, 1:],
        "a camera more": torch.cat([views, views[:, :, :1]], dim=2),
        "a row less": views[..., 1:, :],
        "a column less": views[..., 1:],
    }
    for what, bad in {**spoiled, **shapes}.items():
        if only is not None and what not in only:
            continue
        try:
            method(bad)
        except ValueError as error:
            assert "views" in str(error).lower(), (
                f"views with {what}: the error does not speak of views: {error}"
            )
        except Exception as error:
            raise AssertionError(
                f"views with {what}: expected a ValueError, got {error!r}"
            ) from error
        else:
            raise AssertionError(f"views with {what} are not refused")
