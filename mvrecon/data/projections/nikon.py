"""Views of Nikon's micro-CT: the images of an .xtekct."""

from glob import escape
from pathlib import Path

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.images import ImageFiles, view_files
from mvrecon.geometry.cameras.formats.nikon import header


class NikonViews(ImageFiles):
    """The images beside an .xtekct, or in its InputFolderName, with its WhiteLevel as flat field
    and its rig.

    Args:
        path: path of the .xtekct.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: no images, an invalid header, or images of another size than it states.
    """

    kind = "intensities"
    mirrored = True

    def __init__(self, path: Path):
        entries = header(path)
        name, mark, folder = (
            entries.texts.get(key, "") for key in ("name", "inputseparator", "inputfoldername")
        )
        home = path.parent.resolve()
        inside = (home / folder).resolve()
        where = inside if inside.is_relative_to(home) and inside.is_dir() else home
        super().__init__(view_files(where, f"{escape(name + mark)}[0-9]*.[tT][iI][fF]*"))
        expected = tuple(int(entries.number(f"DetectorPixels{axis}")) for axis in "YX")
        if self.shape != expected:
            raise Refused(
                f"{path}: states {expected} pixels (rows, columns), the images in {where} have "
                f"{self.shape}"
            )
        self.fields = {"flat": entries.number("WhiteLevel")}
        self.rig = {"name": "nikon", "path": str(path)}
