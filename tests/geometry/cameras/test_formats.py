"""Geometry files round trip, and other programs read them as the same rays."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.geometry.cameras.formats import angles, astra, matrices, rtk_xml, tigre
from mvrecon.geometry.cameras.formats.common import flips_rows, to_ras
from mvrecon.geometry.cameras.rigs import Detector, circular
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.operators.drr import Drr
from tests.geometry.cameras.rigs import DETECTOR, same

FORMATS = {
    "rtk_xml": (rtk_xml, {"detector": DETECTOR}),
    "tigre": (tigre, {}),
    "astra": (astra, {"pixels": [6, 9]}),
    "angles": (angles, {"detector": DETECTOR}),
    "matrices": (matrices, {"detector": DETECTOR}),
}


def crooked(n_views=5):
    """A rig with an offset, turned detectors and a source off its circle: nothing is symmetric."""
    ideal = circular(n_views, 400.0, 800.0, {**DETECTOR, "offset_mm": [5.0, -7.0]})
    rng = torch.Generator().manual_seed(0)
    turn = euler_rotation(4 * torch.randn(n_views, 3, generator=rng, dtype=torch.float64))
    R = torch.stack([torch.nn.functional.normalize(x, dim=-1) for x in (ideal.u, ideal.v)], dim=1)
    R = torch.cat([R, torch.linalg.cross(R[:, 0], R[:, 1])[:, None]], dim=1) @ turn
    shift = 8 * torch.randn(2, n_views, 3, generator=rng, dtype=torch.float64)
    centre = ideal.origin + 4 * ideal.u + 2.5 * ideal.v
    return Detector.of(DETECTOR).carried(ideal.source + shift[0], centre + shift[1], R)


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_a_rig_round_trips_through_its_file(name, tmp_path):
    kind, options = FORMATS[name]
    kind.write(crooked(), tmp_path / "rig")
    assert same(kind.read(tmp_path / "rig", **options), crooked(), 1e-9)


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_upside_down_detectors_round_trip(name, tmp_path):
    """Their third Euler angle of TIGRE's is not determined: the second is 180 degrees."""
    kind, options = FORMATS[name]
    rig = circular(5, 400.0, 800.0, DETECTOR, start_degrees=20.0)
    far = rig.u * (rig.shape[1] - 1) + rig.v * (rig.shape[0] - 1)
    rig = replace(rig, origin=rig.origin + far, u=-rig.u, v=-rig.v)
    kind.write(rig, tmp_path / "rig")
    assert same(kind.read(tmp_path / "rig", **options), rig, 1e-9)


@pytest.mark.pairwise(name=sorted(FORMATS.keys() - {"angles"}), world=["RAS", "LPS", "IEC"])
def test_axes_of_the_file_are_converted_to_those_of_the_volume(name, world, tmp_path):
    kind, options = FORMATS[name]
    kind.write(crooked(), tmp_path / "rig", world=world)
    assert same(kind.read(tmp_path / "rig", world=world, **options), crooked(), 1e-9)
    lines = (tmp_path / "rig").read_text().splitlines(keepends=True)
    stated = lines.pop(0) if lines[0].startswith("#") else ""
    if stated and world != "RAS":
        with pytest.raises(Refused, match="first line"):
            kind.read(tmp_path / "rig", world="RAS", **options)
    (tmp_path / "rig").write_text("".join(lines))  # as other programs write it
    other = kind.read(tmp_path / "rig", world="RAS", **options)
    assert same(other.moved(to_ras(world), torch.zeros(3)), crooked(), 1e-9)


def test_axes_are_named_by_patient_directions():
    """A patient on his back, head first: left, posterior, superior (LPS), and IEC 61217's axes."""
    left, front, head = torch.eye(3, dtype=torch.float64) * torch.tensor([-1.0, 1.0, 1.0])
    assert torch.equal(to_ras("LPS").T, torch.stack([left, -front, head]))
    assert torch.equal(to_ras("IEC").T, torch.stack([left, head, front]))


def test_each_convention_describes_the_same_rig(tmp_path):
    """TIGRE: S = (DSO, 0, 0), turned about z by radians; the table: as `circular`."""
    plate = {**DETECTOR, "offset_mm": [4.0, -6.0]}
    expected = circular(3, 400.0, 800.0, plate, angles=[10.0, 40.0, 90.0])
    turned = [math.radians(a) for a in (10.0, 40.0, 90.0)]
    record = {"DSD": 800, "DSO": 400, "nDetector": [6, 9], "dDetector": [2, 3], "angles": turned}
    path = tmp_path / "rig"
    path.write_text(json.dumps({**record, "offDetector": [-4, -6]}))
    assert same(tigre.read(path), expected, 1e-9)
    path.write_text("angle_degrees, offset_v_mm\n10, 4\n40, 4\n90, 4\n")
    shifted = {**DETECTOR, "offset_mm": [0.0, -6.0]}
    assert same(angles.read(path, shifted, 400.0, 800.0), expected, 1e-9)


def test_a_detector_rotated_clockwise_shows_the_object_rotated_counter_clockwise(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text("angle_degrees,sid_mm,sdd_mm,tilt_degrees\n0,400,800,90\n")
    square = {"pixels": 9, "pixel_mm": 2.0}
    right = circular(1, 400.0, 800.0, square).u[0]
    uv = angles.read(path, square).project(right)[0, :2]
    assert torch.allclose(uv, torch.tensor([4.0, 2.0], dtype=torch.float64))


def test_the_settings_of_a_camera_say_whether_rows_are_reversed():
    assert flips_rows({"name": "rtk_xml"}) and flips_rows({"name": "astra"})
    assert not flips_rows({"name": "astra", "flip_rows": False})
    assert not flips_rows({"name": "matrices"}) and not flips_rows({"name": "circular"})


def test_matrices_of_any_scale_sign_and_first_pixel_are_one_rig(tmp_path):
    path, rig = tmp_path / "rig", crooked()
    P = rig.matrix * torch.tensor([2.0, -3.0, 1e-3, -1e3, 1.0])[:, None, None]
    P = torch.stack([P[:, 0] + P[:, 2], 6 * P[:, 2] - P[:, 1], P[:, 2]], dim=1)  # MATLAB, upwards
    path.write_text("\n".join(" ".join(map(repr, row)) for row in P.flatten(0, 1).tolist()))
    read = matrices.read(path, DETECTOR, first_pixel=1.0, flip_rows=True)
    assert same(read, rig, 1e-8)
    with pytest.raises(Refused, match="flip_rows=true"):
        matrices.read(path, DETECTOR, first_pixel=1.0)


def test_astra_vectors_of_a_npy_file_are_those_of_the_text(tmp_path):
    astra.write(crooked(), tmp_path / "rig.txt")
    np.save(tmp_path / "rig.npy", np.loadtxt(tmp_path / "rig.txt"))
    assert same(astra.read(tmp_path / "rig.npy", [6, 9]), crooked(), 1e-9)


def blob(grid):
    """A lopsided object: three Gaussian blobs of different weight, no two in one plane."""
    from mvrecon.geometry.grid import voxel_centres

    places = [((20.0, 5.0, -12.0), 1.0), ((-10.0, 18.0, 6.0), 0.6), ((4.0, -14.0, 16.0), 0.3)]
    centres = voxel_centres(grid)
    return sum(
        weight * torch.exp(-((centres - torch.tensor(place)) ** 2).sum(-1) / (2 * 6.0**2))
        for place, weight in places
    )


def test_rtk_itself_projects_along_the_same_rays(tmp_path):
    """RTK reads the XML that we write, projects a lopsided object, and sees what we see, its rows
    the other way round; and we read what RTK writes.
    """
    itk = pytest.importorskip("itk")
    rtk = pytest.importorskip("itk").RTK
    from mvrecon.geometry.grid import Grid

    plate = {"pixels": [28, 32], "pixel_mm": [4.0, 4.0]}
    rig = crooked(6)
    rig = Detector.of(plate).carried(
        rig.source,
        rig.origin,
        torch.stack([rig.u / 3, rig.v / 2, torch.linalg.cross(rig.u, rig.v) / 6], dim=1),
    )
    rtk_xml.write(rig, tmp_path / "rig.xml", world="RAS")
    reader = rtk.ThreeDCircularProjectionGeometryXMLFileReader.New(
        Filename=str(tmp_path / "rig.xml")
    )
    reader.GenerateOutputInformation()
    geometry = reader.GetOutputObject()
    grid = Grid.centred(48, spacing=2.0)
    object_ = blob(grid).float()

    def image(values, spacing):
        out = itk.image_from_array(values.numpy())
        out.SetSpacing(spacing)
        out.SetOrigin([-s * (n - 1) / 2 for s, n in zip(spacing, values.shape[::-1], strict=True)])
        return out

    stack = image(torch.zeros(6, 28, 32), [4.0, 4.0, 1.0])
    stack.SetOrigin([-62.0, -54.0, 0.0])
    project = rtk.JosephForwardProjectionImageFilter[type(stack), type(stack)].New()
    project.SetGeometry(geometry)
    project.SetInput(0, stack)
    project.SetInput(1, image(object_, [2.0, 2.0, 2.0]))
    project.Update()
    theirs = torch.from_numpy(itk.array_from_image(project.GetOutput())).flip(-2)
    ours = Drr(grid, rig)(object_[None, None])[0, 0]
    assert (theirs - ours).norm() < 0.01 * ours.norm()
    for axes in ((-1,), (-2,), (0,)):
        assert (theirs.flip(*axes) - ours).norm() > 0.2 * ours.norm()

    writer = rtk.ThreeDCircularProjectionGeometryXMLFileWriter.New()
    writer.SetFilename(str(tmp_path / "theirs.xml"))
    writer.SetObject(geometry)
    writer.WriteFile()
    assert same(rtk_xml.read(tmp_path / "theirs.xml", plate, world="RAS"), rig, 1e-6)


def test_values_that_rtk_states_once_apply_to_all_views(tmp_path):
    """RTK's writer puts what all views share at the head."""
    rtk = pytest.importorskip("itk").RTK
    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    for gantry in range(0, 360, 36):
        geometry.AddProjection(400.0, 800.0, gantry, 1.0, 2.0, 3.0, 4.0, 5.0, gantry / 9)
    writer = rtk.ThreeDCircularProjectionGeometryXMLFileWriter.New()
    writer.SetFilename(str(tmp_path / "rig.xml"))
    writer.SetObject(geometry)
    writer.WriteFile()
    rig = rtk_xml.read(tmp_path / "rig.xml", DETECTOR, world="RAS")
    points = 20 * torch.randn(30, 3, generator=torch.Generator().manual_seed(0)).double()
    for m in range(10):
        P = torch.from_numpy(itk_matrix(geometry.GetMatrix(m)))
        x, y, w = (P[:, :3] @ points.T + P[:, 3:]).unbind(0)
        uv = rig[m].project(points)[0, :, :2]
        assert torch.allclose(uv[:, 0], x / w / 3.0 + 4, atol=1e-6)
        assert torch.allclose(5 - uv[:, 1], y / w / 2.0 + 2.5, atol=1e-6)


def itk_matrix(matrix):
    import itk

    return np.asarray(itk.array_from_matrix(matrix), dtype=np.float64)


def test_astra_writes_its_circular_geometry_in_this_form(tmp_path):
    """ASTRA's cone geometry as vectors: the source at (sin a, -cos a), v upwards."""
    library = pytest.importorskip("astra")
    turned = np.radians([0.0, 30.0, 100.0])
    cone = library.create_proj_geom("cone", 3.0, 2.0, 6, 9, turned, 400.0, 400.0)
    np.save(tmp_path / "rig.npy", library.geom_2vec(cone)["Vectors"])
    expected = circular(3, 400.0, 800.0, DETECTOR, angles=[-90.0, -60.0, 10.0])
    assert same(astra.read(tmp_path / "rig.npy", [6, 9]), expected, 1e-9)
    with pytest.raises(Refused, match="left-handed.*flip_rows=false"):
        astra.read(tmp_path / "rig.npy", [6, 9], flip_rows=False)


def test_astra_writes_its_parallel_geometry_in_this_form(tmp_path):
    """ASTRA's parallel geometry as vectors is read with the options of its cone geometry."""
    library = pytest.importorskip("astra")
    turned = np.radians([0.0, 30.0, 100.0])
    beams = library.create_proj_geom("parallel3d", 3.0, 2.0, 6, 9, turned)
    np.save(tmp_path / "rig.npy", library.geom_2vec(beams)["Vectors"])
    rig = astra.read(tmp_path / "rig.npy", [6, 9], parallel=True)
    assert (rig.v[:, 2] == -2).all()  # downwards: the rows of the views are reversed
    across = 3 * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    np.testing.assert_allclose(rig.u[:, :2].numpy(), across, atol=1e-12)
