"""Whether the CUDA back end may be trusted on a device: each operator is tried once against the
reference.
"""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Lock
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import pixel_centres
from mvrecon.kernels.precision import wide
from mvrecon.kernels.rays import reference
from mvrecon.kernels.rays.occupancy import Occupancy

logger = logging.getLogger(__name__)

#: The greatest difference to the reference, by its greatest value: rounding, and where a ray falls
#: on an edge.
TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}
#: Types that kernels read; another is cast to float32 first.
STORED = (torch.float64, torch.float16, torch.bfloat16)


#: What was tried, and its greatest difference to the reference, by the reference's greatest value.
Tried = Iterator[tuple[str, float]]


class Case(NamedTuple):
    """What is checked at once: a device, a method without its samples or another purpose, the type
    that volumes are stored in, and whether several of them share their rays.
    """

    device: str
    method: str
    dtype: torch.dtype
    several: bool


class Verdict(NamedTuple):
    """Why kernels cannot be used, or None, and whether that is so for good."""

    why: str | None
    lasting: bool


_verdicts: dict[Case, str | None] = {}
_lock = Lock()


@torch.compiler.assume_constant_result
def reason(
    device: torch.device | str,
    method: str = "joseph",
    dtype: torch.dtype = torch.float32,
    volumes: int = 1,
    tried: Callable[[str, torch.dtype], Tried] | None = None,
) -> str | None:
    """Why the kernels for some input cannot be used on a device, or None. Tried once, which
    compiles them; logged once. Only what is true of the device is remembered.

    Args:
        device: a CUDA device.
        method: "joseph", "siddon" or "trilinear:samples", or another purpose of kernels.
        dtype: of the volumes or views.
        volumes: how many there are: one has kernels of its own.
        tried: of another purpose, what is tried on a device in a type of arithmetic.
    """
    place = torch.device(device)
    if place.type == "cuda" and place.index is None:
        place = torch.device(
            "cuda", torch.cuda.current_device() if torch.cuda.is_available() else 0
        )
    stored = dtype if dtype in STORED else torch.float32
    case = Case(str(place), method.partition(":")[0], stored, volumes > 1 and tried is None)
    with _lock:
        if case in _verdicts:
            return _verdicts[case]
        verdict = _apart(partial(_verdict_on, case, tried))
        if verdict.lasting:
            _verdicts[case] = verdict.why
    if verdict.why:
        what = f"{case.method} of {stored} on {place}"
        logger.warning("The reference computes %s: %s", what, verdict.why)
    return verdict.why


def forget() -> None:
    """Forget every verdict, so that the next call tries again."""
    with _lock:
        _verdicts.clear()


def _apart(check: Callable[[], Verdict]) -> Verdict:
    """What a check says in a thread of its own: inference mode, autocast, derivatives and maps of
    `torch.func` hold for the thread that asks, and a check inside them would fail.
    """
    with ThreadPoolExecutor(1) as fresh:
        return fresh.submit(check).result()


def _verdict_on(case: Case, tried: Callable[[str, torch.dtype], Tried] | None) -> Verdict:
    bound = TOLERANCE[torch.promote_types(case.dtype, torch.float32)]
    method = f"{case.method}:8" if case.method == "trilinear" else case.method
    rays = partial(differences, method=method, volumes=5 if case.several else 1)
    try:
        for what, error in (tried or rays)(case.device, case.dtype):
            if not error <= bound:
                why = f"{what} differs from the reference by {error:.1e}, expected at most "
                return Verdict(f"{why}{bound:.0e}", lasting=True)
    except torch.OutOfMemoryError as problem:  # another time there may be room
        return Verdict(str(problem), lasting=False)
    # a missing package, no driver, no compiler, a kernel that fails: all mean the same
    except Exception as problem:
        return Verdict(f"{type(problem).__name__}: {problem}", lasting=True)
    return Verdict(None, lasting=True)


def differences(device: str, dtype: torch.dtype, method: str, volumes: int) -> Tried:
    """What was tried of the kernels along rays, on a tiny scene.

    Raises:
        OSError: no driver, or no compiler.
        RuntimeError: the compiler, the driver or the device refuses a kernel.
    """
    from mvrecon.kernels.rays.cuda import operators as cuda

    lines, window, detector, shape = tiny_scene(device)
    occupancy = Occupancy.whole(shape)
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(volumes, *shape, generator=generator).to(device, dtype)
    y = wide(torch.rand(volumes, len(lines), *detector, generator=generator).to(device, dtype))
    moving = lines.clone().requires_grad_()
    with torch.enable_grad():
        views = reference.project(wide(x), moving, window, detector, method)
        (change,) = torch.autograd.grad((views * y).sum(), moving)
    volume = reference.backproject(y, lines, window, shape, method)
    yield "project", error_of(cuda.project(x, lines, window, occupancy, detector, method), views)
    yield "backproject", error_of(cuda.backproject(y, lines, window, occupancy, method), volume)
    single, z = one_by_one(lines, detector), y.flatten(1)[..., None, None]
    yield "explicit rays", error_of(cuda.scatter(z, single, window, occupancy, method), volume)
    yield "lines_vjp", error_of(cuda.lines_vjp(x, y, lines, window, occupancy, method), change)


def one_by_one(lines: Float[Tensor, "m 4 3 3"], detector: list[int]) -> Float[Tensor, "r 4 3 1"]:
    """Every ray of some views as a view of one pixel: maps of the constant alone."""
    centre = lines.new_tensor([(detector[1] - 1) / 2, (detector[0] - 1) / 2])
    uv = pixel_centres(detector).to(lines) - centre
    p = torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1).reshape(-1, 3)
    return torch.einsum("mkxc,rc->mrkx", lines, p).flatten(0, 1)[..., None].contiguous()


def tiny_scene(device: str) -> tuple[Tensor, list[float], list[int], list[int]]:
    """Lines [3 4 3 3], window, detector and shape: three cone beams, each with another main axis,
    all slanted.
    """
    maps = []
    for axis in range(3):
        source, look, u, v = (torch.zeros(3, dtype=torch.float64) for _ in range(4))
        source[axis], source[axis - 1], source[axis - 2] = -19.3, 1.71, -2.37
        look[axis], look[axis - 1], look[axis - 2] = 31.1, -2.13, 3.19
        u[axis - 1], v[axis - 2], u[axis - 2] = 1.13, 1.07, 0.11
        none, direction = torch.zeros_like(u), torch.stack([u, v, look], dim=-1)
        moment = torch.linalg.cross(source[:, None].expand(3, 3), direction, dim=0)
        maps.append(
            torch.stack([direction, moment, torch.stack([none, none, source], dim=-1), direction])
        )
    return torch.stack(maps).to(device), [0.0, 1.0], [5, 6], [5, 4, 6]


def error_of(got: Tensor, expected: Tensor) -> float:
    """The greatest difference, by the greatest value of what is expected."""
    return float((got - expected.detach()).abs().max() / expected.detach().abs().max())
