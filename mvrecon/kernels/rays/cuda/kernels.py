"""The compiled kernels of a variant on a device."""

from collections.abc import Sequence
from ctypes import c_void_p
from functools import cache
from hashlib import sha256

import torch

from mvrecon.kernels.rays.cuda import driver, nvrtc
from mvrecon.kernels.rays.cuda.kept import kept
from mvrecon.kernels.rays.cuda.sources import Variant, text_of


@cache
def kernels_of(variant: Variant, device: torch.device) -> dict[str, c_void_p]:
    """The kernels by name; compiled at the first call, for the device's architecture.

    Raises:
        OSError: no driver, no compiler.
        RuntimeError: the compiler or the driver refuses it.
    """
    return loaded(text_of({"": variant}), variant.names, device)


def loaded(text: str, names: Sequence[str], device: torch.device) -> dict[str, c_void_p]:
    """The kernels of a text by name, from machine code on disk or compiled; raises as
    `kernels_of`.
    """
    architecture = nvrtc.target(driver.capability_of(device), nvrtc.capabilities())
    made_of = (text, architecture, *nvrtc.OPTIONS, nvrtc.version(), str(driver.version()))
    name = sha256("\n".join(made_of).encode()).hexdigest()
    return driver.load(kept(name, lambda: nvrtc.build(text, architecture)), names, device)
