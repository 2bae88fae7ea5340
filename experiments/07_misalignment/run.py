"""FDK of Defrise's disks from views of a misaligned scanner: with ideal matrices, with the true
ones in the back-projection alone (Karolczak and others, Med. Phys. 28, 2001), and everywhere.

    python experiments/07_misalignment/run.py experiments/07_misalignment
"""

import sys
from pathlib import Path

import torch
from matplotlib import pyplot

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.random_rigs import Misalignment, misaligned

GRID = mv.Grid.centred(size=(96, 96, 96), spacing=1.5)
RIG = mv.circular(240, 500.0, 800.0, {"pixels": [128, 128], "pixel_mm": 2.0})


def disks() -> Phantom:
    """Five disks of 0.02/mm across the axis, 50 mm in radius, 10 mm thick, 20 mm apart."""
    centres = torch.zeros(5, 3)
    centres[:, 2] = 20.0 * torch.arange(-2, 3) + 0.6
    sizes, values = torch.tensor([[50.0, 50.0, 5.0]]).expand(5, 3), torch.full((5,), 0.02)
    return Phantom((Solids.upright("ellipsoid", centres, sizes, values),))


def cases() -> dict[str, mv.Cameras]:
    """Errors that are the same in all views, and errors of each view's own."""
    torch.manual_seed(0)
    none = Misalignment.none(len(RIG))
    offset = none.offset_px + torch.tensor([2.0, -2.0])
    tilt = none.tilt_degrees + torch.tensor([1.0, -1.0, 1.0])
    source = none.source_mm + torch.tensor([2.0, -2.0, 3.0])
    sizes = ((1.0, 2), (0.5, 3), (1.0, 3))
    own = [s * torch.randn(len(RIG), n, dtype=torch.float64) for s, n in sizes]
    errors = {
        "none": none,
        "offset of 2 pixels": none._replace(offset_px=offset),
        "tilts of 1 degree": none._replace(tilt_degrees=tilt),
        "source 2 to 3 mm": none._replace(source_mm=source),
        "all three": Misalignment(offset, tilt, source, none.depth_mm),
        "own in each view": Misalignment(*own, none.depth_mm),
    }
    return {name: misaligned(RIG, by) for name, by in errors.items()}


def main(folder: Path) -> None:
    phantom, planes, rows = disks(), {}, []
    truth = voxelise(phantom, GRID, 3)
    ideal, best = mv.Drr(GRID, RIG), None
    for name, rig in cases().items():
        views = phantom.views(rig, 2)[None, None].float()
        volumes = {
            "ideal": mv.fdk(ideal, views),
            "back-projection": mv.fdk(mv.Drr(GRID, rig), views, weights_from=RIG),
            "everywhere": mv.fdk(mv.Drr(GRID, rig), views),
        }
        best = volumes["ideal"] if best is None else best
        for matrices, x in volumes.items():
            error = ((x[0, 0] - truth).norm() / truth.norm()).item()
            change = ((x - best).norm() / best.norm()).item()
            rows.append(
                {
                    "misalignment": name,
                    "true matrices in": matrices,
                    "error": f"{error:.4f}",
                    "change from no misalignment": f"{change:.4f}",
                }
            )
            print(*rows[-1].values())
        if name in ("all three", "own in each view"):
            planes[name] = [x[0, 0, :, 48] for x in (best, *volumes.values())]
    write_rows(folder / "results.csv", rows)
    draw(planes, folder / "disks.png")


def draw(planes: dict[str, list[torch.Tensor]], file: Path) -> None:
    """Coronal planes, a row for each misalignment."""
    titles = ("aligned scanner", "ideal matrices", "true in\nback-projection", "true everywhere")
    shape = {"figsize": (8, 4.4), "sharex": True, "sharey": True}
    figure, axes = pyplot.subplots(len(planes), 4, layout="constrained", **shape)
    edge = GRID.size[0] * GRID.spacing[0] / 2
    for row, (name, images) in zip(axes, planes.items(), strict=True):
        for axis, image in zip(row, images, strict=True):
            shown = axis.imshow(
                image, cmap="gray", vmin=0, vmax=0.025, origin="lower", extent=2 * (-edge, edge)
            )
        row[0].set_ylabel(f"{name}\nz / mm")
    for top, bottom, title in zip(axes[0], axes[-1], titles, strict=True):
        top.set_title(title, fontsize=10)
        bottom.set_xlabel("x / mm")
    figure.colorbar(shown, ax=axes, label="attenuation / (1/mm)", shrink=0.8)
    figure.savefig(file, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
