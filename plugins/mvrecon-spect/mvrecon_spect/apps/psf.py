"""`mvrecon-psf`: fits pinholes to measured views of point sources, and writes the fitted rig and
the widths of the images by depth and angle, which projector.response=psf.csv reads.

Examples:

    mvrecon-psf sources.csv --camera rig.json --diameter 2.3
    mvrecon-psf sources.csv --camera rig.json --diameter 3 2 --iterations 0 --out slits.csv

The columns of sources.csv are x_mm, y_mm, z_mm, views (a file of counts, beside sources.csv) and
optionally photons, the number emitted in the measurement, which gives the efficiency.
"""

import argparse
import sys
from collections.abc import Sequence

import torch

from mvrecon.apps.command_line import command_line
from mvrecon.apps.config.errors import one_line
from mvrecon.core.files.atomic import check_writable
from mvrecon.core.files.checks import Refused, from_home
from mvrecon.core.files.runs import read_rows, write_rows
from mvrecon.data.projections.views import Measured, MeasuredViews
from mvrecon.geometry.cameras import files
from mvrecon_spect.methods.point_sources import fit_point_sources, image_widths
from mvrecon_spect.operators.hole import Hole

#: Columns of the table of sources; photons are optional.
SOURCES = ("x_mm", "y_mm", "z_mm", "views", "photons")
#: Ends the name of the fitted rig.
RIG_ENDING = ".cameras.json"


def parser() -> argparse.ArgumentParser:
    """The command line of `mvrecon-psf`."""
    made = command_line("mvrecon-psf", __doc__)
    made.add_argument("sources", help="CSV file with a row for each point source.")
    made.add_argument(
        "--camera",
        required=True,
        metavar="FILE",
        help="Starts from this nominal rig, such as rig.json of a run.",
    )
    made.add_argument(
        "--diameter",
        nargs="+",
        type=float,
        required=True,
        metavar="MM",
        help="Diameter of a round hole, or the sides (u, v) of a rectangular one, in mm.",
    )
    made.add_argument(
        "--intrinsic",
        type=float,
        default=1.0,
        metavar="MM",
        help="Starts from this intrinsic resolution of the detector, FWHM in mm (default: "
        "%(default)g).",
    )
    made.add_argument(
        "--iterations",
        type=int,
        default=200,
        help="Maximum number of iterations of the fit; 0 keeps the nominal rig (default: "
        "%(default)s).",
    )
    made.add_argument(
        "--least",
        type=float,
        default=200.0,
        metavar="COUNTS",
        help="Leaves out images with fewer counts (default: %(default)g).",
    )
    made.add_argument(
        "--out",
        default="psf.csv",
        metavar="FILE",
        help=f"Writes the table to this file (default: %(default)s), and the rig beside it, with "
        f"the ending {RIG_ENDING}.",
    )
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `mvrecon-psf`."""
    options = parser().parse_args(arguments)
    with one_line("mvrecon-psf"):
        table, out = from_home(options.sources), from_home(options.out)
        rig_file = out.with_name(out.stem + RIG_ENDING)
        rows = read_rows(table)
        if not rows or not {*SOURCES[:4]} <= {*rows[0]} <= {*SOURCES}:
            raise Refused(f"{table}: expected a table of {', '.join(SOURCES)}, got another")
        images = [table.parent / row["views"] for row in rows]
        for place in (out, rig_file):
            check_writable(place, [table, from_home(options.camera), *images])
        points = torch.tensor([[float(row[name]) for name in SOURCES[:3]] for row in rows])
        photons = None
        if "photons" in rows[0]:
            photons = torch.tensor([float(row["photons"]) for row in rows])
        rig = files.from_file(from_home(options.camera))
        stacks = [MeasuredViews(Measured(path=path, kind="counts")) for path in images]
        for stack in stacks:
            stack.cameras(rig)  # refuses views of another rig
        views = torch.stack([stack.whole().views for stack in stacks])
        hole = Hole(options.diameter[0] if len(options.diameter) == 1 else options.diameter)
        if options.iterations:
            fit = fit_point_sources(views, points, rig, hole, options.intrinsic, options.iterations)
            moved = (fit.cameras.source - rig.source).norm(dim=1)
            sys.stdout.write(
                f"holes of {fit.blurring_mm:.3f} mm, intrinsic FWHM {fit.intrinsic_mm:.3f} mm, "
                f"pinholes moved by {moved.mean():.3f} mm on average, {moved.max():.3f} at most\n"
            )
            rig = fit.cameras
        widths = image_widths(views, points, rig, hole, options.least, photons)
        files.save(rig, rig_file)
        write_rows(out, [{name: f"{v:.6g}" for name, v in row.items()} for row in widths])
        sys.stdout.write(
            f"{len(widths)} of {views.shape[0] * views.shape[1]} images are whole; {out}, "
            f"{rig_file}\n"
        )


if __name__ == "__main__":
    main()
