"""The camera of a scan, completed by what its views state: pixels, pitch, angles, or all."""

import inspect
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mvrecon.core.files.checks import Refused
from mvrecon.core.parts import CAMERAS
from mvrecon.data.projections.sinograms import looks_like_sinogram
from mvrecon.data.projections.stack import MAX_PITCH_DIFFERENCE
from mvrecon.data.projections.views import MeasuredViews
from mvrecon.geometry.cameras.formats.common import check_degrees

#: The camera of the views' file.
OF_VIEWS = {"name": "from_file", "path": None}


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
        ValueError: options that are neither set nor stated, angles that are set twice, or one image
            that may be a view or a sinogram.
    """
    path, stated = measured.options.path, {**(measured.stack.rig or {})}
    plate = stated.get("detector", {})
    rig = _rig_of_views(stated, path) if camera == OF_VIEWS else {**camera}
    options = inspect.signature(CAMERAS.get(rig["name"])).parameters
    if camera == OF_VIEWS:
        rig = {key: value for key, value in rig.items() if key in ("name", *options)}
    if "angles" in options:
        _set_angles(rig, stated.get("angles"), path)
    if "n_views" in rig and rig["n_views"] is None:
        _check_several(measured)
        rig["n_views"] = measured.stack.n_views
    if isinstance(rig.get("detector"), Mapping):
        _warn_of_pitch(rig["detector"].get("pixel_mm"), plate.get("pixel_mm"), path)
        rig["detector"] = _filled(rig["detector"], {**plate, **known})
    rig = _filled(rig, known)
    if missing := _missing(rig, options):
        raise ValueError(
            f"Expected {' '.join(missing)} of the scanner, got camera={rig['name']} alone, and "
            f"{path} states none"
        )
    return rig


def _rig_of_views(stated: Mapping[str, Any], path: Any) -> dict[str, Any]:
    """The rig that the views' file states, with the options that it leaves open."""
    plate = stated.get("detector", {})
    if stated.get("name") is None:
        has = " and ".join(sorted({*stated, *plate} - {"name", "detector"})) or "no geometry"
        raise LookupError(
            f"camera.path=... or another camera=... must be given, such as camera=parallel; {path} "
            f"states {has}"
        )
    return {"n_views": None, **stated, "detector": {"pixels": None, "pixel_mm": None, **plate}}


def _set_angles(rig: dict[str, Any], stated: Any, path: Any) -> None:
    """Angles are those of the settings, by a list or a range, else those that the file states."""
    if isinstance(given := rig.get("angles"), Sequence) and not isinstance(given, str):
        check_degrees([*given], bool(rig.get("small_arc")), "camera.angles")
    ranged = ["arc_degrees"] if rig.get("arc_degrees") is not None else []
    ranged += ["start_degrees"] if rig.get("start_degrees") else []
    if rig.get("angles") is None and stated is not None and "arc_degrees" not in ranged:
        if ranged:
            raise ValueError(
                f"Expected camera.arc_degrees with camera.start_degrees in place of the angles of "
                f"{path}, got camera.start_degrees={rig['start_degrees']:g} alone"
            )
        rig["angles"] = stated
    if rig.get("angles") is not None:
        if ranged:
            raise ValueError(f"Expected camera.angles or camera.{ranged[0]}, got both")
        rig.pop("arc_degrees", None)


def _check_several(measured: MeasuredViews) -> None:
    """Ask how one image is to be read that may be a sinogram."""
    if measured.options.layout is None and looks_like_sinogram(measured.stack):
        rows, columns = measured.stack.shape
        raise Refused(
            f"{measured.options.path}: expected several views, got one image of {rows} x {columns} "
            f"pixels; views.layout=sinogram reads its rows as {rows} views of a slice, "
            f"views.layout=projections as one view"
        )


def _missing(rig: Mapping[str, object], options: Mapping[str, inspect.Parameter]) -> list[str]:
    """Options without a value that have no default either."""
    missing = []
    for key, value in rig.items():
        if key == "detector" and isinstance(value, Mapping) and value.get("pixel_mm") is None:
            missing.append("camera.detector.pixel_mm=")
        elif value is None and key in options and options[key].default is not None:
            missing.append(f"camera.{key}=")
    return missing


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
