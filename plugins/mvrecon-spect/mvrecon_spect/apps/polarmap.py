"""`mvrecon-polarmap`: writes the polar map of a left ventricle as a picture, and the means of its
17 segments as CSV.

Examples:

    mvrecon-polarmap volume.nii.gz --base 40 -40 -20 --apex 10 -60 40 --septum -1 0 0
    mvrecon-polarmap heart.nii.gz --base 40 -40 -20 --apex 10 -60 40 --septum -1 0 0 --reach 40

Positions are in world coordinates, in mm. Means are in the unit of the volume, and in per cent of
the greatest value.
"""

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mvrecon.apps.command_line import command_line
from mvrecon.apps.config.errors import one_line
from mvrecon.core.files.atomic import check_writable, written_whole
from mvrecon.core.files.checks import from_home
from mvrecon.core.files.runs import write_rows
from mvrecon.data.volume_files import name_of, read_volume
from mvrecon_spect.metrics.polar_map import LongAxis, polar_map, segments

#: Endings of the files: means of the segments, and the map.
ENDINGS = (".segments.csv", ".polarmap.png")
#: Names of the segments, from 1 (Cerqueira et al. 2002).
WALLS = ("anterior", "anteroseptal", "inferoseptal", "inferior", "inferolateral", "anterolateral")
NAMES = (
    *(f"{ring} {wall}" for ring in ("basal", "mid") for wall in WALLS),
    *(f"apical {wall}" for wall in ("anterior", "septal", "inferior", "lateral")),
    "apex",
)


def draw_maps(path: str | Path, rows: Sequence[Mapping[str, Float[Tensor, "r a"]]]) -> None:
    """Rows of polar maps by their titles, each relative to its greatest value; anterior on top, the
    septum on the left. Rows end together.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    across = max(map(len, rows))
    figure = Figure((1.35 * across + 1.3, 2.0 * len(rows) + 0.8), layout="constrained")
    polar = {"projection": "polar", "theta_offset": math.pi / 2}
    panels = figure.subplots(len(rows), across, squeeze=False, subplot_kw=polar)
    for panel in panels.ravel():
        panel.axis("off")
    for line, maps in zip(panels, rows, strict=True):
        for panel, (name, values) in zip(line[-len(maps) :], maps.items(), strict=True):
            radii, angles = values.shape
            turn = 2 * np.pi * (np.arange(angles + 1) - 0.5) / angles
            radius, share = np.linspace(1, 0, radii + 1), (values / values.max()).numpy()
            panel.pcolormesh(turn, radius, share, cmap="inferno", vmin=0, vmax=1)
            panel.set_title(name, fontsize=9)
    scale = ScalarMappable(Normalize(0, 1), "inferno")
    figure.colorbar(scale, ax=panels, label="activity / maximum", shrink=0.8)
    with written_whole(path) as part:
        figure.savefig(part, dpi=110, format="png")


def parser() -> argparse.ArgumentParser:
    """The command line of `mvrecon-polarmap`."""
    made = command_line("mvrecon-polarmap", __doc__)
    made.add_argument("volume", help="NIfTI, MHA, MHD, NRRD or DICOM file, or folder of a series.")
    ends = {
        "base": "End of the long axis in the valve plane, in world mm.",
        "apex": "End of the long axis at the tip of the myocardium, in world mm.",
        "septum": "Direction from the long axis to the centre of the septum.",
    }
    for name, words in ends.items():
        made.add_argument(
            f"--{name}", nargs=3, type=float, required=True, metavar=("X", "Y", "Z"), help=words
        )
    made.add_argument(
        "--reach",
        type=float,
        default=45.0,
        metavar="MM",
        help="Takes the maximum of each ray up to this distance from the axis, in mm: beyond the "
        "wall and short of other organs (default: %(default)g).",
    )
    made.add_argument(
        "--out",
        metavar="NAME",
        help=f"Writes NAME{ENDINGS[0]} and NAME{ENDINGS[1]} (default: the volume's name).",
    )
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `mvrecon-polarmap`."""
    options = parser().parse_args(arguments)
    with one_line("mvrecon-polarmap"):
        path = from_home(options.volume)
        places = [from_home(f"{options.out or name_of(path)}{ending}") for ending in ENDINGS]
        for place in places:
            check_writable(place)
        axis = LongAxis(options.base, options.apex, options.septum)
        values = polar_map(*read_volume(path), axis, options.reach)
        means = segments(values)
        most = values.max().item()
        if not most > 0:
            raise ValueError(f"{path}: expected activity about the axis, got none")
        rows = [
            {
                "segment": k,
                "name": name,
                "mean": f"{mean:.6g}",
                "percent_of_maximum": f"{100 * mean / most:.2f}",
            }
            for k, (name, mean) in enumerate(zip(NAMES, means.tolist(), strict=True), 1)
        ]
        write_rows(places[0], rows)
        draw_maps(places[1], [{name_of(path): values}])
        for row in rows:
            sys.stdout.write(
                f"{row['segment']:2d} {row['name']}: {row['mean']} "
                f"({row['percent_of_maximum']} % of the maximum)\n"
            )
        sys.stdout.write(f"{', '.join(map(str, places))}\n")


if __name__ == "__main__":
    main()
