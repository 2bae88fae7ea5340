"""TIGRE's geometry and angles as JSON, with TIGRE's names (Biguri and others, Biomed. Phys. Eng.
Express 2, 2016).
"""

import json
import math
import warnings
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import write_text
from mvrecon.core.files.checks import Refused, file_errors, json_of, shown
from mvrecon.core.files.keys import Key, check_keys
from mvrecon.core.registry import hint
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.formats import common
from mvrecon.geometry.cameras.rigs import Detector
from mvrecon.geometry.rigid import euler_degrees, euler_rotation, unit

#: Radians; larger angles are assumed to be degrees, those over a turn may be, and so may rotations
#: of the detector that are larger than usual and no quarter turns.
TURNS, TURN, USUAL = 8 * math.pi, 2 * math.pi + 1e-3, 0.2
#: Least range of angles, degrees or radians, over which cameras turn.
MIN_TURN = 1e-2
#: Values of each entry for one view, and its default.
PER_VIEW = {"DSD": 1, "DSO": 1, "offOrigin": 3, "offDetector": 2, "rotDetector": 3, "COR": 1}
#: Entries of the file; any other is refused.
KEYS = (
    Key("mode", "refused", "", ("cone", "parallel")),
    *(Key(name, "applied") for name in ("angles", "nDetector", "dDetector", *PER_VIEW)),
    Key("sDetector", "compared", "with nDetector times dDetector"),
    Key("n_proj", "compared", "with the number of angles"),
    Key("nVoxel, sVoxel, dVoxel", "ignored", "grid has the voxels"),
    Key("accuracy, filter", "ignored", "TIGRE's algorithms"),
)


def read(
    path: str | Path, world: str = "RAS", flip_rows: bool = True, degrees: bool | None = None
) -> Cameras:
    """Rig in mm from a JSON file of TIGRE's geometry, with its angles in radians.

    Entries, in the order of TIGRE's Python: `DSD`, `DSO` (mm), `nDetector`, `dDetector` (v, u),
    `angles` (radians [views] or Euler angles zyz [views 3]); and, one for all or one per view,
    `offDetector` (v, u) mm, `offOrigin` (z, y, x) mm, `rotDetector` (yaw about the beam, pitch
    about u, roll about v) radians, `COR` mm; `mode` "cone" or "parallel".

    Args:
        path: path of the JSON file.
        world: axes of the file, "RAS", "LPS" or "IEC"; see `to_ras`.
        flip_rows: must be true: TIGRE's first row is the lowest; the rows of the views must be
            reversed.
        degrees: angles and rotDetector are degrees (true), or radians whatever they look like
            (false). None: radians, and angles that look like degrees are refused.

    Convention: TIGRE: the source at R(DSO, 0, 0), u along R(0, 1, 0), v along R(0, 0, 1), upwards.
    The world's origin is the centre of TIGRE's image: offOrigin moves the cameras instead.

    Warns:
        UserWarning: angles over more than a turn, or a detector turned far, which may be degrees.

    Raises:
        OSError: the file cannot be read.
        ValueError: an invalid file, non-finite values, angles that look like degrees, DSO > DSD,
            `flip_rows` false.
    """
    if not flip_rows:
        raise Refused(f"{path}: TIGRE's rows run upwards; expected flip_rows=true, got false")
    with file_errors(path, "is not a geometry of TIGRE's", "expected JSON with its names"):
        return common.from_world(_cameras(_checked(path, json_of(path)), degrees), world)


def _checked(path: str | Path, record: Any) -> dict[str, Any]:
    if not isinstance(record, dict):
        raise ValueError(f"expected a JSON object, got {shown(record)}")
    known = [name for key in KEYS for name in key.names]
    for name in record:
        if name not in known:
            raise ValueError(f"expected known entries, got {name!r}{hint(name, known)}")
    for name in ("angles", "nDetector", "dDetector", "DSD", "DSO"):
        if name not in record:
            raise ValueError(f"expected the entry {name!r}, got {sorted(record)}")
    check_keys(path, KEYS, record.get)
    repeated = {
        "n_proj": lambda: torch.tensor(len(record["angles"]), dtype=torch.float64),
        "sDetector": lambda: _numbers(record, "nDetector") * _numbers(record, "dDetector"),
    }
    for name, value in repeated.items():
        if record.get(name) is not None:
            got, expected = _numbers(record, name), value()
            if got.shape != expected.shape or not torch.allclose(got, expected, rtol=1e-5):
                raise ValueError(f"expected {name} {expected.tolist()}, got {got.tolist()}")
    return record


def _numbers(record: dict[str, Any], name: str) -> Float[Tensor, "*n"]:
    """An entry as a tensor; torch raises for strings, booleans and ragged lists."""
    values = record.get(name, [0.0] * PER_VIEW.get(name, 1))
    if isinstance(values, str) or len(json.dumps(values)) > common.VIEWS * 100:
        raise ValueError(f"expected numbers for {name}, got {shown(values)}")
    tensor = torch.tensor(values, dtype=torch.float64)
    if not tensor.isfinite().all() or not tensor.numel():
        raise ValueError(f"expected finite numbers for {name}, got {shown(values)}")
    return tensor


def _per_view(record: dict[str, Any], name: str, views: int) -> Float[Tensor, "m k"]:
    """An entry's values for each view."""
    values, width = _numbers(record, name), PER_VIEW[name]
    fits = {(width,), (views, width)} | ({(), (views,), (1,)} if width == 1 else set())
    if tuple(values.shape) not in fits:
        raise ValueError(
            f"expected {name} as {width} numbers, one for all or one for each of {views} views, "
            f"got {list(values.shape)}"
        )
    return values.reshape(-1, width).expand(views, width)


def _radians(
    name: str, values: Float[Tensor, "m k"], apart: float, usual: float, degrees: bool | None
) -> Float[Tensor, "m k"]:
    """Angles in radians; raise for those that must be degrees, warn of those that may be."""
    if degrees is not None:
        return torch.deg2rad(values) if degrees else values
    if (most := values.abs().max().item()) > TURNS:
        raise ValueError(
            f"expected TIGRE's {name} in radians, got {most:.4g}; say degrees=true "
            f"(camera.degrees) if they are degrees, or degrees=false"
        )
    if apart > usual:
        warnings.warn(
            f"{name} up to {most:.4g} were taken for radians; say degrees=true "
            f"(camera.degrees) if they are degrees",
            stacklevel=5,
        )
    return values


def _like_degrees(angles: Float[Tensor, " m"]) -> bool:
    """Whether many angles have the first and last, or all, of at most two decimals, as degrees do.

    Radians are multiples of pi, or have ends of few decimals in degrees.
    """
    steps = angles.diff()
    if len(angles) < common.MANY or not steps.any():
        return False
    even = bool((steps - steps.mean()).abs().max() <= 1e-3 * steps.mean().abs())
    span, step = (abs(x.item()) for x in (angles[-1] - angles[0], steps.mean()))
    quarters = ((whole / (math.pi / 2)) for whole in (span, span + step))
    if even and any(q > 0.5 and abs(q - round(q)) <= 1e-3 * q for q in quarters):
        return False

    def plain(values: Float[Tensor, " m"]) -> bool:
        beyond = torch.cat([values, values[-1:] + values.diff().mean()])
        short = (100 * beyond - (100 * beyond).round()).abs() < 1e-3
        return bool(short[:-1].all() or (even and short[0] and short[-2:].any()))

    return plain(angles) and not plain(torch.rad2deg(angles))


def _cameras(record: dict[str, Any], degrees: bool | None) -> Cameras:
    angles = _numbers(record, "angles")
    if angles.ndim == 1:
        angles = torch.stack([angles, *[torch.zeros_like(angles)] * 2], dim=-1)
    if angles.ndim != 2 or angles.shape[1] != 3 or len(angles) > common.VIEWS:
        raise ValueError(f"expected angles [views] or [views 3], got {list(angles.shape)}")
    # the first and the third are about one axis where the second is zero
    turns = [turn for turn in (angles[:, 0], angles[:, 2]) if turn.max() - turn.min() > MIN_TURN]
    for turn in turns:
        if degrees is None and _like_degrees(turn):
            raise ValueError(
                f"expected TIGRE's angles in radians, got {len(turn)} from {turn[0]:g} to "
                f"{turn[-1]:g}, which look like degrees; say degrees=true (camera.degrees) if "
                f"they are, or degrees=false"
            )
    apart = max((float(turn.max() - turn.min()) for turn in turns), default=0.0)
    angles = _radians("angles", angles, apart, TURN, degrees)
    views, parallel = len(angles), str(record.get("mode")).strip().lower() == "parallel"
    DSD, DSO, COR = (_per_view(record, name, views) for name in ("DSD", "DSO", "COR"))
    common.check_distances(DSO, DSD)
    R = euler_rotation(torch.rad2deg(angles), "zyz")
    turned = _per_view(record, "rotDetector", views)
    aslant = (turned + math.pi / 4) % (math.pi / 2) - math.pi / 4
    turned = _radians("rotDetector", turned, aslant.abs().max().item(), USUAL, degrees)
    yaw_pitch_roll = torch.rad2deg(turned)
    turn = euler_rotation(yaw_pitch_roll.flip(-1), "zyx")  # roll about z comes last
    across, zero = _per_view(record, "offDetector", views), torch.zeros_like(DSD)
    if parallel and (across.any() or yaw_pitch_roll.any()):
        raise ValueError("expected parallel beams without offDetector and rotDetector, got some")
    centre = torch.cat([DSO - DSD, across.flip(-1)], dim=-1)
    start = torch.cat([DSO, zero, zero], dim=-1)
    alpha = angles[:, 0]
    shift = COR * torch.stack([-alpha.sin(), alpha.cos(), 0 * alpha], dim=-1)
    shift = shift - _per_view(record, "offOrigin", views).flip(-1)
    centre, start = ((R @ point[..., None])[..., 0] + shift for point in (centre, start))
    axes = R @ turn
    looking = torch.stack([axes[..., 1], -axes[..., 2], -axes[..., 0]], dim=1)
    plate = Detector(record["nDetector"], record["dDetector"])
    return plate.carried(start, centre, looking, parallel, "line" if parallel else "segment")


def write(cameras: Cameras, path: str | Path, world: str = "RAS") -> None:
    """Write a cone-beam rig as JSON with TIGRE's names (mm, radians), for `read`.

    Convention: as `read`; the rows of the views must be reversed for TIGRE. Every view has its own
    angles zyz and offsets, and no rotDetector.

    Raises:
        OSError: the file cannot be written.
        ValueError: parallel beams, pinholes, detectors that are not rectangular or differ, DSO >
            DSD.
    """
    common.check_cone(cameras, "TIGRE")
    dDetector = common.square_pixels(cameras, "TIGRE")
    rig = common.into_world(cameras, world)
    u, up = unit(rig.u), -unit(rig.v)
    R = torch.stack([torch.linalg.cross(u, up), u, up], dim=-1)
    source, centre = (
        (R.mT @ point[..., None])[..., 0] for point in (rig.source, rig.detector_centre)
    )
    aside = source * source.new_tensor([0, 1, 1])
    across = centre - aside
    common.check_distances(source[:, 0], (source - centre)[:, 0])
    record = {
        "mode": "cone",
        "DSO": source[:, 0].tolist(),
        "DSD": (source - centre)[:, 0].tolist(),
        "nDetector": list(rig.shape),
        "dDetector": list(dDetector),
        "offDetector": across[:, 1:].flip(-1).tolist(),
        "offOrigin": (-(R @ aside[..., None])[..., 0]).flip(-1).tolist(),
        "angles": torch.deg2rad(euler_degrees(R)).tolist(),
    }
    write_text(path, json.dumps(record, indent=1) + "\n")
