"""RTK's own FDK of the same files, in RTK's conventions, beside mvrecon's volumes, voxel by voxel.

    python experiments/10_real_input/rtk_reads.py SCAN VOLUMES FOLDER

SCAN is a run folder of `mvrecon-simulate rtk=true`, VOLUMES holds what `mvrecon-reconstruct` made
of it (in HU). Needs itk-rtk. RTK reads TIFF and XML by its own readers; mvrecon reads NIfTI alone.
"""

import sys
from pathlib import Path

import itk
import torch
from itk import RTK
from jaxtyping import Float
from PIL import Image
from torch import Tensor

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.data.attenuation import attenuation
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz import review
from mvrecon.report.viz.sheet import ColourScale, Column, Panel, sheet

#: The detector's pixels in mm, and the grey values of the scan's dark and flat field.
PIXEL, DARK, FLAT = 4.0, 100.0, 50_000.0
#: Of line integrals and voxels, in ITK.
IMAGE = itk.Image[itk.F, 3]
#: 1/mm: what counts as the body, and the white of the picture.
BODY, WHITE = 0.005, 0.04


def line_integrals(folder: Path):
    """RTK's projections: ITK stacks the images as they are, the first row at the lowest y."""
    reader = RTK.ProjectionsReader[IMAGE].New()
    files = sorted(map(str, folder.glob("view_*.tif")))
    reader.SetFileNames(files)
    columns, rows = itk.imread(files[0]).GetLargestPossibleRegion().GetSize()
    reader.SetSpacing([PIXEL, PIXEL, 1.0])
    reader.SetOrigin([-PIXEL * (columns - 1) / 2, -PIXEL * (rows - 1) / 2, 0.0])
    reader.SetIDark(DARK)
    reader.SetI0(FLAT)
    return reader


def rtk_fdk(scan: Path, projections: Path, grid: mv.Grid) -> Float[Tensor, "d h w"]:
    """RTK's volume in 1/mm: made on cubes about the isocentre in RTK's axes x, y, z, which are the
    patient's left, head, front (IEC 61217), then put in the order of NIfTI's axes.
    """
    (size, *_), (step, *_) = grid.size, grid.spacing
    empty = RTK.ConstantImageSource[IMAGE].New()
    empty.SetOrigin([-step * (size - 1) / 2] * 3)
    empty.SetSpacing([step] * 3)
    empty.SetSize([size] * 3)
    views = line_integrals(projections)
    method = RTK.FDKConeBeamReconstructionFilter[IMAGE].New()
    method.SetInput(0, empty.GetOutput())
    method.SetInput(1, views.GetOutput())
    method.SetGeometry(RTK.read_geometry(str(scan / "geometry.xml")))
    method.GetRampFilter().SetHannCutFrequency(0.0)
    method.Update()
    volume = torch.from_numpy(itk.array_from_image(method.GetOutput()).copy())
    # memory is [z y x] = [front, head, left]; NIfTI's [z y x] is [head, front, right]
    return volume.transpose(0, 1).flip(-1)


def row(name: str, volume: Tensor, other: Tensor, body: Tensor) -> dict[str, str]:
    """Differences of two volumes in 1/mm: relative L2, in the body, and the slope of one on the
    other there.
    """
    apart = volume - other
    inside, base = volume[body].double(), other[body].double()
    slope = (inside * base).sum() / base.square().sum()
    figures = {
        "relative L2": apart.norm() / other.norm(),
        "relative L2 in the body": apart[body].norm() / other[body].norm(),
        "slope": slope,
    }
    return {"difference": name} | {key: f"{value:.4f}" for key, value in figures.items()}


def coronal(volumes: dict[str, Tensor], truth: Tensor, grid: mv.Grid):
    """The picture: one plane of the truth and of every volume, each above its error."""
    title = "chest CT from 180 views: PSNR of the volume"
    case = review.CaseSheets(title, grid, WHITE, "1/mm").about(truth)
    inside = torch.ones_like(truth, dtype=torch.bool)[None]

    def plane(volume: Tensor, scale: ColourScale) -> Panel:
        return case.panels(volume, scale)[1]

    columns = [Column("truth", [plane(truth, case.value()), None])]
    for name, x in volumes.items():
        psnr = volume_metrics(x[None], truth[None], inside, WHITE)["psnr"]
        error = plane(x - truth, case.error(0.25, "error, volume - truth"))
        columns.append(Column(f"{name}\n{psnr:.1f} dB", [plane(x, case.value()), error]))
    return sheet(case.name, columns, (plane(truth, case.value()).name, "error"))


def main(scan: Path, volumes: Path, folder: Path) -> None:
    case = next((scan / "cases").iterdir())
    truth, grid = mv.read_volume(case / "truth.nii.gz")
    truth = attenuation(truth)
    body = truth > BODY
    shown = {path.name.split(".")[0]: path for path in sorted(volumes.glob("*.nii.gz"))}
    shown = {name: attenuation(mv.read_volume(path)[0]) for name, path in shown.items()}
    # HU end at air, and so do mvrecon's volumes here
    peer = rtk_fdk(scan, case / "projections", grid).clamp(min=0)
    rows = [
        row(f"{name} - truth", x, truth, body) for name, x in {**shown, "rtk_fdk": peer}.items()
    ]
    for name in ("fdk_floor", "fdk"):
        rows.insert(0, row(f"{name} - rtk_fdk", shown[name], peer, body))
    write_rows(folder / "results.csv", rows)
    shown.pop("fdk_floor", None)
    named = {"FDK": shown.pop("fdk"), "RTK's FDK": peer}
    named |= {name.upper().replace("_", "-"): x for name, x in shown.items()}
    picture = coronal(named, truth, grid)
    # with a palette the file is a third as large
    Image.fromarray(picture).quantize(method=Image.Quantize.MAXCOVERAGE).save(folder / "planes.png")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
