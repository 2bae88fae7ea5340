"""`mvrecon-mtf`: measures the modulation transfer function of a volume along x, y and z, from the
edges of balls at their positions and of planes.

Examples:

    mvrecon-mtf volume.nii.gz
    mvrecon-mtf volume.nii.gz --ball 0 0 0 40 --ball 60 0 10 40 --out centre
    mvrecon-mtf volume.nii.gz --plane 0 0 20 0.1 0.06 1 --reach 15

Positions and lengths are in mm, frequencies in 1/mm.
"""

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from mvrecon.apps.command_line import command_line
from mvrecon.apps.config.errors import one_line
from mvrecon.core.files.atomic import check_writable, written_whole
from mvrecon.core.files.checks import from_home
from mvrecon.core.files.runs import write_rows
from mvrecon.data.volume_files import name_of, read_volume
from mvrecon_spect.metrics.edge import Ball, Mtf, ball_mtf, balls, plane_mtf

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
#: Endings of the files: figures, curves and their picture.
ENDINGS = (".mtf.csv", ".mtf_curves.csv", ".mtf.png")


class Curve(NamedTuple):
    """The MTF of an edge: its name, its position (x, y, z) in mm, the diameter of a ball in mm, and
    the direction.
    """

    name: str
    place: Sequence[float]
    diameter: float | None
    axis: str
    mtf: Mtf

    def row(self) -> dict[str, object]:
        """Figures, lengths in mm and frequencies in 1/mm."""
        x, y, z = (f"{value:.3f}" for value in self.place)
        return {
            "edge": self.name,
            **{"x_mm": x, "y_mm": y, "z_mm": z},
            "diameter_mm": "" if self.diameter is None else f"{self.diameter:.2f}",
            "axis": self.axis,
            "mtf50_per_mm": f"{self.mtf.falls_to(0.5):.5g}",
            "mtf10_per_mm": f"{self.mtf.falls_to(0.1):.5g}",
        }


def measure(
    path: str | Path,
    given: Sequence[Ball] = (),
    planes: Sequence[Sequence[float]] = (),
    reach: float = 15.0,
    cone_degrees: float = 30.0,
) -> list[Curve]:
    """The curves of a volume's balls along x, y and z, and of its planes along their normals.

    Args:
        path: a file that `mvrecon.read_volume` reads.
        given: balls; without any and without planes, those that `balls` finds.
        planes: a point and the normal of each, (x, y, z, nx, ny, nz).
        reach: mm from the point of a plane that are uniform, see `plane_mtf`.
        cone_degrees: half-angle of the cones in balls, in degrees, see `ball_mtf`.

    Raises:
        ValueError: no ball is found, or see `ball_mtf` and `plane_mtf`.

    Warns:
        UserWarning: balls that are found and cannot be measured, as at the grid's edge.
    """
    volume, grid = read_volume(path)
    found = [] if given or planes else balls(volume, grid)
    curves = []
    for k, ball in enumerate([*given, *found]):
        try:
            of_ball = [
                Curve(f"ball {k}", *ball, axis, ball_mtf(volume, grid, *ball, along, cone_degrees))
                for axis, along in AXES.items()
            ]
        except ValueError as error:
            if given:
                raise
            warnings.warn(f"Left out a ball at {ball.centre} mm: {error}", stacklevel=2)
            continue
        curves += of_ball
    for k, (x, y, z, *normal) in enumerate(planes):
        mtf = plane_mtf(volume, grid, (x, y, z), normal, reach)
        curves.append(Curve(f"plane {k}", (x, y, z), None, "normal", mtf))
    if not curves:
        raise ValueError(
            f"{path}: expected hot balls of 8 voxels across or more, got none; --ball and --plane "
            f"give the edges"
        )
    return curves


def draw(path: Path, curves: Sequence[Curve]) -> None:
    """One panel for each direction, one line for each position."""
    from matplotlib.figure import Figure

    axes = list(dict.fromkeys(curve.axis for curve in curves))
    figure = Figure((4 * len(axes) + 2, 3.6), layout="constrained")
    panels = figure.subplots(1, len(axes), sharey=True, squeeze=False)[0]
    for axis, panel in zip(axes, panels, strict=True):
        for curve in (curve for curve in curves if curve.axis == axis):
            place = ", ".join(f"{value:.0f}" for value in curve.place)
            panel.plot(*curve.mtf, label=f"{curve.name} at ({place}) mm")
        panel.set(title=f"along {axis}", xlabel="spatial frequency in 1/mm", ylim=(0, 1.1))
        panel.axhline(0.5, color="0.8", linewidth=0.8, zorder=0)
    panels[0].set_ylabel("MTF")
    panels[-1].legend(fontsize=7)
    with written_whole(path) as part:
        figure.savefig(part, dpi=110, format="png")


def parser() -> argparse.ArgumentParser:
    """The command line of `mvrecon-mtf`."""
    made = command_line("mvrecon-mtf", __doc__)
    made.add_argument("volume", help="NIfTI, MHA, MHD, NRRD or DICOM file, or folder of a series.")
    made.add_argument(
        "--ball",
        nargs=4,
        type=float,
        action="append",
        default=[],
        metavar=("X", "Y", "Z", "DIAMETER"),
        help="Measures the edge of this ball: centre in world coordinates and diameter, in mm. May "
        "be given several times; without --ball and --plane, hot balls are found.",
    )
    made.add_argument(
        "--plane",
        nargs=6,
        type=float,
        action="append",
        default=[],
        metavar=("X", "Y", "Z", "NX", "NY", "NZ"),
        help="Measures across this plane: a point of it in world mm, and its normal. May be given "
        "several times.",
    )
    made.add_argument(
        "--reach",
        type=float,
        default=15.0,
        metavar="MM",
        help="Distance from the point of a plane, in mm, within which each side of it is uniform "
        "(default: %(default)g).",
    )
    made.add_argument(
        "--cone",
        type=float,
        default=30.0,
        metavar="DEGREES",
        help="Half-angle of the two cones about an axis in which the edge of a ball is used, in "
        "degrees (default: %(default)g).",
    )
    made.add_argument(
        "--out",
        metavar="NAME",
        help=f"Writes NAME{ENDINGS[0]}, NAME{ENDINGS[1]} and NAME{ENDINGS[2]} (default: the "
        f"volume's name).",
    )
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `mvrecon-mtf`."""
    options = parser().parse_args(arguments)
    with one_line("mvrecon-mtf"):
        path = from_home(options.volume)
        places = [from_home(f"{options.out or name_of(path)}{ending}") for ending in ENDINGS]
        for place in places:
            check_writable(place)
        given = [Ball((x, y, z), diameter) for x, y, z, diameter in options.ball]
        curves = measure(path, given, options.plane, options.reach, options.cone)
        rows = [curve.row() for curve in curves]
        write_rows(places[0], rows)
        write_rows(
            places[1],
            [
                {"edge": c.name, "axis": c.axis, "frequency_per_mm": f"{f:.5g}", "mtf": f"{v:.5g}"}
                for c in curves
                for f, v in zip(*(values.tolist() for values in c.mtf), strict=True)
            ],
        )
        draw(places[2], curves)
        for row in rows:
            sys.stdout.write(
                f"{row['edge']} at ({row['x_mm']}, {row['y_mm']}, {row['z_mm']}) mm along "
                f"{row['axis']}: 0.5 at {row['mtf50_per_mm']} / mm, 0.1 at {row['mtf10_per_mm']}\n"
            )
        sys.stdout.write(f"{', '.join(map(str, places))}\n")


if __name__ == "__main__":
    main()
