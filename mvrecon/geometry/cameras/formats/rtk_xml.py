"""RTK's ThreeDCircularGeometry as XML (Rit and others, J. Phys. Conf. Ser. 489, 2014)."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import write_text
from mvrecon.core.files.checks import Refused, file_errors, shown, text_of
from mvrecon.core.files.keys import Key
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.formats import common
from mvrecon.geometry.cameras.rigs import Detector, DetectorOptions
from mvrecon.geometry.rigid import euler_rotation, unit

#: The file's elements for one view, in the order of RTK's AddProjection.
WORDS = (
    "SourceToIsocenterDistance",
    "SourceToDetectorDistance",
    "GantryAngle",
    "ProjectionOffsetX",
    "ProjectionOffsetY",
    "OutOfPlaneAngle",
    "InPlaneAngle",
    "SourceOffsetX",
    "SourceOffsetY",
)
#: Elements without a default, unless a matrix confirms RTK's, 0.
REQUIRED = WORDS[:3]
#: Elements of the file; any other is refused, as is one that is stated twice in one place.
KEYS = (
    *(Key(word, "applied", "0 if missing beside a Matrix") for word in REQUIRED),
    *(Key(word, "applied") for word in WORDS[3:7]),
    *(Key(word, "applied", "of cone beams; refused for parallel beams") for word in WORDS[7:]),
    Key("Matrix", "compared", "with the other elements of its projection"),
    Key("RadiusCylindricalDetector", "refused", "the detector is flat", (0,)),
    Key(
        "CollimationUInf, CollimationUSup, CollimationVInf, CollimationVSup",
        "ignored",
        "the views show the shadow of the jaws",
    ),
    Key("version", "refused", "attribute of the root; older angles differ", (3,)),
)
#: Largest difference between a matrix and the other elements, as a fraction of the distances in it:
#: text of six digits passes; an angle differs by 0.001 degrees at most.
MATRIX = 1e-5
#: RTK's document type, the only one accepted; any other could define entities.
DOCTYPE = re.compile(r"\s*<!DOCTYPE\s+RTKGEOMETRY\s*>", re.ASCII)
#: Negligible radians; left in, they make ITK's inverse of a matrix fail.
TINY = 1e-20


def read(
    path: str | Path,
    detector: DetectorOptions,
    world: str = "LPS",
    small_arc: bool = False,
    flip_rows: bool = True,
) -> Cameras:
    """Rig in mm from RTK's geometry XML: cone beams, or parallel beams if SDD is zero.

    Args:
        path: path of the XML file, version 3.
        detector: options of `Detector`: pixels and pixel_mm, each (v, u); offset_mm is 0 if the
            projections' image is centred about its origin; see `detector_of_image`, which
            `mvrecon-reconstruct` uses for views in MHA and NRRD.
        world: axes of the file, "LPS" (ITK's, as RTK writes volumes), "IEC" (a linac's) or "RAS";
            see `to_ras`.
        small_arc: the gantry's angles are degrees although they look like radians.
        flip_rows: must be true: RTK's rows run upwards; the rows of the views must be reversed.

    Convention: RTK: at gantry angle 0 the source is at (0, 0, SID), columns run along x, rows along
    y upwards, and the gantry turns about y.

    Raises:
        OSError: the file cannot be read.
        ValueError: an invalid file, entities, non-finite values, angles in radians, SID > SDD, a
            matrix that contradicts its projection, a cylindrical detector, or `flip_rows` false.
    """
    if not flip_rows:
        raise Refused(f"{path}: RTK's rows run upwards; expected flip_rows=true, got false")
    text, plate = DOCTYPE.sub("", text_of(path), count=1), Detector.of(detector)
    with file_errors(path, "is not an RTK geometry", "expected the XML that RTK writes"):
        if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
            raise ValueError("expected no document type but RTKGEOMETRY, and no entities")
        table = _table(ElementTree.fromstring(text))
        common.check_degrees(table[:, 2].tolist(), small_arc, "GantryAngle")
        return common.from_world(_cameras(table, plate), world)


def detector_of_image(
    size: Sequence[int], spacing_mm: Sequence[float], origin_mm: Sequence[float]
) -> dict[str, tuple]:
    """Options of `Detector` for projections in an ITK image with size, spacing and origin
    (x, y).
    """
    (columns, rows), (right, up), (x, y) = (
        list(pair)[:2] for pair in (size, spacing_mm, origin_mm)
    )
    shift = -(y + up * (rows - 1) / 2), x + right * (columns - 1) / 2
    return {"pixels": (rows, columns), "pixel_mm": (up, right), "offset_mm": shift}


def _table(root: ElementTree.Element) -> Float[Tensor, "m 9"]:
    """The values of all views; as in RTK, the head's values hold for all, and a view's for later
    ones. A view's matrix must agree with them.
    """
    version = root.get("version")
    if root.tag != "RTKThreeDCircularGeometry" or version != "3":
        raise ValueError(
            f"expected RTKThreeDCircularGeometry of version 3, got {shown(root.tag)} of version "
            f"{shown(version)}"
        )
    state, rows, matrices, head = {}, [], {}, ElementTree.Element("head")
    children = list(root)
    _check_bare([root, *children], ("version",))
    tags = [child.tag for child in children]
    if "Projection" in tags and tags[-1] != "Projection":
        raise ValueError(f"expected a Projection last, got {shown(tags[-1])} behind it")
    for child, after in zip(children, [None, *children], strict=False):
        if child.tag == "Projection":
            state |= _stated(child)
            missing = [word for word in REQUIRED if word not in state and "Matrix" not in state]
            if missing:
                raise ValueError(f"expected {missing[0]} of projection {len(rows)}, got none")
            if "Matrix" in state:
                matrices[len(rows)] = state["Matrix"]
            rows.append([state.get(word, [0.0])[0] for word in WORDS])
        else:
            if after is None or after.tag == "Projection":
                head = ElementTree.Element("head")
            head.append(child)
            state |= _stated(head)
    if not 0 < len(rows) <= common.VIEWS:
        raise ValueError(f"expected 1 to {common.VIEWS} projections, got {len(rows)}")
    table = torch.tensor(rows, dtype=torch.float64)
    if matrices:
        _check_matrices(table, matrices)
    return table


def _values(part: ElementTree.Element) -> tuple[str, list[float]]:
    """The numbers of an element, by its name."""
    known = [word for key in KEYS for word in key.names if word != "version"]
    if part.tag not in known:
        raise ValueError(f"expected {', '.join(known)}, got {shown(part.tag)}")
    words, count = (part.text or "").split(), 12 if part.tag == "Matrix" else 1
    if len(words) != count:
        raise ValueError(f"expected {count} numbers for {part.tag}, got {shown(words)}")
    _check_bare([part])
    endless = part.tag.startswith("Collimation")  # RTK writes jaws that are open as 1.8e308
    values = [float(word) if endless else common.number(word, part.tag) for word in words]
    if part.tag == "RadiusCylindricalDetector" and values[0]:
        raise ValueError(f"expected a flat detector, got {part.tag} {values[0]:g}")
    return part.tag, values


def _stated(parent: ElementTree.Element) -> dict[str, list[float]]:
    """The numbers of the elements in one place, each of which has one value."""
    stated: dict[str, list[float]] = {}
    for name, values in map(_values, parent):
        if stated.setdefault(name, values) != values:
            raise ValueError(f"expected one {name}, got {stated[name]} and {values}")
    return stated


def _check_bare(parts: Sequence[ElementTree.Element], attributes: Sequence[str] = ()) -> None:
    """Raise for attributes, for text beside elements, and for elements inside a number."""
    for part in parts:
        unknown = sorted(set(part.keys()) - set(attributes))
        beside = [part.tail or "", *([part.text or ""] if len(part) else [])]
        if unknown or any(text.strip() for text in beside):
            got = f"the attribute {unknown[0]!r}" if unknown else shown("".join(beside).strip())
            raise ValueError(
                f"expected {part.tag} without attributes and text beside it, got {got}"
            )


def _check_matrices(table: Float[Tensor, "m 9"], matrices: Mapping[int, list[float]]) -> None:
    """Raise if a view's matrix is not that of its distances, angles and offsets."""
    views = torch.tensor([*matrices])
    stated = torch.tensor([*matrices.values()], dtype=torch.float64).unflatten(1, (3, 4))
    expected = matrices_of(table[views])
    scale = expected[..., :3].norm(dim=-1, keepdim=True).clamp(min=1.0).repeat(1, 1, 4)
    scale[..., 3] *= table[views, :1].abs().clamp(min=1.0)
    off = (stated - expected).abs() / scale
    if (worst := off.amax(dim=(1, 2))).max() > MATRIX:
        view = int(worst.argmax())
        row, column = divmod(int(off[view].argmax()), 4)
        raise ValueError(
            f"expected the Matrix of projection {views[view]} to be that of its distances, angles "
            f"and offsets, {expected[view, row, column]:g} in row {row}, column {column}, got "
            f"{stated[view, row, column]:g}; was one of them edited?"
        )


def matrices_of(table: Float[Tensor, "m 9"]) -> Float[Tensor, "m 3 4"]:
    """RTK's matrices of views (its ThreeDCircularProjectionGeometry): columns and rows in mm for
    points in mm, up to scale; of parallel beams where SDD is 0.

    Args:
        table: values of each view in the order of `WORDS`.
    """
    sid, sdd, _, x, y, _, _, source_x, source_y = table.unbind(dim=-1)
    axes, rows = _axes(table), []
    for axis, start, offset in ((axes[:, 0], source_x, x), (axes[:, 1], source_y, y)):
        turned = (start - offset)[:, None] * axes[:, 2] - sdd[:, None] * axis
        rows.append(torch.cat([turned, (start * sdd - (start - offset) * sid)[:, None]], dim=1))
        beam = torch.cat([axis, -offset[:, None]], dim=1)
        rows[-1] = torch.where(sdd[:, None] == 0, beam, rows[-1])
    last = torch.cat([axes[:, 2], -sid[:, None]], dim=1)
    rows.append(torch.where(sdd[:, None] == 0, last.new_tensor([0.0, 0, 0, 1]), last))
    return torch.stack(rows, dim=1)


def _axes(table: Float[Tensor, "m 9"]) -> Float[Tensor, "m 3 3"]:
    """Directions of columns, of rows (upwards), and of the source, as rows."""
    gantry, out, inner = table[:, 2], table[:, 5], table[:, 6]
    return euler_rotation(torch.stack([-inner, -out, -gantry], dim=-1), "zxy")


def _cameras(table: Float[Tensor, "m 9"], plate: Detector) -> Cameras:
    sid, sdd, _, x, y, _, _, source_x, source_y = table.unbind(dim=-1)
    parallel = bool((sdd == 0).all())
    if parallel and (torch.stack([source_x, source_y]).any() or (sid < 0).any()):
        raise ValueError(
            "expected parallel beams without SourceOffsetX and SourceOffsetY and with a "
            "SourceToIsocenterDistance from 0, got others"
        )
    if parallel:  # its length is that of a direction
        sid = torch.where(sid == 0, 1.0, sid)
    else:
        common.check_distances(sid, sdd)
    axes = _axes(table)
    looking = axes * axes.new_tensor([1, -1, -1])[:, None]
    source = torch.stack([x if parallel else source_x, y if parallel else source_y, sid], dim=-1)
    centre = torch.stack([x, y, -sid if parallel else sid - sdd], dim=-1)
    source, centre = ((axes.mT @ point[..., None])[..., 0] for point in (source, centre))
    extent = "line" if parallel else "segment"
    return plate.carried(source, centre, looking, parallel, extent)


def write(cameras: Cameras, path: str | Path, world: str = "LPS") -> None:
    """Write a cone-beam rig as RTK's geometry XML (mm, degrees), for RTK and `read`.

    The file contains the detector's centre: the projections' image must be centred about its
    origin, origin = -spacing (size - 1) / 2, with the rows of the views reversed.

    Raises:
        OSError: the file cannot be written.
        ValueError: parallel beams, pinholes, detectors that are not rectangular or differ, SID >
            SDD.
    """
    check(cameras)
    rig = common.into_world(cameras, world)
    right, up = unit(rig.u), -unit(rig.v)
    axes = torch.stack([right, up, torch.linalg.cross(right, up)], dim=1)
    source, centre = (
        (axes * point[:, None]).sum(dim=-1) for point in (rig.source, rig.detector_centre)
    )
    common.check_distances(source[:, 2], source[:, 2] - centre[:, 2])
    angles = [gantry_angles(view) for view in axes.tolist()]
    gantries = common.unmistakable([math.degrees(angle[0]) for angle in angles])
    lines = ['<?xml version="1.0"?>', "<!DOCTYPE RTKGEOMETRY>"]
    lines += ['<RTKThreeDCircularGeometry version="3">']
    places = zip(source.tolist(), centre.tolist(), strict=True)
    for place, gantry, (_, out, inner) in zip(places, gantries, angles, strict=True):
        degrees = gantry, math.degrees(out), math.degrees(inner)
        lines += ["  <Projection>", *_view(*place, degrees), "  </Projection>"]
    write_text(path, "\n".join([*lines, "</RTKThreeDCircularGeometry>\n"]))


def check(cameras: Cameras) -> None:
    """Raise ValueError for a rig that `write` refuses."""
    common.check_cone(cameras, "RTK's XML")
    common.square_pixels(cameras, "RTK")


def _view(
    source: list[float], centre: list[float], degrees: tuple[float, float, float]
) -> list[str]:
    """The lines of one view with gantry, out-of-plane and in-plane angle; RTK rejects a file whose
    matrix does not match its parameters.
    """
    (source_x, source_y, sid), (x, y, depth) = source, centre
    gantry, out, inner = degrees
    sdd = sid - depth
    values = (sid, sdd, gantry, x, y, out, inner, source_x, source_y)
    rows = matrices_of(torch.tensor([values], dtype=torch.float64))[0].tolist()
    lines = [f"<{word}>{value!r}</{word}>" for word, value in zip(WORDS, values, strict=True)]
    lines += ["<Matrix>", *("  " + " ".join(map(repr, row)) for row in rows), "</Matrix>"]
    return ["    " + line for line in lines]


def gantry_angles(axes: list[list[float]]) -> tuple[float, float, float]:
    """Gantry, out-of-plane and in-plane angle in radians of axes u, v, n = Rz(-inner) Rx(-out)
    Ry(-gantry), exact in every pose.

    One camera at a time, as torch's rounding depends on the position in a batch.
    """
    (ux, uy, uz), _, (nx, ny, nz) = axes
    gantry, out = math.atan2(nx, nz), math.atan2(-ny, math.hypot(nx, nz))
    # direction of columns at zero in-plane angle; n x that is the direction of rows
    rx, rz = math.cos(gantry), -math.sin(gantry)
    inner = math.atan2(ux * ny * rz + uy * (nz * rx - nx * rz) - uz * ny * rx, ux * rx + uz * rz)
    gantry, out, inner = (0.0 if abs(angle) < TINY else angle for angle in (gantry, out, inner))
    return gantry, out, inner
