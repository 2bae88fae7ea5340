"""Methods: few cameras, duplicate cameras, zero views, views of any scale, batches, autocast,
gradients, weights.
"""

import inspect
import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mvrecon.core.parts import METHODS
from mvrecon.methods.method import Reconstruction
from mvrecon.testing.measures import bits, gap, greatest, homogeneity_gap
from mvrecon.training.losses import ReconstructionLoss
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.learned_subjects import MethodSubject, small_rig
from mvrecon_bench.stresses.refusals import none_of, refusal

SINGLE = (torch.float32,)
#: Networks sum some thousand products per voxel, in an order that depends on the batch.
NETWORK = {torch.float64: 1e-10, torch.float32: 1e-5}


def bad_numbers(*tensors: Tensor | None) -> int:
    """Number of non-finite values."""
    return sum(int((~tensor.isfinite()).sum()) for tensor in tensors if tensor is not None)


def answers(out: Reconstruction) -> list[Tensor]:
    """All volumes and views of a reconstruction."""
    outputs = (out.volume, out.per_view, out.weights, out.predictions, out.sigma)
    return [output for output in outputs if output is not None]


def copies(subject: MethodSubject) -> float:
    """Three copies of one camera with initial weights: the same volume as with one camera."""
    subject.need_module()
    one, views, method = small_rig()[[0]], subject.views[:, :, :1], subject.method()
    with torch.no_grad():
        single = subject.accepts(method, views, subject.operator(one))
        rig = subject.operator(one[[0, 0, 0]])
        triple = subject.accepts(method, views.expand(-1, -1, 3, -1, -1), rig)
        return gap(triple.volume, single.volume)


def one_camera(subject: MethodSubject) -> float:
    """A rig of a single camera."""
    method = subject.stirred()
    out = subject.accepts(method, subject.views[:1, :, :1], subject.operator(small_rig()[[0]]))
    return bad_numbers(*answers(out), *slopes(method, out).values())


def slopes(method: Any, out: Reconstruction) -> dict[str, Tensor | None]:
    """Gradients of the sum of squares of volume and sigma with respect to all trainable
    parameters.
    """
    named = {name: weight for name, weight in method.named_parameters() if weight.requires_grad}
    if not named:
        return {}
    squares = out.volume.square().sum() + (0 if out.sigma is None else out.sigma.square().sum())
    gradients = torch.autograd.grad(squares, list(named.values()), allow_unused=True)
    return dict(zip(named, gradients, strict=True))


def nothing(subject: MethodSubject) -> float:
    """Zero views, alone or in a batch with another sample: finite, and zero for scale-equivariant
    methods.
    """
    views = (
        subject.views[:2] * torch.tensor([0.0, 1.0]).to(subject.views)[:, None, None, None, None]
    )
    violations = 0
    for batch in (views, views[:1]):
        out = subject.used(batch)
        violations += bad_numbers(*answers(out), *slopes(subject.used.func, out).values())
        violations += int(out.volume[0].count_nonzero()) if subject.scales else 0
    return violations


def any_scale(subject: MethodSubject) -> float:
    """Views scaled by 2^-100 (1e-30) to 2^40 (1e12): the volume scales equally, or is finite for
    methods that are not scale-equivariant.
    """
    subject.need_module()
    views, factors = subject.views[:1], [2.0**power for power in (-100, -60, 40)]
    with torch.no_grad():
        if subject.scales:
            return homogeneity_gap(lambda y: subject.used(y).volume, views, factors=factors)
        return sum(bad_numbers(subject.used(c * views).volume) for c in factors)


def negative_views(subject: MethodSubject) -> float:
    """Number of non-finite values for views of zero-mean noise, and for negative views."""
    subject.need_module()
    violations = 0
    for views in (subject.views[:1] - subject.views[:1].mean(), -1 - subject.views[:1]):
        out = subject.used(views)
        violations += bad_numbers(*answers(out), *slopes(subject.used.func, out).values())
    return violations


def bad_views(subject: MethodSubject) -> float:
    """Views that are not finite, or of a shape that is not the rig's."""
    views, m = subject.views[:1], subject.views.shape[2]
    shapes = {
        "no batch": views[0],
        "no channel": views[:, 0],
        "a camera less": views[:, :, : m - 1],
        "a camera more": torch.cat([views, views[:, :, :1]], dim=2),
        "a column less": views[..., :-1],
        "rows for columns": views.mT,
    }
    refusals = {
        name: refusal(partial(subject.used, bad), "(?i)views.*got.*[0-9]")
        for name, bad in shapes.items()
    }
    for bad in (math.nan, math.inf, -math.inf):
        spoilt = views.clone()
        spoilt[0, 0, 1, 2, 3] = bad
        refusals[f"a pixel of {bad}"] = refusal(partial(subject.used, spoilt), "(?i)views.*finite")
    return none_of(refusals)


def batches(subject: MethodSubject) -> float:
    """A batch of three samples with three cameras: the same volumes as for each sample
    separately.
    """
    with torch.no_grad():
        every = answers(subject.used(subject.views))
        alone = zip(*[answers(subject.used(one)) for one in subject.views.split(1)], strict=True)
        return greatest(gap(a, torch.cat(b)) for a, b in zip(every, alone, strict=True))


def not_contiguous(subject: MethodSubject) -> float:
    """Views that are transposed or slices of a larger tensor: the same volume as for a contiguous
    copy.
    """
    views = subject.views[:1]
    larger = torch.zeros(
        *views.shape[:-1], 2 * views.shape[-1], dtype=views.dtype, device=views.device
    )
    larger[..., 1::2] = views
    with torch.no_grad():
        volume = subject.used(views).volume
        return sum(
            bits(subject.used(other).volume, volume)
            for other in (views.mT.contiguous().mT, larger[..., 1::2])
        )


def autocast(subject: MethodSubject) -> float:
    """The method under autocast to bfloat16: float32 outputs, and their difference from those
    without autocast.
    """
    dtypes = []
    hook = subject.A.register_forward_hook(lambda _A, _volume, views: dtypes.append(views.dtype))
    with torch.no_grad(), hook:
        volume = subject.used(subject.views[:1]).volume
        with torch.autocast(subject.device.split(":")[0], torch.bfloat16):
            result = subject.used(subject.views[:1]).volume
    assert {result.dtype, *dtypes} == {torch.float32}, (
        f"expected float32 alone, got {result.dtype} and {set(dtypes)}"
    )
    return gap(result, volume)


def gradients(subject: MethodSubject) -> float:
    """Number of parameters whose gradient of the loss is missing, zero or not finite."""
    method = subject.stirred().train()
    named = {name: weight for name, weight in method.named_parameters() if weight.requires_grad}
    if not named:
        raise DoesNotApply("it has nothing to train")
    out = method(subject.views[:2], subject.A)
    loss = ReconstructionLoss(1.0, per_view_gain=0.1, cross_view=0.01, uncertainty=0.01)(
        out, {"volume": subject.truth[:2], "views": subject.views[:2]}
    )["total"]
    slopes_of = dict(
        zip(named, torch.autograd.grad(loss, list(named.values()), allow_unused=True), strict=True)
    )
    faults = {name: _fault(weight) for name, weight in slopes_of.items()}
    return none_of(faults)


def _fault(gradient: Tensor | None) -> str:
    if gradient is None:
        return "no gradient"
    return "not finite" if bad_numbers(gradient) else "" if gradient.any() else "zero"


def empty_scene(subject: MethodSubject) -> float:
    """A support computed from zero views: finite volumes, zero outside the support."""
    subject.need_module()
    if "support" not in inspect.signature(METHODS.get(subject.name)).parameters:
        raise DoesNotApply("it has no option 'support'")
    return none_of(dict(_empty(subject)))


def _empty(subject: MethodSubject) -> Iterator[tuple[str, str]]:
    views = torch.zeros_like(subject.views[:1])
    both = torch.cat([views, subject.views[1:2]])
    for support, batch in (("hull", views), ("hull", both), ("box", views), ("auto", both)):
        method, name = subject.stirred(support=support), f"{support}, {len(batch)} samples"
        out = method(batch, subject.A)
        violations = bad_numbers(*answers(out), *slopes(method, out).values())
        yield name, f"{violations} not finite" if violations else ""
        if out.support is not None:
            yield f"{name}, outside", "not zero" if (out.volume * ~out.support).any() else ""


CASES = (
    Case(19, "zero views", "finite values and gradients; zero if it scales", "method", nothing),
    Case(
        19,
        "a support in an empty scene",
        "finite, zero outside of it",
        "method",
        empty_scene,
        dtypes=SINGLE,
    ),
    Case(21, "three samples, three cameras", "each as on its own", "method", batches, NETWORK),
    Case(26, "three copies of a camera", "equal to one copy", "method", copies, 1e-6),
    Case(27, "one camera", "finite values and gradients", "method", one_camera),
    Case(33, "gradients of all parameters", "finite, all non-zero", "method", gradients),
    Case(
        38,
        "views that are not contiguous",
        "equal to a contiguous copy",
        "method",
        not_contiguous,
        dtypes=SINGLE,
    ),
    Case(
        42,
        "autocast to bfloat16",
        "float32, close to full precision",
        "method",
        autocast,
        0.02,
        SINGLE,
    ),
    Case(48, "bad views", "an error that names got and expected", "method", bad_views),
    Case(49, "negative views", "finite values and gradients", "method", negative_views),
    Case(
        53,
        "views of any scale",
        "scales the volume if claimed; else finite",
        "method",
        any_scale,
        NETWORK,
    ),
)
