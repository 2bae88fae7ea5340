"""One word for the device in every app."""

import torch

from mvrecon.core.registry import hint

#: Where an app can compute, by Lightning's names.
ACCELERATORS = ("auto", "cpu", "gpu", "cuda")


def device_of(accelerator: str) -> str:
    """The device that an app computes on, for Lightning's name of an accelerator.

    Raises:
        ValueError: a name that is not known, or a GPU where torch sees none.
    """
    if accelerator not in ACCELERATORS:
        raise ValueError(f"Unknown device {accelerator!r}{hint(str(accelerator), ACCELERATORS)}")
    available = torch.cuda.is_available()
    if accelerator in ("gpu", "cuda") and not available:
        raise ValueError(f"Expected a GPU for device {accelerator!r}, but torch sees none here")
    return "cuda" if accelerator != "cpu" and available else "cpu"
