"""Draws docs/images/frames.png: python -m scripts.docs.frames OUT.png

World, camera and detector frames of an X-ray camera and of a pinhole that look at the letter F.
What is drawn is what `Cameras` computes, not what a page says.
"""

import sys
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

import mvrecon as mv
from mvrecon.report.viz.rig import outlines

DETECTOR = {"pixels": [24, 32], "pixel_mm": 5.0}
#: The letter in the plane x = 0, as one who stands on the positive x axis and has z above sees it.
LETTER = torch.tensor(
    [[0.0, -14, -26], [0, -14, 26], [0, 18, 26], [0, -14, 26], [0, -14, 2], [0, 10, 2]],
    dtype=torch.float64,
)
COLOURS = {"u": "tab:orange", "v": "tab:purple", "F": "tab:green", "S": "tab:red"}


def rigs() -> dict[str, mv.Cameras]:
    """One camera of each kind at the angle 0, in mm: its source or pinhole on the x axis."""
    xray = mv.circular(1, 200.0, 300.0, DETECTOR)
    (rows, columns), step = DETECTOR["pixels"], DETECTOR["pixel_mm"]
    corner = [[250.0, -step * (columns - 1) / 2, step * (rows - 1) / 2]]
    pinhole = mv.Cameras(
        torch.tensor([[150.0, 0, 0]]),
        torch.tensor(corner),
        torch.tensor([[0, step, 0]]),
        torch.tensor([[0, 0, -step]]),
        (rows, columns),
        extent="behind",
    )
    return {'X-ray, extent "segment"': xray, 'pinhole, extent "behind"': pinhole}


def image(camera: mv.Cameras) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 3"]]:
    """The letter on a camera's detector: in pixels (u, v), and in world mm."""
    pixels = camera.project(LETTER)[0, :, :2]
    place = camera.origin + pixels[:, :1] * camera.u + pixels[:, 1:] * camera.v
    return pixels, place


def draw_world(axes: Any, camera: mv.Cameras) -> None:
    """The rig in the world: axes, letter, rays, detector, and the steps u and v at pixel (0, 0)."""
    (corners,), source = outlines(camera)[0], camera.source[0]
    place = image(camera)[1]
    for name, end in zip("xyz", 70 * torch.eye(3), strict=True):
        axes.quiver(0, 0, 0, *end, color="black", arrow_length_ratio=0.15, linewidth=1)
        axes.text(*(1.15 * end), name)
    axes.plot(*LETTER.T, color=COLOURS["F"], linewidth=3)
    axes.plot(*place.T, color=COLOURS["F"], linewidth=2)
    for start, end in zip(LETTER[[0, 2]], place[[0, 2]], strict=True):
        stops = torch.stack([start, source, end]) if camera.extent == "behind" else (source, end)
        axes.plot(*torch.stack(tuple(stops)).T, color="grey", linewidth=0.8)
    axes.plot(*corners[[0, 1, 2, 3, 0]].T, color="black", linewidth=1)
    axes.scatter(*source, color=COLOURS["S"])
    axes.text(*(source + torch.tensor([0, 0, 9])), "S", color=COLOURS["S"])
    normal = torch.linalg.cross(camera.u[0], camera.v[0])
    depth = 60 * normal / normal.norm() * torch.sign(normal @ (camera.origin[0] - source))
    axes.quiver(*source, *depth, color=COLOURS["S"], arrow_length_ratio=0.15, linewidth=1)
    axes.text(*(source + 0.8 * depth - torch.tensor([0, 0, 18])), "depth", color=COLOURS["S"])
    for name, step in (("u", camera.u[0]), ("v", camera.v[0])):
        axes.quiver(*camera.origin[0], *(8 * step), color=COLOURS[name], linewidth=2)
        axes.text(*(camera.origin[0] + 9.5 * step), name, color=COLOURS[name])
    axes.text(*(camera.origin[0] - 6 * camera.u[0] - camera.v[0]), "D0")
    extents = [high - low for low, high in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    axes.set_box_aspect(extents, zoom=0.78)
    axes.view_init(elev=22, azim=-50)
    axes.set_axis_off()
    axes.patch.set_visible(False)


def draw_pixels(axes: Any, camera: mv.Cameras) -> None:
    """The letter's image in the detector's frame: pixel (0, 0) above on the left, v downwards."""
    rows, columns = camera.shape
    axes.plot(*image(camera)[0].T, color=COLOURS["F"], linewidth=3)
    axes.plot(0, 0, "o", color="black", clip_on=False)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), aspect="equal")
    axes.set_xlabel("u, columns", color=COLOURS["u"])
    axes.set_ylabel("v, rows", color=COLOURS["v"])
    axes.text(0.7, 1.6, "D0 = pixel (0, 0)")


def draw(out: Path) -> None:
    """Write the picture as a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6.4))
    for number, (name, camera) in enumerate(rigs().items()):
        bottom = 0.58 - 0.49 * number
        # axes in 3-D are square, and lie above each other where nothing is drawn
        world = figure.add_axes((-0.06, bottom - 0.29, 0.66, 0.66 * 9 / 6.4), projection="3d")
        draw_world(world, camera)
        draw_pixels(figure.add_axes((0.62, bottom, 0.36, 0.36)), camera)
        figure.text(0.33, bottom + 0.35, name, fontsize="large")
    figure.savefig(out, dpi=100)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
