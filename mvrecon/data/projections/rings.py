"""Rings of pixels that measure unequally, removed from the sinograms of measured views."""

from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

Rings = Literal["gains", "sorting"]


def without_rings(
    views: Float[Tensor, "m v u"], method: Rings, width: int
) -> Float[Tensor, "m v u"]:
    """Views without the vertical stripes of their sinograms, which reconstruct to rings.

    Args:
        views: line integrals of all views.
        method: "gains" subtracts from each pixel one number, the median over the views of its
            difference from the median of its neighbours, as pixels with wrong gains or flat fields
            add one to all views (after Boin and Haibel, Optics Express 14, 12071, 2006). "sorting"
            replaces the values of each column, in the order of their size, by the median of
            neighbouring columns, for stripes that change with the object: algorithm 3 of Vo, Atwood
            and Drakopoulos, Optics Express 26, 28396, 2018, by algotom.
        width: greatest width of a ring, in pixels; medians are of 2 width + 1 pixels. Details as
            narrow on the axis of rotation, and walls around it, are removed, too.

    Raises:
        ImportError: algotom is not installed, for "sorting".
    """
    if method == "gains":
        off = torch.empty(views.shape[1:])
        for row in range(views.shape[1]):
            sinogram = views[:, row]
            near = F.pad(sinogram, (width, width), mode="replicate").unfold(1, 2 * width + 1, 1)
            off[row] = (sinogram - near.median(dim=-1).values).median(dim=0).values
        return views - off
    try:
        from algotom.prep.removal import remove_stripe_based_sorting
    except ImportError as error:
        raise ImportError(
            f"views.rings=sorting needs algotom: pip install 'mvrecon[rings]' ({error})"
        ) from None
    sinograms = views.swapaxes(0, 1).numpy()
    rows = [remove_stripe_based_sorting(sinogram, size=2 * width + 1) for sinogram in sinograms]
    return torch.from_numpy(np.stack(rows, axis=1).astype(np.float32))
