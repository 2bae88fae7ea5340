"""The camera of a scan, completed by what its views state: pixels, pitch, angles, or all."""

import inspect
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from mvrecon.core.files.checks import Refused
from mvrecon.core.parts import CAMERAS
from mvrecon.data.projections.sinograms import looks_like_sinogram
from mvrecon.data.projections.stack import MAX_PITCH_DIFFERENCE
from mvrecon.data.projections.views import MeasuredViews

#: The camera of the views' file.
OF_VIEWS = {"name": "from_file", "path": None}
#: Options that say which angles a rig has.
ANGLES = ("angles", "arc_degrees", "start_degrees")


def completed(
    camera: Mapping[str, Any], known: Mapping[str, Any], measured: MeasuredViews
) -> dict[str, Any]:
    """A camera's settings with what the views state in place of what is not set.

    Args:
        camera: name and options; from_file without a path is the camera of the views' file.
        known: options of its detector by the views: pixels, and pixel_mm and offset_mm if stated.
        measured: the views.

    Warns:
        UserWarning: pixels of another size than the views' file states.

    Raises:
        LookupError: no camera, and views without one.
        ValueError: options that are neither set nor stated, or one image that may be a view or a
            sinogram.
    """
    stack, path = measured.stack, measured.options.path
    rig: dict[str, Any] = {**(stack.rig or {})}
    stated = rig.pop("detector", {})
    stands = camera == OF_VIEWS
    if stands and rig.get("name") is None:
        has = " and ".join(sorted({*rig, *stated} - {"name"})) or "no geometry"
        raise LookupError(
            f"camera.path=... or another camera=... must be given, such as camera=parallel; {path} "
            f"states {has}"
        )
    own: dict[str, Any] = {
        "n_views": None,
        "detector": {"pixels": None, "pixel_mm": None, **stated},
        **rig,
    }
    named = own if stands else {**camera}
    options = inspect.signature(CAMERAS.get(named["name"])).parameters
    filled = {key: value for key, value in named.items() if key in ("name", *options) or not stands}
    if "angles" in options and all(filled.get(key) is None for key in ANGLES):
        filled["angles"] = rig.get("angles")
    if filled.get("angles") is not None:
        filled.pop("arc_degrees", None)
    counted = "n_views" in filled and filled["n_views"] is None
    if counted and measured.options.layout is None and looks_like_sinogram(stack):
        rows, columns = stack.shape
        raise Refused(
            f"{path}: expected several views, got one image of {rows} x {columns} pixels; "
            f"views.layout=sinogram reads its rows as {rows} views of a slice, "
            f"views.layout=projections as one view"
        )
    if counted:
        filled["n_views"] = stack.n_views
    if isinstance(filled.get("detector"), Mapping):
        _warn_of_pitch(filled["detector"].get("pixel_mm"), stated.get("pixel_mm"), path)
        filled["detector"] = _filled(filled["detector"], {**stated, **known})
    filled = _filled(filled, known)
    missing = []
    for key, value in filled.items():
        if key == "detector" and isinstance(value, Mapping) and value.get("pixel_mm") is None:
            missing.append("camera.detector.pixel_mm=")
        elif value is None and key in options and options[key].default is not None:
            missing.append(f"camera.{key}=")
    if missing:
        raise ValueError(
            f"Expected {' '.join(missing)} of the scanner, got camera={filled['name']} alone, and "
            f"{path} states none"
        )
    return filled


def _filled(options: Mapping[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """Options with known values in place of None."""
    return {**options} | {name: known[name] for name in known if options.get(name, known) is None}


def _warn_of_pitch(given: Any, stated: Any, path: Any) -> None:
    if given is None or stated is None:
        return
    ratio = np.broadcast_to(given, 2) / np.asarray(stated)
    if np.abs(ratio - 1).max() > MAX_PITCH_DIFFERENCE:
        warnings.warn(
            f"{path}: states pixels of {stated[0]:g} x {stated[1]:g} mm (v, u), camera.detector."
            f"pixel_mm={given} counts",
            stacklevel=3,
        )
