"""RTK's ThreeDCircularGeometry as XML (Rit and others, J. Phys. Conf. Ser. 489, 2014)."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, file_errors, shown, text_of
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.formats import common
from mvrecon.geometry.cameras.rigs import Detector
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
#: Elements without effect on the rays, and those that must be zero.
IGNORED = {"Matrix", "CollimationUInf", "CollimationUSup", "CollimationVInf", "CollimationVSup"}
ZERO = {"RadiusCylindricalDetector"}
#: RTK's document type, the only one accepted; any other could define entities.
DOCTYPE = re.compile(r"\s*<!DOCTYPE\s+RTKGEOMETRY\s*>", re.ASCII)
#: Negligible radians; left in, they make ITK's inverse of a matrix fail.
TINY = 1e-20


def read(
    path: str | Path,
    detector: Mapping[str, Any],
    world: str = "LPS",
    small_arc: bool = False,
    flip_rows: bool = True,
) -> Cameras:
    """Rig in mm from RTK's geometry XML: cone beams, or parallel beams if SDD is zero.

    Args:
        path: of the XML, version 3.
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
            cylindrical detector, or `flip_rows` false.
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
    ones.
    """
    version = root.get("version")
    if root.tag != "RTKThreeDCircularGeometry" or version != "3":
        raise ValueError(
            f"expected RTKThreeDCircularGeometry of version 3, got {shown(root.tag)} of version "
            f"{shown(version)}"
        )
    state, rows = dict.fromkeys(WORDS, 0.0), []
    for child in root:
        if child.tag == "Projection":
            state |= dict(pair for part in child for pair in _value(part))
            rows.append([state[word] for word in WORDS])
        else:
            state |= dict(_value(child))
    if not 0 < len(rows) <= common.VIEWS:
        raise ValueError(f"expected 1 to {common.VIEWS} projections, got {len(rows)}")
    return torch.tensor(rows, dtype=torch.float64)


def _value(part: ElementTree.Element) -> list[tuple[str, float]]:
    if part.tag in IGNORED:
        return []
    if part.tag not in WORDS and part.tag not in ZERO:
        raise ValueError(f"expected {', '.join(WORDS)}, got {shown(part.tag)}")
    value = common.number((part.text or "").strip(), part.tag)
    if part.tag in ZERO and value:
        raise ValueError(f"expected a flat detector, got {part.tag} {value:g}")
    return [] if part.tag in ZERO else [(part.tag, value)]


def _cameras(table: Float[Tensor, "m 9"], plate: Detector) -> Cameras:
    sid, sdd, gantry, x, y, out, inner, source_x, source_y = table.unbind(dim=-1)
    parallel = bool((sdd == 0).all())
    for near, far in zip(sid.tolist(), sdd.tolist(), strict=True):
        if not parallel:
            common.check_distances(near, far)
    # rows: directions of columns, of rows (upwards), and of the source
    axes = euler_rotation(torch.stack([-inner, -out, -gantry], dim=-1), "zxy")
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
        ValueError: parallel beams, pinholes, detectors that are not rectangular or differ.
    """
    check(cameras)
    rig = common.into_world(cameras, world)
    right, up = unit(rig.u), -unit(rig.v)
    axes = torch.stack([right, up, torch.linalg.cross(right, up)], dim=1)
    source, centre = (
        (axes * point[:, None]).sum(dim=-1) for point in (rig.source, rig.detector_centre)
    )
    lines = ['<?xml version="1.0"?>', "<!DOCTYPE RTKGEOMETRY>"]
    lines += ['<RTKThreeDCircularGeometry version="3">']
    for view in zip(axes.tolist(), source.tolist(), centre.tolist(), strict=True):
        lines += ["  <Projection>", *_view(*view), "  </Projection>"]
    with written_whole(path) as part:
        part.write_text("\n".join([*lines, "</RTKThreeDCircularGeometry>\n"]), encoding="utf-8")


def check(cameras: Cameras) -> None:
    """Raise ValueError for a rig that `write` refuses."""
    if cameras.parallel or cameras.extent != "segment":
        raise ValueError("expected X-ray cone beams for RTK's XML, got another rig")
    common.square_pixels(cameras, "RTK")


def _view(axes: list[list[float]], source: list[float], centre: list[float]) -> list[str]:
    """The lines of one view; RTK rejects a file whose matrix does not match its parameters."""
    (source_x, source_y, sid), (x, y, depth) = source, centre
    gantry, out, inner = map(math.degrees, gantry_angles(axes))
    sdd = sid - depth
    values = (sid, sdd, gantry, x, y, out, inner, source_x, source_y)
    rows = []
    for axis, start, offset in ((axes[0], source_x, x), (axes[1], source_y, y)):
        turned = [(start - offset) * n - sdd * a for a, n in zip(axis, axes[2], strict=True)]
        rows.append([*turned, start * sdd - (start - offset) * sid])
    rows.append([*axes[2], -sid])
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
