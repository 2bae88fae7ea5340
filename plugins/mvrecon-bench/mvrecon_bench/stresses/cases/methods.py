"""Methods: few cameras, duplicate cameras, zero views, views of any scale, batches, autocast,
gradients, weights, repeated calls.
"""

import io
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from mvrecon.methods.method import Reconstruction
from mvrecon.testing.measures import batch_gap, bits, gap, greatest, homogeneity_gap
from mvrecon.testing.method import check_gradients, check_refusals
from mvrecon.training.losses import ReconstructionLoss
from mvrecon_bench.stresses.case import SINGLE, DoesNotApply, bound, case, none_of
from mvrecon_bench.stresses.subjects import MethodSubject, small_rig

#: Networks sum some thousand products per voxel, in an order that depends on the batch.
NETWORK = bound(1e-10, 1e-5)
SHARES = {"per_view_gain": 0.1, "cross_view": 0.01, "uncertainty": 0.01}


def answers(out: Reconstruction) -> list[Tensor]:
    """All volumes and views of a reconstruction."""
    outputs = (out.volume, out.per_view, out.weights, out.predictions, out.sigma)
    return [output for output in outputs if output is not None]


def bad_numbers(method: Any, out: Reconstruction) -> int:
    """Number of non-finite values of a reconstruction, and of the gradients of the sum of squares
    of volume and sigma with respect to all trainable parameters.
    """
    weights = [weight for weight in method.parameters() if weight.requires_grad]
    squares = out.volume.square().sum() + (0 if out.sigma is None else out.sigma.square().sum())
    slopes = torch.autograd.grad(squares, weights, allow_unused=True) if weights else ()
    found = [*answers(out), *slopes]
    return sum(int((~tensor.isfinite()).sum()) for tensor in found if tensor is not None)


@case("method", 19)
def nothing(subject: MethodSubject) -> Iterator[float]:
    """Zero views: finite values and gradients; zero if it scales."""
    views = subject.views[:2].clone()
    views[0] = 0
    for batch in (views, views[:1]):
        out = subject.used(batch)
        yield bad_numbers(subject.used.func, out)
        yield int(out.volume[0].count_nonzero()) if subject.scales else 0


@case("method", 19, 0.0, SINGLE)
def empty_scene(subject: MethodSubject) -> float:
    """A support in an empty scene: finite, zero outside of it."""
    subject.need_module()
    if "support" not in subject.parameters:
        raise DoesNotApply("it has no option 'support'")
    return none_of(dict(_empty(subject)))


def _empty(subject: MethodSubject) -> Iterator[tuple[str, str]]:
    views = torch.zeros_like(subject.views[:1])
    both = torch.cat([views, subject.views[1:2]])
    for support, batch in (("hull", views), ("hull", both), ("box", views), ("auto", both)):
        method, name = subject.stirred(support=support), f"{support}, {len(batch)} samples"
        out = method(batch, subject.A)
        violations = bad_numbers(method, out)
        yield name, f"{violations} not finite" if violations else ""
        if out.support is not None:
            yield f"{name}, outside", "not zero" if (out.volume * ~out.support).any() else ""


@case("method", 21, NETWORK)
def batches(subject: MethodSubject) -> float:
    """Three samples, three cameras: each as on its own."""
    count = len(answers(subject.used(subject.views[:1])))

    def output(i: int) -> Callable[[Tensor], Tensor]:
        return lambda views: answers(subject.used(views))[i]

    with torch.no_grad():
        return greatest(batch_gap(output(i), subject.views) for i in range(count))


@case("method", 26, 1e-6)
def copies(subject: MethodSubject) -> float:
    """Three copies of a camera: equal to one copy, with initial weights."""
    subject.need_module()
    subject.need("averages")
    one, views, method = small_rig()[[0]], subject.views[:, :, :1], subject.method()
    with torch.no_grad():
        single = subject.accepts(method, views, subject.operator(one))
        rig = subject.operator(one[[0, 0, 0]])
        triple = subject.accepts(method, views.expand(-1, -1, 3, -1, -1), rig)
        return gap(triple.volume, single.volume)


@case("method", 27)
def one_camera(subject: MethodSubject) -> float:
    """One camera: finite values and gradients."""
    method, A = subject.stirred(), subject.operator(small_rig()[[0]])
    return bad_numbers(method, subject.accepts(method, subject.views[:1, :, :1], A))


@case("method", 33)
def gradients(subject: MethodSubject) -> float:
    """Gradients of all parameters: finite, all non-zero."""
    method, data = (
        subject.stirred().train(),
        {"volume": subject.truth[:2], "views": subject.views[:2]},
    )
    if not any(weight.requires_grad for weight in method.parameters()):
        raise DoesNotApply("it has nothing to train")
    loss = ReconstructionLoss(1.0, **SHARES)(method(data["views"], subject.A), data)["total"]
    check_gradients(method, loss)
    return 0.0


@case("method", 38, 0.0, SINGLE)
def not_contiguous(subject: MethodSubject) -> float:
    """Views that are not contiguous: equal to a contiguous copy."""
    views = subject.views[:1]
    slices = torch.stack([torch.zeros_like(views), views], dim=-1)[..., 1]
    with torch.no_grad():
        volume = subject.used(views).volume
        others = (views.mT.contiguous().mT, slices)
        return sum(bits(subject.used(other).volume, volume) for other in others)


@case("method", 42, 0.02, SINGLE)
def autocast(subject: MethodSubject) -> float:
    """Autocast to bfloat16: no half precision in operator and volume, close to full precision."""
    dtypes = []
    hook = subject.A.register_forward_hook(lambda _A, _volume, views: dtypes.append(views.dtype))
    with torch.no_grad(), hook:
        volume = subject.used(subject.views[:1]).volume
        with torch.autocast(subject.device.split(":")[0], torch.bfloat16):
            result = subject.used(subject.views[:1]).volume
    found = {result.dtype, *dtypes}
    half = found & {torch.bfloat16, torch.float16}
    assert not half and result.dtype == volume.dtype, f"expected no half precision, got {found}"
    return gap(result, volume)


@case("method", 48)
def bad_views(subject: MethodSubject) -> float:
    """Bad views: an error that names them."""
    check_refusals(subject.used, subject.views[:2])
    return 0.0


@case("method", 49)
def negative_views(subject: MethodSubject) -> float:
    """Negative views: finite values and gradients."""
    subject.need_module()
    views = subject.views[:1]
    return sum(
        bad_numbers(subject.used.func, subject.used(y)) for y in (views - views.mean(), -1 - views)
    )


@case("method", 53, NETWORK)
def any_scale(subject: MethodSubject) -> float:
    """Views of any scale: scales the volume if claimed; else finite, from 1e-30 to 1e12."""
    subject.need_module()
    views, factors = subject.views[:1], [2.0**power for power in (-100, -60, 40)]
    with torch.no_grad():
        if subject.scales:
            return homogeneity_gap(lambda y: subject.used(y).volume, views, factors=factors)
        volumes = [subject.used(c * views).volume for c in factors]
        return sum(int((~volume.isfinite()).sum()) for volume in volumes)


@case("method", 70, 0.0, SINGLE)
def saved(subject: MethodSubject) -> float:
    """Weights saved and loaded: the same volume."""
    file, other = io.BytesIO(), subject.method()
    torch.save(subject.used.func.state_dict(), file)  # pyrefly: ignore[missing-attribute]
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    with torch.no_grad():
        volume = other(subject.views[:1], subject.A).volume
        return bits(volume, subject.used(subject.views[:1]).volume)


@case("method", 74)
def twice(subject: MethodSubject) -> float:
    """Two runs: the same volume and gradients."""
    runs = []
    weights = subject.used.func.parameters()  # pyrefly: ignore[missing-attribute]
    learned = any(True for _ in weights)  # some classical methods reject it
    for _ in range(2):
        views = subject.views[:1].clone().requires_grad_(learned)
        volume = subject.used(views).volume
        slope = torch.autograd.grad(volume.sum(), views)[0] if volume.requires_grad else views
        runs.append(torch.cat([volume.detach().flatten(), slope.detach().flatten()]))
    return bits(*runs)


@case("method", 75)
def randomness(subject: MethodSubject) -> float:
    """The global generator: is not used."""
    method, views = subject.used, subject.views[:1]  # initialisation draws weights
    before = torch.random.get_rng_state()
    with torch.no_grad():
        method(views)
    return bits(torch.random.get_rng_state(), before)
