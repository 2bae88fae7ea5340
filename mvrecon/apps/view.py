"""`mvrecon-view`: writes a volume and its rig to one HTML file, for any browser, offline.

Examples:

    mvrecon-view volume.nii.gz
    mvrecon-view volume.nii.gz rig.json --window -1000 1000 --first mip
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from mvrecon.apps.command_line import command_line
from mvrecon.apps.config.errors import one_line
from mvrecon.core.files.atomic import check_writable, write_text
from mvrecon.core.files.checks import from_home

#: What can be seen first; `viz.page` makes all of them.
PICTURES = ("slices", "mip", "volume")


def view(
    volume: str | Path,
    cameras: str | Path | None = None,
    out: str | Path | None = None,
    window: tuple[float, float] | None = None,
    first: str = "slices",
) -> Path:
    """Write the page of a volume, and return its path.

    Args:
        volume: a file that `mvrecon.read_volume` reads, or the folder of a DICOM series.
        cameras: mvrecon's file of a rig, such as `rig.json` of a run.
        out: the page; by default the volume's name with .html, in the working folder.
        window: values that are black and white, in the volume's unit.
        first: the initial picture, one of `PICTURES`.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: a library of the extras `view` or `io` is not installed.
        ValueError: a file that cannot be read, or see `mvrecon.report.viz.page.page`.
    """
    from mvrecon.data.volume_files import name_of, read_volume
    from mvrecon.geometry.cameras.files import from_file
    from mvrecon.report.viz.page import page

    path = from_home(volume)
    place = from_home(out or f"{name_of(path)}.html").absolute()
    check_writable(place, [from_home(one) for one in (volume, cameras) if one is not None])
    rig = None if cameras is None else from_file(from_home(cameras))
    values, grid = read_volume(path)
    text = page(values, grid, rig, window, first, name_of(path))
    write_text(place, text)
    return place


def parser() -> argparse.ArgumentParser:
    """The command line of `mvrecon-view`."""
    made = command_line("mvrecon-view", __doc__)
    made.add_argument(
        "volume", help="File of the volume (NIfTI, MHA, MHD, NRRD), or folder of a DICOM series."
    )
    made.add_argument("cameras", nargs="?", help="File of the rig, such as rig.json of a run.")
    made.add_argument(
        "--out",
        metavar="FILE",
        help="Writes this HTML file (default: <volume>.html in the current folder).",
    )
    made.add_argument(
        "--window",
        nargs=2,
        type=float,
        metavar=("LOW", "HIGH"),
        help="Shows these values, in the volume's unit, as black and white (default: the 1st and "
        "the 99.9th percentile).",
    )
    made.add_argument(
        "--first",
        choices=PICTURES,
        default="slices",
        help="Shows this picture first: slices, maximum-intensity projection or volume rendering "
        "(default: %(default)s).",
    )
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `mvrecon-view`."""
    options = parser().parse_args(arguments)
    window = None if options.window is None else (options.window[0], options.window[1])
    with one_line("mvrecon-view"):
        place = view(options.volume, options.cameras, options.out, window, options.first)
    sys.stdout.write(f"{place}, {place.stat().st_size / 2**20:.1f} MiB: open it in a browser\n")


if __name__ == "__main__":
    main()
