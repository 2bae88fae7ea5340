"""Projections by what a path leads to."""

from pathlib import Path

from mvrecon.data.dicom import dicom_file
from mvrecon.data.projections.images import PILLOW, ImageFiles, field_files, image_folder
from mvrecon.data.projections.stack import ProjectionStack
from mvrecon.files.checks import Refused
from mvrecon.parts import VIEW_FILES


def open_projections(
    path: str | Path, pattern: str | None = None, gaps: bool = False
) -> ProjectionStack:
    """Projections in the values and the order they are stored in, read view by view.

    The endings of files with one array are those of the registry `VIEW_FILES`, a plugin's among
    them. A folder of images is in the order of the numbers in their names, without those that begin
    with dark or flat; a file of several pages or an array, in its own order.

    Args:
        path: a folder, or a file.
        pattern: of the names of the views in a folder, such as "scan_*.tif"; none: all images.
        gaps: allow numbers in unequal steps in a folder.

    Warns:
        UserWarning: names that differ in more than their numbers.

    Raises:
        FileNotFoundError: nothing is there.
        ImportError: a library of the extra `io` is not installed.
        Refused: an empty folder, images of several sizes, missing numbers, other endings, damage.
    """
    path = Path(path).expanduser()
    if path.is_dir():
        return image_folder(path, pattern, gaps)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file or folder; expected {_expected()}")
    if pattern is not None:
        raise Refused(f"{path}: expected a folder for the pattern {pattern!r}, got a file")
    if (ending := path.suffix.lower().lstrip(".")) in VIEW_FILES.names():
        return VIEW_FILES.build(ending, path)
    if path.suffix.lower() in PILLOW or dicom_file(path):
        return ImageFiles([path])
    raise Refused(f"{path}: expected {_expected()}")


def field_beside(path: Path, field: str) -> ProjectionStack | None:
    """The field, "dark" or "flat", that lies in a folder of views: a folder of that name, or images
    whose names begin so; none where there is none.
    """
    if not path.is_dir():
        return None
    if (path / field).is_dir():
        return open_projections(path / field)
    files = field_files(path, field)
    return ImageFiles(files) if files else None


def _expected() -> str:
    endings = [*PILLOW, ".dcm", *(f".{ending}" for ending in VIEW_FILES.names())]
    return f"a folder of TIFF, PNG or DICOM images, or a file that ends in {', '.join(endings)}"
