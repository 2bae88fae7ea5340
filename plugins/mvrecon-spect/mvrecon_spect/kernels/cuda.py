"""The compiled CUDA operators along attenuated rays: the same three as on the CPU, on torch's
current stream, without synchronisation.

Transmissions are not cached. The adjoints accumulate rays in 63-bit fixed point, so that all runs
give the same bits. An upper bound of a voxel's value defines the unit: a value that is not finite
makes the entire result NaN.
"""

import math
from ctypes import c_double, c_int, c_void_p
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.cuda.launch import RAYS, Scene, Source
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.rays.cuda.operators import Call
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon_spect.kernels.reference import DENSE, DISTANCE_DRIVEN

#: Bits of a fixed-point number, without sign.
BITS = 62


class AttenuatedScene(Scene):
    """Arguments of a call along attenuated rays, as in `attenuated.cu`."""

    _fields_ = [("layers", c_void_p), ("fixed", c_double), ("n_layers", c_int)]


ATTENUATED = Source(
    "ATTENUATED",
    ("survey", "store", "project", "backproject", "mu_vjp"),
    AttenuatedScene,
    (*RAYS.files, Path(__file__).with_name("attenuated.cu")),
)

AREAS = Source("DISTANCE_DRIVEN", ATTENUATED.names, AttenuatedScene, ATTENUATED.files)


def project(volume, mu, lines, layers, window, longest, detector, method, kept=None):
    """Attenuated line integrals, in mm times the volumes' unit; see
    `reference.project`.
    """
    x = to_accumulation_dtype(volume)
    call = _call(torch.cat([x, mu.to(x.dtype)[None]]), lines, layers, window, detector, method)
    views = call.new(len(x), len(lines), *detector, layers.shape[1])
    call.scene.put(views=views)
    if len(x):
        call.over_rays("project", len(x))
    return views


def backproject(views, mu, lines, layers, window, longest, method, kept=None):
    """The transpose of `project` with respect to the emission, exact to 2^-`BITS` of its bound."""
    y, detector = to_accumulation_dtype(views), views.shape[2:4]
    greatest = _greatest(y) * longest
    call = _call(mu.to(y.dtype)[None], lines, layers, window, detector, method)
    return _whole(call, "backproject", y / greatest, len(y)) * greatest


def mu_vjp(volume, views, mu, lines, layers, window, longest, method, kept=None):
    """Derivative of <views, project(volume, mu)> with respect to the attenuation mu."""
    x, detector = to_accumulation_dtype(volume), views.shape[2:4]
    y = views.to(x.dtype)
    # the total transmission of a ray's segments is at most one, and so is its product with their
    # length
    sent = _greatest(x) * longest * (max(mu.shape) * max(1, len(x)))
    seen = _greatest(y) * longest
    both = torch.cat([x / sent, mu.to(x.dtype)[None]])
    call = _call(both, lines, layers, window, detector, method)
    return _whole(call, "mu_vjp", y / seen, 1)[0].mul(sent * seen).to(mu.dtype)


def _call(volumes, lines, layers, window, detector, method):
    """A call with volumes in the layout read by the rays; the last volume is the attenuation."""
    method, source = method.removesuffix(DENSE), ATTENUATED  # never skips
    if method == DISTANCE_DRIVEN:
        method, source = "joseph", AREAS
    part, x = Occupancy.whole(volumes.shape[1:]), volumes.detach().contiguous()
    call = Call(x, lines, window, part, detector, method, source, together=1)
    call.read(x, None)
    nodes = layers.detach().double().contiguous()
    call.tensors.append(nodes)
    call.scene.put(layers=nodes, n_layers=layers.shape[1])
    return call


def _whole(call: Call, name: str, views: Tensor, count: int) -> Float[Tensor, "n d h w"]:
    """Volumes from views, to which every ray adds at most one per voxel."""
    scene, y = call.scene, views.contiguous()
    rays = scene.n_views * scene.rows * scene.columns
    fixed = 2.0 ** (BITS - math.ceil(math.log2(max(1, rays))))
    results = call.new(count, *scene.sizes[::-1], dtype=torch.int64, zero=True)
    scene.put(views=y, results=results, fixed=fixed)
    if count:
        call.over_rays(name, count)
    return results.to(y.dtype) / fixed


def _greatest(values: Tensor) -> Float[Tensor, ""]:
    """Maximum magnitude, on the device; one for all zeros, NaN if a value is not finite."""
    greatest = values.abs().amax() if values.numel() else values.new_zeros(())
    return torch.where(greatest == 0, 1, greatest) + 0 * greatest
