"""Attenuated projection, its transpose, and its derivative with respect to the attenuation mu, as
torch operators.

The CPU uses the transmission along the rays if it is given as `kept` (see `transmission`), and
otherwise computes it in every call. Zero emission is skipped without changing any bit, unless the
method has the suffix `DENSE`. CPU and CUDA devices have kernels for a single attenuation map and
rays without gradient; the reference computes everything else.
"""

import torch

from mvrecon.kernels.operator import LinearKernel, accumulation_dtype, define
from mvrecon.kernels.rays.ops import tiny_scene
from mvrecon.kernels.self_test import Errors
from mvrecon_spect.kernels import reference
from mvrecon_spect.kernels.reference import DENSE

CPU = "mvrecon_spect.kernels.cpu"
#: Segments of a ray per slab.
SEGMENTS = {"joseph": 1, "siddon": 3, "distance_driven": 1}


def _project_in_torch(volume, mu, lines, layers, window, longest, detector, method, kept=None):
    method = method.removesuffix(DENSE)
    return reference.project(volume, mu, lines, layers, window, longest, detector, method)


ATTENUATED = LinearKernel(
    "project(Tensor volume, Tensor mu, Tensor lines, Tensor layers, float[] window, "
    "float longest, SymInt[] detector, str method, Tensor? kept=None) -> Tensor",
    "backproject(Tensor views, Tensor mu, Tensor lines, Tensor layers, float[] window, "
    "float longest, str method, Tensor? kept=None) -> Tensor",
    "mu_vjp(Tensor volume, Tensor views, Tensor mu, Tensor lines, Tensor layers, float[] window, "
    "float longest, str method, Tensor? kept=None) -> Tensor",
    {"cpu": CPU, "cuda": "mvrecon_spect.kernels.cuda"},
    _project_in_torch,
    shapes=(
        lambda volume, mu, lines, layers, window, longest, detector, *_: (
            *(volume.shape[0], lines.shape[0]),
            *(*detector, layers.shape[1]),
        ),
        lambda views, mu, *_: (views.shape[0], *mu.shape),
    ),
    sizes=(slice(1, 4), slice(2, 4)),
    prefix="attenuated_",
)
project, backproject, mu_vjp = ATTENUATED.forward, ATTENUATED.transpose, ATTENUATED.vjp
transmission = define(
    "transmission(Tensor mu, Tensor lines, float[] window, SymInt[] detector, str method) "
    "-> Tensor",
    {"cpu": CPU},
    lambda mu, lines, window, detector, method: mu.new_empty(
        len(lines), *detector[::-1], max(mu.shape) * SEGMENTS[method]
    ),
    "attenuated_",
)


def self_test(device: str, dtype: torch.dtype, purpose: str) -> Errors:
    """Views in two layers, by either method."""
    lines, window, detector, shape = tiny_scene(device)
    generator, real = torch.Generator().manual_seed(0), accumulation_dtype(dtype)
    x = torch.rand(2, *shape, generator=generator).to(device, real)
    mu = (0.2 * torch.rand(shape, generator=generator)).to(device, real)
    layers = torch.tensor([[1.2, 2.5]], dtype=torch.float64).expand(len(lines), -1).to(device)
    for method in SEGMENTS:
        yield from ATTENUATED.self_test(x, mu, lines, layers, window, 3.0, detector, method)
