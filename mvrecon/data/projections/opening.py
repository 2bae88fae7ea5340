"""Projections, dark and flat fields and masks of bad pixels, opened by their paths."""

import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from h5py import Dataset
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.files.checks import Refused
from mvrecon.core.files.keys import IMAGE_EFFECTS, warn_of_unknown
from mvrecon.core.parts import VIEW_FILES
from mvrecon.data.dicom_image import dicom_file, same
from mvrecon.data.linked import UNITS, Place, followed, listing, unknown_attributes, values_at
from mvrecon.data.projections.exposures import exposure_names, relative_exposure, warn_of_others
from mvrecon.data.projections.faults import read_mask
from mvrecon.data.projections.images import ENDINGS, ImageFiles, field_files, in_field, view_files
from mvrecon.data.projections.nexus import IN_FILE, hdf5_views, in_another
from mvrecon.data.projections.sinograms import Sinograms, as_rows
from mvrecon.data.projections.stack import ProjectionStack
from mvrecon.data.storage import opened
from mvrecon.geometry.cameras.formats.common import Column, numbers_in

Layout = Literal["projections", "sinogram"]
Field = float | str | Path | None

#: Exposures, relative to the flat field's; with what makes them others, and with other factors.
EXPOSURES = Column(
    "exposures",
    re.compile(r"exposure|time|mas\b", re.IGNORECASE),
    {r"inver|recipro|(?<!\d)1 ?/|(?<![a-z])log|correct|elapsed|since|cumul": None},
    {
        **IMAGE_EFFECTS,
        r"current|(?<![a-z])[mu]as?(?![a-z])|frames|attenuat|transmi|dose|filter|monitor": None,
    },
)
#: Share by which the means of a flat field's images may differ, as before and after a scan.
MAX_FLAT_CHANGE = 0.02
#: Share by which the means of a flat field's parts may differ, as of a beam that moves.
MAX_PART = 0.1
#: Share, and standard deviations of the pixels, by which images of one field do not differ.
MAX_CHANGE, MAX_DEVIATIONS = 0.5, 10


def open_projections(
    path: str | Path,
    pattern: str | None = None,
    gaps: bool = False,
    fields: Sequence[Field] = (),
    layout: Layout | None = None,
    field: str | None = None,
    **names: str | Path | None,
) -> ProjectionStack:
    """Open projections, read view by view in their stored values and order.

    Endings of files are those of the registry `VIEW_FILES`, including plugins'; `<file>:<name>` is
    a data set of an HDF5 file.
    Images of a folder are sorted by the numbers in their names, without dark and flat fields
    (dark*, flat*, and Octopus's di0001 and io0001); files of several pages or arrays keep their
    order.

    Args:
        path: a folder, or a file.
        pattern: pattern of the views' names in a folder, such as "scan_*.tif"; None: all images.
        gaps: allow numbers in unequal steps in a folder.
        fields: dark and flat fields, whose files in the folder are not views.
        layout: "sinogram": images of slices with the angles as rows.
        field: "flat" or "dark": open these frames of an HDF5 file, or all if it has no such ones.
        names: names of data sets in the file; see `hdf5_views`.

    Warns:
        UserWarning: names that differ in more than their numbers, chosen by a pattern or none
            numbered.

    Raises:
        FileNotFoundError: nothing is there.
        ImportError: a library of the extra `io` or `rtk` is not installed.
        Refused: an empty folder, a folder of a simulated case, images of several sizes or kinds of
            names, missing numbers, truth values, other endings, damage.
    """
    given = {option: name for option, name in names.items() if name is not None}
    stack = _opened(Path(path).expanduser(), pattern, gaps, fields, layout, field, given)
    if stack.dtype.kind == "b":  # of masks alone
        raise Refused(f"{path}: expected pixels that are integers or floats, got {stack.dtype}")
    return Sinograms(stack) if layout == "sinogram" else stack


def _opened(
    path: Path,
    pattern: str | None,
    gaps: bool,
    fields: Sequence[Field],
    layout: Layout | None,
    field: str | None,
    names: dict[str, str | Path],
) -> ProjectionStack:
    """The images as they are stored."""
    if not path.exists() and (inside := IN_FILE.fullmatch(str(path))):
        path, names["dataset"] = Path(inside["path"]), inside["name"]
    ending = path.suffix.lower().lstrip(".")
    if path.is_file() and path.suffix.lower() not in ENDINGS and ending not in VIEW_FILES.names():
        ending = "dcm" if dicom_file(path) else ending  # whatever its name is
    reader = ending if path.is_file() and ending in VIEW_FILES.names() else None
    if unused := [o for o in names if reader is None or not VIEW_FILES.takes(reader, o)]:
        raise Refused(
            f"{path}: expected an HDF5 file (.h5, .nxs) for views.{unused[0]}, got another"
        )
    if path.is_dir():
        if pattern is None and (numbers := path / "views.h5").is_file():
            raise Refused(f"{path}: expected {numbers}, whose values the pictures beside it show")
        known = [Path(field).expanduser() for field in fields if isinstance(field, str | Path)]
        return ImageFiles(view_files(path, pattern, gaps, known))
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file or folder; expected {_expected()}")
    if pattern is not None:
        raise Refused(f"{path}: expected a folder for the pattern {pattern!r}, got a file")
    if reader is not None:
        options = {"layout": layout, "field": field}
        options = {o: v for o, v in options.items() if VIEW_FILES.takes(reader, o)}
        return VIEW_FILES.build(reader, path, **names, **options)
    if path.suffix.lower() in ENDINGS or dicom_file(path):
        return ImageFiles([path])
    raise Refused(f"{path}: expected {_expected()}")


def _expected() -> str:
    endings = dict.fromkeys([*ENDINGS, ".dcm", *(f".{ending}" for ending in VIEW_FILES.names())])
    return (
        f"a folder of TIFF, PNG, DICOM or RTK's images, or a file that ends in {', '.join(endings)}"
    )


def bad_pixels(path: str | Path, shape: tuple[int, int]) -> Bool[Tensor, "v u"]:
    """Bad pixels of a file of the views' size; raises Refused for others."""
    path = Path(path).expanduser()
    stack = _opened(path, None, False, (), None, "mask", {})  # of no frames
    if stack.n_views > 1:
        raise Refused(f"{path}: expected one image of bad pixels, got {stack.n_views}")
    warn_of_unknown(path, stack.unknown)
    return read_mask(path, shape, stack.read(0, 1)[0].numpy())


def exposures(
    path: str | Path, stack: ProjectionStack, where: Path, flat: Field, layout: Layout | None
) -> Float[Tensor, " m"]:
    """The exposure of each view relative to the flat field's; see `Measured`.

    Args:
        path: path of a file of numbers, or names by which views and flat field state them, with
            `*`.
        stack: the views as they are stored.
        where: their path.
        flat: the option `flat`.
        layout: layout of the views.

    Raises:
        FileNotFoundError: nothing is there, and the views do not state it.
        Refused: not one positive number for each view, or what else views and flat field state
            contradicts names; see `relative_exposure`.
    """
    if names := exposure_names(stack, path):
        values = relative_exposure(stack, _field(stack, where, "flat", flat, layout), names)
    elif place := _place_in(stack, path) or in_another(path):
        values = np.ravel(values_at(place, UNITS)).astype(float)
        if stack.kept is not None and len(values) == len(stack.kept):  # of all frames
            values = values[stack.kept]
        warn_of_unknown(place.path, unknown_attributes(place))
    else:
        try:
            values = np.array(numbers_in(path, EXPOSURES)[1])
        except FileNotFoundError as error:
            known = [name for name in stack.stated if exposure_names(stack, name)]
            raise FileNotFoundError(
                f"{error}{_absent(stack, f'data set {path}')}; by name, each view states "
                f"{', '.join(known) or 'no exposure'}"
            ) from error
    if len(values) != stack.n_views or not (np.isfinite(values) & (values > 0)).all():
        raise Refused(
            f"{path}: expected a positive exposure for each of {stack.n_views} views on disk, "
            f"relative to the flat field's, got {len(values)} from {values.min():.4g} to "
            f"{values.max():.4g}"
        )
    return torch.from_numpy(values).float()


def mean_field(
    views: ProjectionStack,
    where: Path,
    name: str,
    value: Field,
    layout: Layout | None,
    exposure: str | Path | None = None,
    used: Collection[str] = (),
) -> Float[Tensor, "v u"]:
    """A field in grey values: a number, the mean of images, or the folder's own.

    Args:
        views: the views as they are stored.
        where: their path.
        name: dark or flat.
        value: the option of this name.
        layout: layout of the views.
        exposure: the option `exposure`.
        used: names of data sets that options use.

    Warns:
        UserWarning: images of a flat field that differ, or a field of another exposure or beam than
            the views, unless a file states exposures; unknown keys that the views do not have, or
            other units.

    Raises:
        Refused: several, no flat one, or one of another size or another part of the detector, of
            the views themselves, or of images of several fields.
    """
    stack = _field(views, where, name, value, layout)
    if isinstance(stack, int | float):
        return torch.full(views.shape, float(stack))
    if stack is None and name == "dark":
        return torch.zeros(views.shape)
    if stack is None:
        raise Refused(
            f"{where}: expected a flat field for intensities; give flat=<path or grey value>, "
            f"or kind=integrals or kind=counts (of a command, views.flat and views.kind)"
            f"{_absent(views, 'flat field')}"
        )
    if stack.shape != views.shape:
        raise Refused(
            f"{stack.path}: expected a {name} field of the views' {views.shape} pixels, "
            f"got {stack.shape}"
        )
    theirs = _detector(stack)
    for key, own in _detector(views).items():
        other = theirs.get(key)
        if own is not None and other is not None and not same(own, other):
            raise Refused(
                f"{stack.path}: expected a {name} field with the {key} {own} of the views, got "
                f"{other}; pixels must be those of the views"
            )
    unknown = sorted({*stack.unknown} - {*views.unknown, *used})
    if len({units.casefold() for units in (stack.units, views.units) if units}) > 1:
        unknown.append(f"{name}@units={stack.units}")
    warn_of_unknown(stack.path, unknown)
    _compare_bits(views, stack, name)
    mean, parts = stack.mean()
    _check_alike(stack.path, name, mean, parts)
    applied = exposure_names(views, exposure)
    if applied or exposure is None or name == "dark":
        warn_of_others(views, stack, name, applied)
    return mean


def _compare_bits(views: ProjectionStack, stack: ProjectionStack, name: str) -> None:
    """Warn of a field whose pixels have another number of bits than those of the views: 8 and 16 by
    their types, or as files state less than all bits of these.
    """
    try:
        tops = [one.top for one in (views, stack)]
    except Refused:  # several: a saturation is given
        return
    kinds = [one.dtype for one in (views, stack)]
    if any(kind.kind not in "iu" or kind.itemsize > 2 for kind in kinds):
        return
    stated = [top != np.iinfo(kind).max for top, kind in zip(tops, kinds, strict=True)]
    bits = tops if all(stated) else [kind.itemsize for kind in kinds]  # whatever their sign
    if bits[0] != bits[1] and stated[0] == stated[1]:
        warnings.warn(
            f"{stack.path}: the {name} field's greatest grey value is {tops[1]:g} by its bits, "
            f"that of the views {tops[0]:g}; are both stored on one scale?",
            stacklevel=3,
        )


def _check_alike(
    path: Path, name: str, mean: Float[Tensor, "v u"], parts: Float[Tensor, "m i j"]
) -> None:
    """Check that a field's images show the same: their mean, and means of their parts.

    Warns:
        UserWarning: images of a flat field that differ.

    Raises:
        Refused: images of several fields.
    """
    levels = parts.mean(dim=(1, 2))
    least, most, level = levels.min().item(), levels.max().item(), abs(levels.mean().item())
    if most - least > max(MAX_CHANGE * level, MAX_DEVIATIONS * mean.std(correction=0).item()):
        raise Refused(
            f"{path}: expected images of the {name} field alone, got some with means of {least:g} "
            f"to {most:g}; move those of another field, or views, to a folder of their own"
        )
    if name == "dark":
        return
    if most - least > MAX_FLAT_CHANGE * level:
        warnings.warn(
            f"{path}: images of the flat field have means of {least:g} to {most:g}; "
            f"views are divided by their mean, which does not follow the beam",
            stacklevel=3,
        )
    elif (change := (parts.amax(dim=0) - parts.amin(dim=0)).max().item()) > MAX_PART * level:
        warnings.warn(
            f"{path}: images of the flat field differ by up to {100 * change / level:.0f} % in "
            f"parts of the detector; are views among them, or does the beam move?",
            stacklevel=3,
        )


def _detector(stack: ProjectionStack) -> Mapping[str, Any]:
    """What files state of the detector, by name; of an image with places, also those of its
    pixels.
    """
    if stack.affine is None:
        return stack.detector
    return {**stack.detector, "pixel sizes and Offset": stack.affine[:2, [0, 1, 3]].tolist()}


def _field(
    views: ProjectionStack, where: Path, name: str, value: Field, layout: Layout | None
) -> ProjectionStack | float | None:
    """A field's images or its grey value; None where there is none."""
    own = views.fields.get(name) if value is None else value
    if isinstance(own, int | float):
        return own
    inside = sorted(where.glob("*/")) if value is None and where.is_dir() else []
    folders = [folder for folder in inside if folder.name.lower().startswith(name)]
    files = field_files(where, name) if value is None and where.is_dir() else []
    files = [file for file in files if file not in getattr(views, "files", ())]
    if len(folders) + bool(files) > 1:
        names = ", ".join(path.name for path in (*folders, *files[:1]))
        raise Refused(
            f"{where}: expected one folder of {name} fields, or images, got {names}; choose by "
            f"{name}=<path> (of a command, views.{name})"
        )
    if isinstance(own, ProjectionStack):
        return own
    if value is not None:
        return _field_at(views, name, str(value), layout)
    if folders:
        return ImageFiles(in_field(folders[0], name))
    return ImageFiles(files) if files else None


def _field_at(
    views: ProjectionStack, name: str, value: str, layout: Layout | None
) -> ProjectionStack | float:
    """A field by its name in the scan's HDF5 file, or by its own path."""
    folder = Path(value).expanduser().is_dir()
    if views.scan and not folder and _place_in(views, value):
        stack: ProjectionStack | float = hdf5_views(views.scan, value, field=name)
    else:
        try:
            path = Path(value).expanduser()
            other = (
                ImageFiles(in_field(path, name)) if folder else open_projections(path, field=name)
            )
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{error}{_absent(views, f'data set {value}')}") from error
        own = path.resolve() == views.path.resolve() and other.names == views.names
        if name in other.fields:  # of a scan
            stack = other.fields[name]
        elif own or _files(views) & _files(other):
            raise Refused(f"{value}: expected images of the {name} field, got those of the views")
        else:
            stack = other
    if layout == "sinogram" and isinstance(stack, ProjectionStack):
        return as_rows(stack, views.shape)
    return stack


def _files(stack: ProjectionStack) -> set[Path]:
    """The files of a stack of images; none of other stacks."""
    return {file.resolve() for file in getattr(stack, "files", ())}


def _place_in(views: ProjectionStack, name: str | Path) -> Place | None:
    """The data set of a name in the scan's HDF5 file; None if there is none, or a file of it."""
    if views.scan is None or Path(name).expanduser().is_file():
        return None
    if (place := followed(views.scan, str(name))) is None:
        return None
    with opened(place.path) as file:
        return place if isinstance(file[place.name], Dataset) else None


def _absent(views: ProjectionStack, name: str) -> str:
    """The end of a message: that the scan's HDF5 file lacks what is named; else empty."""
    if views.scan is None:
        return ""
    return f"; {views.scan} has no {name}, it contains {listing(views.scan)}"
