"""A volume and its rig as a self-contained HTML page: slices, maximum-intensity projection and
volume rendering by K3D (MIT), whose program is embedded.

Convention: the page's axes are the world's x, y, z in mm, for a patient R, A and H (RAS, as in
NIfTI).
"""

import math
import re
from html import escape
from importlib import import_module
from itertools import count
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool3d, max_pool3d

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Box, Grid, three
from mvrecon.report.viz.images import AXIS_LETTERS, content
from mvrecon.report.viz.rig import MESH_COLOURS, Segments, box, segments

#: The pictures of a page with their maximum voxels; larger volumes are reduced to block means, for
#: the projection to block maxima.
MAX_VOXELS = {"slices": 2**24, "mip": 2**21, "volume": 2**21}
#: Range of 16-bit floating-point numbers with three digits.
FLOAT16_RANGE = (1e-2, 6e4)
TITLE_TAG = re.compile("<title>.*?</title>")
#: Background colour.
BACKGROUND = 0x202024
#: Permissions of the page: its own program, and no external resources.
CONTENT_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob:; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; connect-src data: blob:"
)


def page(
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    cameras: Cameras | None = None,
    window: tuple[float, float] | None = None,
    first: str = "slices",
    title: str = "mvrecon",
) -> str:
    """Render a volume in the world, in mm, and the rig around it as HTML.

    Args:
        volume: values in any unit.
        grid: grid of the volume.
        cameras: the rig; none by default.
        window: values of black and white; by default the 1st and the 99.9th percentile.
        first: initial picture, one of `MAX_VOXELS`.
        title: title of the page.

    Raises:
        ImportError: k3d is not installed.
        ValueError: an unknown picture, a window in descending order, a volume of another shape than
            the grid's, or non-finite values.
    """
    if first not in MAX_VOXELS:
        raise ValueError(f"Expected one of {', '.join(MAX_VOXELS)} to be seen first, got {first!r}")
    if tuple(volume.shape) != grid.shape:
        raise ValueError(f"Expected one volume of {grid.shape} voxels, got {tuple(volume.shape)}")
    if bad := int((~volume.isfinite()).sum()):
        raise ValueError(f"Expected finite values, got {bad} that are not")
    low, high = usual_window(volume) if window is None else window
    if not low < high:
        raise ValueError(f"Expected a window from a lower to a higher value, got {low} to {high}")
    try:
        k3d: Any = import_module("k3d")
    except ImportError as error:
        raise ImportError("A page needs K3D: pip install 'mvrecon[view]'") from error
    plot = k3d.plot(grid_visible=False, camera_auto_fit=False, background_color=BACKGROUND)
    parts = {"grid": box(grid)} if cameras is None else segments(cameras, grid)
    centre = grid.centre
    # the sphere about the volume fills K3D's field of view of 60 degrees: 1 / sin(30 degrees)
    reach = 2 * (grid.corners() - centre).norm(dim=1).max()
    # from the front, the right and above
    eye = centre + reach * torch.tensor([0.45, 0.8, 0.4], dtype=torch.float64)
    plot.camera = [*eye.tolist(), *centre.tolist(), 0.0, 0.0, 1.0]
    _add_lines(plot, k3d, parts)
    _add_letters(plot, k3d, grid)
    middle = content(volume, grid, cameras)
    for name, make in {"slices": k3d.volume_slice, "mip": k3d.mip, "volume": k3d.volume}.items():
        values, coarse = reduced(volume, grid, MAX_VOXELS[name], most=name == "mip")
        values = values.detach().cpu().float().numpy()
        x, y, z = coarse.to_index(middle).round().int().tolist()
        at = {"slice_x": x, "slice_y": y, "slice_z": z} if name == "slices" else {}
        plot += make(
            values.astype(np.float16)
            if FLOAT16_RANGE[0] <= np.abs(values).max() < FLOAT16_RANGE[1]
            else values,
            name=name,
            visible=name == first,
            color_map=k3d.matplotlib_color_maps.gray,
            color_range=[low, high],
            model_matrix=box_matrix(coarse),
            compression_level=6,
            **at,
        )
    policy = f'<meta http-equiv="Content-Security-Policy" content="{CONTENT_POLICY}">'
    written = TITLE_TAG.sub(
        lambda _: f"<title>{escape(title)}</title>", plot.get_snapshot(6), count=1
    )
    return written.replace("<head>", f"<head>\n    {policy}", 1)


def reduced(
    volume: Float[Tensor, "d h w"], grid: Grid, voxels: int, most: bool = False
) -> tuple[Float[Tensor, "z y x"], Grid]:
    """Reduce a volume to at most so many voxels, by block means or maxima, and its grid.

    Incomplete blocks at the far ends are dropped.
    """
    factor = next(k for k in count(1) if math.prod(n // min(k, n) for n in volume.shape) <= voxels)
    if factor == 1:
        return volume, grid
    blocks = [min(factor, n) for n in volume.shape]
    whole = three(n - n % block for n, block in zip(volume.shape, blocks, strict=True))
    pooled = (max_pool3d if most else avg_pool3d)(volume[None, None].float(), blocks)[0, 0]
    return pooled, grid.cropped(Box((0, 0, 0), whole)).coarsened(factor)


def usual_window(volume: Float[Tensor, "d h w"]) -> tuple[float, float]:
    """The 1st and the 99.9th percentile of at most a million values; for a constant volume its
    value and that plus one.
    """
    values = volume.detach().cpu().float().flatten()
    sample = values[:: max(1, values.numel() // 10**6)].numpy()
    low, high = (float(v) for v in np.percentile(sample, (1.0, 99.9)))
    return (low, high) if low < high else (low, low + 1.0)


def box_matrix(grid: Grid) -> Float[np.ndarray, "4 4"]:
    """The affine map from K3D's unit cube about the origin to the grid's box in world mm.

    K3D's voxels (x, y, z) of n along an axis are centred at (index + 1/2) / n - 1/2.
    """
    size = torch.tensor(grid.size, dtype=torch.float64)
    to_index = torch.eye(4, dtype=torch.float64)
    to_index[:3, :3] = torch.diag(size)
    to_index[:3, 3] = (size - 1) / 2
    return (grid.affine @ to_index).numpy()


def _add_lines(plot: Any, k3d: Any, parts: dict[str, Segments]) -> None:
    for name, lines in parts.items():
        red, green, blue = MESH_COLOURS[name]
        plot += k3d.lines(
            lines.flatten(0, 1).numpy().astype(np.float32),
            np.arange(2 * len(lines), dtype=np.uint32).reshape(-1, 2),
            indices_type="segment",
            shader="simple",
            color=red << 16 | green << 8 | blue,
            name=name,
        )


def _add_letters(plot: Any, k3d: Any, grid: Grid) -> None:
    """Add letters of the patient's directions beside the grid's box, along the world's axes."""
    corners = grid.corners()
    low, high = corners.amin(dim=0), corners.amax(dim=0)
    reach = 0.08 * (high - low).max()
    for axis, (first, last) in enumerate(AXIS_LETTERS):
        for letter, end, step in ((first, low, -reach), (last, high, reach)):
            place = (low + high) / 2
            place[axis] = end[axis] + step
            plot += k3d.texture_text(
                letter, position=place.tolist(), color=0xFFD200, size=reach.item(), name=letter
            )
