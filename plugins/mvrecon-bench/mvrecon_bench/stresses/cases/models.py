"""Models: few cameras, copies of one, views of nothing and of any scale, batches, autocast,
gradients, weights.
"""

import inspect
import math
from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from mvrecon.losses import ReconstructionLoss
from mvrecon.models.output import Reconstruction
from mvrecon.parts import MODELS
from mvrecon.projectors.ray_transform import RayTransform
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.learned_subjects import ModelSubject, small_rig
from mvrecon_bench.stresses.refusals import none_of, refusal
from mvrecon_bench.stresses.subject import bits, gap, greatest

SINGLE = (torch.float32,)
#: Networks sum some thousand products a voxel, in other orders for other batches.
NETWORK = {torch.float64: 1e-10, torch.float32: 1e-5}


def bad_numbers(*tensors: Tensor | None) -> int:
    """How many numbers are not finite."""
    return sum(int((~tensor.isfinite()).sum()) for tensor in tensors if tensor is not None)


def answers(out: Reconstruction) -> list[Tensor]:
    """All volumes and views of an answer."""
    outputs = (out.volume, out.opinions, out.weights, out.cross_views)
    return [output for output in outputs if output is not None]


def copies(subject: ModelSubject) -> float:
    """Three copies of one camera, with first weights: what the one alone gives."""
    one, views = small_rig()[[0]], subject.views[:, :, :1]
    single, triple = subject.model(one), subject.model(one[[0, 0, 0]])
    shapes = [
        {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
        for model in (single, triple)
    ]
    if shapes[0] != shapes[1] or getattr(type(single), "counts_cameras", False):
        raise DoesNotApply("its weights are made for a number of cameras")
    with torch.no_grad():
        triple.load_state_dict(single.state_dict())
        return gap(triple(views.expand(-1, -1, 3, -1, -1)).volume, single(views).volume)


def one_camera(subject: ModelSubject) -> float:
    """A rig of one camera, which has no others to listen to."""
    model = subject.stirred(small_rig()[[0]])
    out = model(subject.views[:1, :, :1])
    return bad_numbers(*answers(out), *slopes(model, out).values())


def slopes(model: torch.nn.Module, out: Reconstruction) -> dict[str, Tensor | None]:
    """Gradients of all parameters that want one, by the sum of squares of the volume."""
    named = {name: weight for name, weight in model.named_parameters() if weight.requires_grad}
    if not named:
        return {}
    gradients = torch.autograd.grad(
        out.volume.square().sum(), list(named.values()), allow_unused=True
    )
    return dict(zip(named, gradients, strict=True))


def nothing(subject: ModelSubject) -> float:
    """Views of nothing, beside a sample of something, and with no sample beside it: nothing, if it
    claims to scale.
    """
    views = (
        subject.views[:2] * torch.tensor([0.0, 1.0]).to(subject.views)[:, None, None, None, None]
    )
    violations = 0
    for batch in (views, views[:1]):
        out = subject.used(batch)
        violations += bad_numbers(*answers(out), *slopes(subject.used, out).values())
        violations += int(out.volume[0].count_nonzero()) if subject.scales else 0
    return violations


def any_scale(subject: ModelSubject) -> float:
    """Views of 2^-100 (1e-30) to 2^40 (1e12) times the size: the volume times that, or (no such
    claim) finite ones.
    """
    views, errors = subject.views[:1], []
    with torch.no_grad():
        volume = subject.used(views).volume
        for power in (-100, -60, 40):
            scaled = subject.used(views * 2.0**power).volume
            errors.append(
                gap(scaled / 2.0**power, volume) if subject.scales else 0.0 * float(scaled.sum())
            )
    return greatest(errors)


def below_nought(subject: ModelSubject) -> float:
    """Views of noise about zero, and below zero everywhere: how many numbers are not finite."""
    violations = 0
    for views in (subject.views[:1] - subject.views[:1].mean(), -1 - subject.views[:1]):
        out = subject.used(views)
        violations += bad_numbers(*answers(out), *slopes(subject.used, out).values())
    return violations


def doors(subject: ModelSubject) -> float:
    """Views that are not finite, or of another shape than the rig's."""
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


def batches(subject: ModelSubject) -> float:
    """Three samples of three cameras together: what each gives alone."""
    with torch.no_grad():
        every = answers(subject.used(subject.views))
        alone = zip(*[answers(subject.used(one)) for one in subject.views.split(1)], strict=True)
        return greatest(gap(a, torch.cat(b)) for a, b in zip(every, alone, strict=True))


def not_contiguous(subject: ModelSubject) -> float:
    """Views that are transposed, or a part of something larger: what a copy of them gives."""
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


def autocast(subject: ModelSubject) -> float:
    """The whole model under autocast to bfloat16: all float32, and how far from that without."""
    model, dtypes = subject.stirred(), []
    for module in model.modules():
        if isinstance(module, RayTransform):
            module.register_forward_hook(lambda _module, _volume, views: dtypes.append(views.dtype))
    with torch.no_grad():
        volume = model(subject.views[:1]).volume
        with torch.autocast(subject.device.split(":")[0], torch.bfloat16):
            result = model(subject.views[:1]).volume
    assert {result.dtype, *dtypes} == {torch.float32}, (
        f"expected float32 alone, got {result.dtype} and {set(dtypes)}"
    )
    return gap(result, volume)


def gradients(subject: ModelSubject) -> float:
    """Of the loss, by every parameter: how many have none, or one that is zero or not finite."""
    model = subject.stirred().train()
    named = {name: weight for name, weight in model.named_parameters() if weight.requires_grad}
    if not named:
        raise DoesNotApply("it has nothing to train")
    out = model(subject.views[:2])
    loss = ReconstructionLoss(1.0, opinions=0.1, cross_view=0.01)(
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


def empty_scene(subject: ModelSubject) -> float:
    """Told to find a support in views of nothing: finite, and nothing outside of it."""
    if "support" not in inspect.signature(MODELS.get(subject.name)).parameters and not _skips(
        subject
    ):
        raise DoesNotApply("it has no option 'support'")
    return none_of({name: text for name, text in _empty(subject)})


def _skips(subject: ModelSubject) -> bool:
    try:
        subject.model(support="hull")
    except TypeError:
        return False
    return True


def _empty(subject: ModelSubject) -> Iterator[tuple[str, str]]:
    views = torch.zeros_like(subject.views[:1])
    both = torch.cat([views, subject.views[1:2]])
    for support, batch in (("hull", views), ("hull", both), ("box", views), ("auto", both)):
        model, name = subject.stirred(support=support), f"{support}, {len(batch)} samples"
        out = model(batch)
        violations = bad_numbers(*answers(out), *slopes(model, out).values())
        yield name, f"{violations} not finite" if violations else ""
        if out.support is not None:
            yield f"{name}, outside", "not zero" if (out.volume * ~out.support).any() else ""


CASES = (
    Case(
        19, "views of nothing", "finite, gradients too; nothing where it scales", "model", nothing
    ),
    Case(
        19,
        "a support in an empty scene",
        "finite, and nothing outside of it",
        "model",
        empty_scene,
        dtypes=SINGLE,
    ),
    Case(21, "three samples, three cameras", "what each gives alone", "model", batches, NETWORK),
    Case(26, "three copies of a camera", "what the one gives", "model", copies, 1e-6),
    Case(27, "one camera", "all is finite, gradients too", "model", one_camera),
    Case(33, "gradients of all parameters", "finite, and none is idle", "model", gradients),
    Case(
        38,
        "views that are not contiguous",
        "what a copy gives",
        "model",
        not_contiguous,
        dtypes=SINGLE,
    ),
    Case(
        42,
        "autocast to bfloat16",
        "float32 out, close to that without",
        "model",
        autocast,
        0.02,
        SINGLE,
    ),
    Case(48, "bad views", "refused, with what was got and expected", "model", doors),
    Case(49, "views below nought", "all is finite, gradients too", "model", below_nought),
    Case(
        53,
        "views of any scale",
        "the volume times that; without such a claim, finite",
        "model",
        any_scale,
        NETWORK,
    ),
)
