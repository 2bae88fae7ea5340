"""Views in MHA and NRRD: their spacing and origin are RTK's detector, and contradict no other."""

import numpy as np
import pytest
import SimpleITK as sitk
import torch

from mvrecon.apps.reconstruct import read_scan
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.opening import open_projections
from mvrecon.data.projections.views import Measured, MeasuredViews
from mvrecon.geometry.cameras.formats import rtk_xml
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.fdk import fdk
from mvrecon.operators.drr import Drr
from tests.geometry.cameras.rigs import same

PLATE = {"pixels": [30, 36], "pixel_mm": [2.0, 1.5], "offset_mm": [3.0, -4.5]}
GRID = Grid.centred(12, spacing=3.0)
PARTS = {
    "grid": {"size": 12, "spacing": 3.0},
    "projector": {"name": "drr"},
    "method": {"name": "fdk"},
}


def stack(path, views, spacing, origin, direction=(1, 1)):
    """Views [m v u] as an ITK image, spacing and origin along (x, y)."""
    image = sitk.GetImageFromArray(views.numpy())
    image.SetSpacing([*spacing, 1.0])
    image.SetOrigin([*origin, 0.0])
    image.SetDirection(np.diag([*direction, 1.0]).flatten().tolist())
    sitk.WriteImage(image, str(path))
    return path


def settings(path, camera, **views):
    options = {"path": str(path), "kind": "integrals", "flip_rows": False, **views}
    return ReconstructSettings(**PARTS, views=options, camera=camera)


def rtk(path, **detector):
    nothing = {"pixels": None, "pixel_mm": None, "offset_mm": None}
    return {"name": "rtk_xml", "path": str(path), "detector": {**nothing, **detector}}


def placed(path, offset):
    """A stack whose centre is at an offset (down, right) in mm, with rows running upwards."""
    (down, right), rows, columns = offset, 30, 36
    origin = (right - 1.5 * (columns - 1) / 2, -down - 2.0 * (rows - 1) / 2)
    return stack(path, torch.ones(4, rows, columns), (1.5, 2.0), origin)


@pytest.mark.parametrize("ending", ["mha", "nrrd"])
def test_spacing_and_origin_of_projections_define_the_rtk_detector(ending, tmp_path):
    """A shifted detector with rectangular pixels: the reconstruction equals that of the exact
    rig.
    """
    rig = circular(60, 200.0, 300.0, PLATE)
    centred = circular(60, 200.0, 300.0, {**PLATE, "offset_mm": [0.0, 0.0]})
    rtk_xml.write(centred, tmp_path / "rig.xml")
    truth = torch.zeros(1, 1, 12, 12, 12)
    truth[..., 3:7, 4:9, 2:6] = 0.02
    views = Drr(GRID, rig)(truth)[0, 0]
    origin = (-4.5 - 1.5 * 35 / 2, -3.0 - 2.0 * 29 / 2)
    path = stack(tmp_path / f"a.{ending}", views.flip(-2), (1.5, 2.0), origin)
    scan = read_scan(settings(path, rtk(tmp_path / "rig.xml")))
    assert same(scan.cameras, rig, 1e-6)
    volume = fdk(scan.operator(), scan.measured.whole().views[None, None])
    expected = fdk(Drr(GRID, rig), views[None, None])
    assert (volume - expected).norm() < 1e-4 * expected.norm()


@pytest.mark.parametrize("name", ["circular", "rtk_xml"])
def test_a_spacing_or_an_origin_that_contradicts_the_rig_is_refused(name, tmp_path):
    """A detector whose pixel_mm or offset_mm is not that of the views' MHA is refused."""
    rtk_xml.write(circular(4, 200.0, 300.0, PLATE), tmp_path / "rig.xml")
    path = placed(tmp_path / "a.mha", (3.0, -4.5))
    known = {
        "circular": {"name": "circular", "n_views": 4, "sid": 200.0, "sdd": 300.0},
        "rtk_xml": {"name": "rtk_xml", "path": str(tmp_path / "rig.xml")},
    }[name]
    options = settings(path, {**known, "detector": PLATE}, flip_rows=True)
    read_scan(options)
    options.camera["detector"] = {**PLATE, "pixel_mm": [2.0, 1.6]}
    with pytest.raises(Refused, match=r"file's pixels of 2 x 1.5 mm \(v, u\), got 2 x 1.6 mm"):
        read_scan(options)
    for offset in ([3.0, -3.75], [2.0, -4.5], [0.0, 0.0]):
        options.camera["detector"] = {**PLATE, "offset_mm": offset}
        with pytest.raises(Refused, match=r"offset_mm \[3, -4.5\] \(v, u\) by .*origin, got"):
            read_scan(options)


def test_reversed_rows_and_columns_move_the_origin(tmp_path):
    path = placed(tmp_path / "a.mha", (3.0, -4.5))
    camera = {"name": "circular", "n_views": 4, "sid": 200.0, "sdd": 300.0}
    for rows in (True, False):
        for columns in (True, False):
            offset = [3.0 if rows else -3.0, 4.5 if columns else -4.5]
            camera["detector"] = {**PLATE, "offset_mm": offset}
            read_scan(settings(path, camera, flip_rows=rows, flip_columns=columns))


def test_pixels_of_any_rig_are_compared_with_the_file(tmp_path):
    path = placed(tmp_path / "a.mha", (0.0, 0.0))
    measured = MeasuredViews(Measured(path=str(path), kind="integrals"))
    measured.cameras(circular(4, 200.0, 300.0, PLATE))
    with pytest.raises(Refused, match=r"got 2\.01 x 1\.5 mm"):
        measured.cameras(circular(4, 200.0, 300.0, {**PLATE, "pixel_mm": [2.01, 1.5]}))


def test_an_image_without_a_position_is_not_compared(tmp_path):
    """ITK's defaults, as of an array without geometry."""
    path = stack(tmp_path / "a.mha", torch.ones(4, 30, 36), (1.0, 1.0), (0.0, 0.0))
    rig = circular(4, 200.0, 300.0, {**PLATE, "offset_mm": [0.0, 0.0]})
    rtk_xml.write(rig, tmp_path / "rig.xml")
    scan = read_scan(settings(path, rtk(tmp_path / "rig.xml", pixel_mm=[2.0, 1.5])))
    assert same(scan.cameras, rig, 1e-6)
    with pytest.raises(ValueError, match="Expected camera.detector.pixel_mm= of the scanner"):
        read_scan(settings(path, rtk(tmp_path / "rig.xml")))


def test_views_whose_file_mirrors_them_are_refused(tmp_path):
    """Views in an MHA whose direction mirrors rows or columns are refused, also in Python."""
    path = stack(tmp_path / "a.mha", torch.ones(4, 30, 36), (1.5, 2.0), (0.0, 0.0), (-1, 1))
    rtk_xml.write(circular(4, 200.0, 300.0, PLATE), tmp_path / "rig.xml")
    options = settings(path, rtk(tmp_path / "rig.xml"))
    for read, what in ((read_scan, options), (open_projections, path)):
        with pytest.raises(Refused, match="expected views with columns along x and rows along y"):
            read(what)


def test_an_offset_in_both_views_file_and_cameras_table_is_reported(tmp_path):
    """Both would be added, so that one of the two is to go."""
    path = placed(tmp_path / "views.mha", (0.0, 4.0))
    (tmp_path / "rig.csv").write_text(
        "angle_degrees,offset_u_mm\n" + "".join(f"{90 * k},4.0\n" for k in range(4))
    )
    detector = {"pixels": None, "pixel_mm": [2.0, 1.5], "offset_mm": [0.0, 0.0]}
    table = {"name": "angles", "path": str(tmp_path / "rig.csv"), "detector": detector}
    with pytest.raises(Refused, match="camera's own file has the offsets, write the views with"):
        read_scan(settings(path, {**table, "sid_mm": 200.0, "sdd_mm": 300.0}))
