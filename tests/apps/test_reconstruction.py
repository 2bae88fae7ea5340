"""`mvrecon-reconstruct` as a user calls it: a scan on disk comes back as the volume it was made
from.
"""

import json
import logging
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
import torch
import yaml
from PIL import Image as Pillow

import mvrecon.apps.reconstruct
import mvrecon.apps.simulate
from mvrecon.apps import correction, run_method
from mvrecon.apps.config import compose, help_text
from mvrecon.apps.output import Output
from mvrecon.apps.progress import logger
from mvrecon.apps.scan import check_unit
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.parts import PROJECTORS
from mvrecon.data.attenuation import WATER
from mvrecon.data.projections.views import Measured, MeasuredViews
from mvrecon.data.volume_files import WRITTEN_ENDINGS, read_volume
from mvrecon.geometry.cameras import files
from mvrecon.geometry.cameras.camera import VECTORS
from mvrecon.geometry.cameras.field import auto_grid
from mvrecon.geometry.cameras.formats import rtk_xml
from mvrecon.geometry.cameras.random_rigs import Misalignment
from mvrecon.geometry.grid import Grid
from mvrecon.methods.calibration.from_data import Estimate
from mvrecon.operators.drr import Drr
from mvrecon.operators.operator import Scaled
from tests.data.projections.test_nikon import xtekct
from tests.faults.plugins import plugin
from tests.training.runs import call

ROOT = Path(__file__).parents[2]
VALUE = WATER
SIMULATED = (
    "scene=ellipsoids",
    f"scene.value={VALUE}",
    "grid.size=[24,22,20]",
    "grid.spacing=8",
    "camera.n_views=40",
    "camera.arc_degrees=360",
    "camera.sid=600",
    "camera.sdd=900",
    "camera.detector={pixels: [36, 40], pixel_mm: 9.0, offset_mm: [0.0, 0.0]}",
    "rtk=true",
)
RIG = ("camera=rtk_xml", "camera.detector.pixel_mm=9.0", "camera.world=IEC")
NIKON = {"Projections": 40, "AngularStep": 9.0, "SrcToObject": 600.0, "SrcToDetector": 900.0}
NIKON |= {"DetectorPixelsX": 40, "DetectorPixelsY": 36}
NIKON |= {"DetectorPixelSizeX": 9.0, "DetectorPixelSizeY": 9.0}


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """A simulated scan: folder of projections, rig as RTK's XML, and the truth."""
    folder = tmp_path_factory.mktemp("scan")
    assert call(mvrecon.apps.simulate, *SIMULATED, f"hydra.run.dir={folder}/simulated") == 0
    case = next((folder / "simulated" / "cases").iterdir())
    shutil.copytree(case / "projections", folder / "projections")
    shutil.copy(folder / "simulated" / "geometry.xml", folder / "geometry.xml")
    for name in ("truth.nii.gz", "views.h5"):
        shutil.copy(case / name, folder / name)
    xtekct(folder, Name="view", InputFolderName="projections", **NIKON)
    return folder


@pytest.fixture(autouse=True)
def pictures(request):
    """Only the run whose pictures a test looks at draws."""
    if "test_the_pictures" not in request.node.name:
        request.getfixturevalue("blank_pictures")


@pytest.fixture
def unchecked(monkeypatch):
    """Without sanity checks, which take longer than a small reconstruction."""
    monkeypatch.setattr("mvrecon.apps.sanity_checks.sanity_checks", lambda *_: [])


def run(scan, folder, *options, views="projections"):
    """Exit of the app on the scan, with the truth's grid."""
    return call(mvrecon.apps.reconstruct, *arguments(scan, folder, views), *options)


def arguments(scan, folder, views="projections"):
    """The command line of the app on the scan, with the truth's grid."""
    return (
        f"views.path={scan / views}",
        *RIG,
        f"camera.path={scan}/geometry.xml",
        f"grid.like={scan}/truth.nii.gz",
        f"hydra.run.dir={folder}",
    )


def error_of(scan, path):
    """Relative error of a volume in HU against the truth, which mvrecon-simulate wrote in HU."""
    (truth, grid), (volume, own) = read_volume(scan / "truth.nii.gz"), read_volume(path)
    assert torch.allclose(own.affine, grid.affine)
    return ((volume - truth).norm() / (truth + 1000).norm()).item()


@pytest.mark.parametrize(
    ("method", "limit"),
    [
        (("method=fdk", "method.filter=hann"), 0.3),
        (("method=sirt", "method.momentum=true"), 0.25),
        (("method=cgls", "choose={every: 8}"), 0.25),
        (("method=os_sart", "stop.sigma=0.001"), 0.25),
    ],
)
def test_a_scan_as_a_detector_stores_it_comes_back_in_place_and_in_hu(
    scan, tmp_path, method, limit, unchecked
):
    folder = tmp_path / "run"
    assert run(scan, folder, *method, f"out={tmp_path}/volume.nii.gz", "unit=HU") == 0
    assert error_of(scan, tmp_path / "volume.nii.gz") < limit
    table = json.loads((folder / "results.json").read_text())
    assert table["view_nrmse"] < 0.15 and table["seconds"] > 0


def test_the_pictures_of_rig_and_volume_show_something(scan, tmp_path, unchecked):
    assert run(scan, tmp_path / "run", "views.every=8") == 0
    for picture in ("rig.png", "planes.png"):
        assert np.asarray(Pillow.open(tmp_path / "run" / picture)).std() > 0


def test_stored_integrals_and_grey_values_give_the_same_volume(scan, tmp_path, unchecked):
    """views.h5 has mvrecon's order of rows, the images RTK's; either file knows its own."""
    stored = (
        f"views.path={scan}/views.h5",
        "camera=from_file",
        f"camera.path={scan}/simulated/rig.json",
        f"grid.like={scan}/truth.nii.gz",
        f"out={tmp_path}/stored.nii.gz",
        f"hydra.run.dir={tmp_path}/stored",
    )
    assert call(mvrecon.apps.reconstruct, *stored) == 0
    assert run(scan, tmp_path / "grey", f"out={tmp_path}/grey.nii.gz") == 0
    grey, exact = (read_volume(tmp_path / f"{name}.nii.gz")[0] for name in ("grey", "stored"))
    assert (grey - exact).norm() < 2e-3 * exact.norm()


def test_a_rig_that_is_wrong_is_told_and_mended(scan, tmp_path, unchecked, capsys):
    """The detector is said to be two pixels of 9 mm aside, and turned by nothing: a tilt that is
    not fitted is the true one.
    """
    options = (
        f"views.path={scan}/views.h5",
        "camera=from_file",
        f"camera.path={tmp_path}/wrong.json",
        "views.every=4",
        "calibrate=[offset_u,tilt]",
        f"out={tmp_path}/volume.nii.gz",
        f"hydra.run.dir={tmp_path}/run",
    )
    rig = files.from_file(scan / "simulated" / "rig.json")
    files.save(rig.shifted(torch.tensor([[-2.0, 0.0]])), tmp_path / "wrong.json")
    assert call(mvrecon.apps.reconstruct, *options) == 0
    assert re.search(
        r"offset_u \+(1\.9|2\.0)\d+ pixels, uncertain by up to [0-9.e-]+, "
        r"tilt ([+-]0\.[0-2]|kept at the nominal value)",
        capsys.readouterr().out,
    )
    mended = files.from_file(tmp_path / "volume.cameras.json")
    assert (mended.origin - rig.origin).abs().max() < 9.0 / 4, "of all views on disk"
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    fit, grid = results["calibration"], auto_grid(mended[::4])
    assert results["grid"] == {"shape": [*grid.shape], "spacing_mm": [*grid.spacing]}
    assert fit["residual"][-1] < 0.2 * fit["residual"][0] and fit["free"] == ["offset_u", "tilt"]


STORED = (
    "views.path=views.h5",
    "camera=from_file",
    "camera.path=simulated/rig.json",
    "views.every=2",
    "views.rows=[4,32]",
    "views.columns=[2,40]",
    "views.binning=2",
    "views.flip_columns=true",
    "calibrate=[offset_u,slant,swivel,tilt]",
)
GREY = (
    "views.path=projections",
    "views.pattern=*.tif",
    *RIG,
    "camera.path=geometry.xml",
    "views.flip_rows=true",
    "grid.like=truth.nii.gz",
    "calibrate=[shifts]",
)

MIRRORED = ("views.path=tooth.xtekct", "grid.like=truth.nii.gz", "calibrate=[offset_u,tilt]")


@pytest.mark.parametrize(
    "typed",
    [STORED, GREY, MIRRORED, (*MIRRORED, "views.flip_columns=true")],
    ids=["stored", "grey", "mirrored", "mirrored twice"],
)
def test_a_calibrated_scan_is_reconstructed_from_the_file_that_it_writes(
    typed, scan, tmp_path, unchecked, monkeypatch
):
    """With nothing typed twice, to the last bit, from another folder; the fit is made up: every
    detector is turned about three axes and shifted. Nikon's images are mirrored without being told.
    """

    def calibrated(operator_of, rig, views, free, **_):
        by, none = Misalignment.none(len(rig)), torch.ones(len(rig)).double()
        by.tilt_degrees[:] = torch.tensor([3.0, -5.0, 2.0])
        by.offset_px[:] = torch.tensor([1.2, -0.7])
        if "shifts" in free:
            by.offset_px[::3] += torch.tensor([-2.0, 1.0])
        return Estimate(rig, by, none, [0.2, 0.1], [], (0.2, 0.1), True, dict.fromkeys(free, 0.1))

    monkeypatch.setattr(correction, "calibrated", calibrated)
    monkeypatch.chdir(scan)
    ends = ("method=sirt", "method.iterations=2", "-q")
    out, again = tmp_path / "a" / "volume.nii.gz", tmp_path / "again.nii.gz"
    first = (*typed, *ends, f"out={out}", f"hydra.run.dir={tmp_path}/first")
    assert call(mvrecon.apps.reconstruct, *first) == 0
    monkeypatch.chdir(tmp_path)
    second = (f"scan={out.parent}", *ends, f"out={again}", f"hydra.run.dir={tmp_path}/second")
    assert call(mvrecon.apps.reconstruct, *second) == 0
    (expected, grid), (volume, voxels) = read_volume(out), read_volume(again)
    assert torch.equal(volume, expected) and torch.allclose(voxels.affine, grid.affine)
    rigs = [files.from_file(tmp_path / name / "rig.json") for name in ("first", "second")]
    for name in VECTORS:
        assert torch.allclose(getattr(rigs[0], name), getattr(rigs[1], name), atol=1e-9)


@pytest.mark.parametrize("free", ["gains", "shifts"])
def test_a_calibration_that_no_scan_yaml_holds_writes_none(
    free, scan, tmp_path, unchecked, monkeypatch
):
    """Neither gains of views, nor shifts of the half of the views that was fitted; and the
    `scan.yaml` of an earlier run does not stay beside the new rig.
    """
    monkeypatch.chdir(scan)
    out = tmp_path / "volume.nii.gz"
    (tmp_path / "volume.scan.yaml").touch()
    typed = (*STORED[:4], f"calibrate=[{free}]", "method=sirt", "method.iterations=1")
    run = (*typed, f"out={out}", f"hydra.run.dir={tmp_path}/run")
    assert call(mvrecon.apps.reconstruct, *run) == 0
    assert not (tmp_path / "volume.scan.yaml").exists()
    rig = files.from_file(tmp_path / "volume.cameras.json")
    assert len(rig) == (40 if free == "gains" else 20)
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert results["calibration"]["scan"] is None


def test_files_of_an_earlier_calibration_stay_where_the_reconstruction_fails(
    scan, tmp_path, unchecked, monkeypatch
):
    """In the method, and where its volume cannot be written."""
    monkeypatch.chdir(scan)
    names = ("volume.nii.gz", "volume.cameras.json", "volume.scan.yaml")
    for name in names:
        (tmp_path / name).write_text("earlier")
    typed = (*STORED[:4], "calibrate=[offset_u]", "method=sirt", "method.iterations=1")
    run = (*typed, f"out={tmp_path}/volume.nii.gz", f"hydra.run.dir={tmp_path}/run")
    for owner, broken in ((run_method, "run_method"), (Output, "write")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, broken, lambda *_: (_ for _ in ()).throw(OSError("broken")))
            assert call(mvrecon.apps.reconstruct, *run) != 0
        assert [(tmp_path / name).read_text() for name in names] == ["earlier"] * 3


def test_rigs_of_volumes_whose_names_have_dots_lie_side_by_side(scan, tmp_path, unchecked):
    rigs = []
    for pixel in ("9.0", "8.9"):
        stored = (
            f"views.path={scan}/views.h5",
            f"camera.detector.pixel_mm={pixel}",
            "camera.detector.pixels=[36,40]",
            "views.every=4",
            "calibrate=[offset_u]",
            f"out={tmp_path}/scan.{pixel}mm.nii.gz",
        )
        assert run(scan, tmp_path / pixel, *stored, views="views.h5") == 0
        rigs.append(files.from_file(tmp_path / f"scan.{pixel}mm.cameras.json").u.norm().item())
    assert rigs[0] / rigs[1] == pytest.approx(9 / 8.9)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("mine.cameras.json", ("out={}/mine.nii.gz", "calibrate=[offset_u]")),
        ("rig.json", ("hydra.run.dir={}",)),
    ],
)
def test_a_run_that_would_write_to_its_own_rig_is_refused(scan, tmp_path, name, options, capsys):
    """A run whose results would replace a file that it reads is refused, and the file stays."""
    rig = tmp_path / name
    shutil.copy(scan / "simulated" / "rig.json", rig)
    before = rig.read_bytes()
    stored = (
        f"views.path={scan}/views.h5",
        "camera=from_file",
        f"camera.path={rig}",
        f"grid.like={scan}/truth.nii.gz",
        f"hydra.run.dir={tmp_path}/run",
        *(option.format(tmp_path) for option in options),
    )
    assert call(mvrecon.apps.reconstruct, *stored) == 1
    assert f"does not write, got camera.path={rig}" in capsys.readouterr().err
    assert rig.read_bytes() == before


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("file/volume.nii.gz", "file: expected a folder, got a file"),
        ("folder.nii.gz", "folder.nii.gz: expected a file, got a folder"),
    ],
)
def test_a_place_that_cannot_be_written_is_refused_first(
    scan, tmp_path, place, message, monkeypatch, capsys
):
    """A volume that cannot be written is refused before any view is read."""
    (tmp_path / "file").touch()
    (tmp_path / "folder.nii.gz").mkdir()
    monkeypatch.setattr("mvrecon.apps.scan.open_scan", lambda *_: pytest.fail("views are read"))
    assert run(scan, tmp_path / "run", f"out={tmp_path / place}") == 1
    assert f"{tmp_path / message}" in capsys.readouterr().err


def test_the_endings_that_the_settings_list_for_a_volume_are_written():
    line = re.search(r"^  out=null\n.*", help_text("reconstruct"), re.MULTILINE)
    listed = re.findall(r"[(, ](\.\w+(?:\.\w+)?)", line[0])
    assert set(listed) == set(WRITTEN_ENDINGS)


@pytest.mark.parametrize("ending", ["nii", "mha"])
def test_a_volume_like_another_can_be_compared_array_by_array(scan, tmp_path, ending, unchecked):
    """With axes that run to the back, to the feet and to the right."""
    truth, like, out = nibabel.load(scan / "truth.nii.gz"), tmp_path / "like.nii", tmp_path / "out"
    turn = nibabel.orientations.axcodes2ornt("PIR")
    nibabel.save(
        truth.as_reoriented(
            nibabel.orientations.ornt_transform(nibabel.io_orientation(truth.affine), turn)
        ),
        like,
    )
    options = (f"grid.like={like}", "method=fdk", "method.filter=hann", "unit=HU")
    assert run(scan, tmp_path / "run", *options, f"out={out}.{ending}") == 0
    expected, got = (sitk.ReadImage(str(path)) for path in (like, f"{out}.{ending}"))
    assert np.allclose(got.GetDirection(), expected.GetDirection(), atol=1e-6)
    a, b = (sitk.GetArrayFromImage(image) for image in (expected, got))
    assert np.linalg.norm(b - a) < 0.3 * np.linalg.norm(a + 1000)


@pytest.mark.parametrize("method", ["fdk", "cgls", "os_sart"])
def test_the_view_nrmse_is_that_of_the_volume(scan, tmp_path, method, unchecked, monkeypatch):
    """Told from the method's own last residual, or one projection: never from the files anew, which
    sanity checks read in part.
    """
    reads = []
    read = MeasuredViews.read
    monkeypatch.setattr(MeasuredViews, "read", lambda *a: reads.append(a) or read(*a))
    options = (f"method={method}", "views.every=4", f"out={tmp_path}/volume.nii.gz")
    assert run(scan, tmp_path / "run", *options) == 0
    last = {"fdk": 2}.get(method, 1)  # FDK is streamed: its views need not fit into memory
    assert sum(b - a for _, a, b in reads) == last * 10
    settings = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    case = mvrecon.apps.reconstruct.read_scan(ReconstructSettings(**settings))
    A, y = case.posed("cpu")
    x = read_volume(tmp_path / "volume.nii.gz")[0][None, None]
    expected = ((y - A(x)).norm() / y.norm()).item()
    table = json.loads((tmp_path / "run" / "results.json").read_text())
    assert table["view_nrmse"] == pytest.approx(expected, rel=1e-4)


def test_a_volume_of_many_views_is_compared_with_some(
    scan, tmp_path, monkeypatch, capsys, unchecked
):
    """At equal steps over the scan; their NRMSE is that of all. The last line states how many."""
    tables = []
    for limit in (40, 9):
        monkeypatch.setattr("mvrecon.apps.run_method.COMPARED_VIEWS", limit)
        folder = tmp_path / str(limit)
        assert run(scan, folder, "method=fdk", "method.filter=hann") == 0
        tables.append(json.loads((folder / "results.json").read_text()))
    assert [table["compared_views"] for table in tables] == [40, 8]
    assert tables[1]["view_nrmse"] == pytest.approx(tables[0]["view_nrmse"], rel=0.1)
    first, second = re.findall("view NRMSE [^;]*", capsys.readouterr().out)
    assert "of" not in first and second.endswith(" of 8 of 40 views")


IN_BLOCKS = '''
from mvrecon.methods.classical.fdk import fdk_streamed
from mvrecon.methods.classical.solver import declares


def in_blocks(read, cameras, grid, factor=1.0):
    return factor * fdk_streamed(read, cameras, grid)


@declares(streamed=in_blocks)
def scaled(A, views, factor: float = 1.0):
    """FDK times a factor."""
    raise AssertionError("all views at once")
'''


def test_a_plugins_method_that_declares_so_gets_its_views_block_by_block(scan, tmp_path, unchecked):
    """With its options, as FDK itself."""
    volumes = []
    with plugin(tmp_path / "site", {"method.scaled": "blocks:scaled"}, {"blocks": IN_BLOCKS}):
        for method in (("method=fdk",), ("method=scaled", "method.factor=3")):
            folder = tmp_path / method[0]
            assert run(scan, folder, *method, "views.every=4") == 0
            volumes.append(read_volume(folder / "volume.nii.gz")[0])
    torch.testing.assert_close(volumes[1], 3 * volumes[0])


def test_the_settings_in_the_run_folder_give_the_run_again_from_any_folder(
    scan, tmp_path, unchecked, monkeypatch
):
    monkeypatch.chdir(scan)
    fields = ("views.dark=projections/dark.tif", "views.flat=projections/flat.tif")
    (scan / "elsewhere").mkdir(exist_ok=True)
    options = (*fields, "views.path=projections", "camera.path=geometry.xml", "views.every=4")
    assert run(scan, tmp_path / "run", *options, "grid.like=truth.nii.gz") == 0
    first = read_volume(tmp_path / "run" / "volume.nii.gz")[0]
    settings = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    monkeypatch.chdir(scan / "elsewhere")
    again = mvrecon.apps.reconstruct.run_reconstruction(
        ReconstructSettings(**settings), tmp_path / "again"
    )
    assert torch.equal(read_volume(again["volume"])[0], first)


def test_a_run_that_fails_leaves_its_folder_to_the_next(
    scan, tmp_path, unchecked, monkeypatch, capsys
):
    """A reconstruction that fails in the middle leaves neither settings nor pictures nor a volume,
    and another with other settings may have its folder.
    """

    def fails(*_):
        raise MemoryError("no room left")

    with monkeypatch.context() as patch:
        patch.setattr("mvrecon.apps.run_method.run_method", fails)
        assert run(scan, tmp_path / "run", "views.every=4") == 1
    assert "no room left" in capsys.readouterr().err
    assert {file.name for file in (tmp_path / "run").iterdir()} <= {".lock", "reconstruct.log"}
    assert run(scan, tmp_path / "run", "views.every=5") == 0
    assert (tmp_path / "run" / "volume.nii.gz").is_file()


@pytest.mark.parametrize("choose", [(), ("choose={every: 8}",)])
def test_ctrl_c_writes_the_volume_so_far_and_reports_it(
    scan, tmp_path, monkeypatch, capsys, choose
):
    """Ctrl-C in the third iteration leaves the volume, the pictures and the results of the second,
    and the exit status of an interrupted program; the volume is that of two iterations.
    """
    out, forward, calls = tmp_path / "volume.nii.gz", Drr.forward, []

    def interrupted(self, x):
        calls.append(x)
        if len(x) == 1 and len(calls) == 6:
            raise KeyboardInterrupt
        return forward(self, x)

    options = ("method=sirt", "views.every=4", f"out={out}")
    with monkeypatch.context() as patch:
        patch.setattr(Drr, "forward", interrupted)
        assert run(scan, tmp_path / "run", *options, *choose) == 130
    said = capsys.readouterr()
    table = json.loads((tmp_path / "run" / "results.json").read_text())
    stopped = table["stopped"]
    assert f"the volume is that of iteration {stopped}" in said.out
    assert "stopped by Ctrl-C" in said.err and len(table["residuals"]) == stopped
    if not choose:
        shorter = (f"method.iterations={stopped}", f"out={tmp_path}/shorter.nii.gz")
        assert run(scan, tmp_path / "again", *options[:2], *shorter) == 0
        assert torch.equal(read_volume(tmp_path / "shorter.nii.gz")[0], read_volume(out)[0])


#: The app without sanity checks and pictures.
UNCHECKED = """
import numpy as np
import mvrecon.apps.reconstruct
import mvrecon.apps.sanity_checks
from mvrecon.report.viz import review, rig

mvrecon.apps.sanity_checks.sanity_checks = lambda *_: []
review.scan = rig.picture = lambda *_: np.zeros((2, 2, 3), np.uint8)
mvrecon.apps.reconstruct.main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no signal to one process")
def test_the_signal_of_ctrl_c_leaves_the_volume_so_far(scan, tmp_path):
    """The signal arrives wherever a process of its own is after its second iterate, compiled
    kernels included; the volume is that of as many iterations as it reports.
    """
    options = ("method=sirt", "views.every=4")
    command = [sys.executable, "-c", UNCHECKED, "-v", "method.iterations=20000"]
    command += [*arguments(scan, tmp_path / "run"), *options]
    # a shell may have started the tests in the background, whose children ignore the signal
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    try:
        process = subprocess.Popen(command, cwd=ROOT, text=True, **pipes)
    finally:
        signal.signal(signal.SIGINT, usual)
    with process:
        said = ""
        for line in process.stdout:
            said += line
            if " 2 residual" in line:
                process.send_signal(signal.SIGINT)
    assert process.returncode == 130 and "stopped by Ctrl-C" in said, said
    table = json.loads((tmp_path / "run" / "results.json").read_text())
    stopped = table["stopped"]
    assert 2 <= stopped < 20000 and f"the volume is that of iteration {stopped}" in said
    assert run(scan, tmp_path / "again", *options, f"method.iterations={stopped}") == 0
    first, again = (read_volume(tmp_path / name / "volume.nii.gz")[0] for name in ("run", "again"))
    assert (first - again).abs().max() <= 1e-5 * again.max()


def test_several_scans_in_one_command_and_one_that_fails(scan, tmp_path, unchecked, capsys):
    """A * stands for each scan's name; a scan that fails is named at the end, the others are
    written.
    """
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        shutil.copy(scan / "views.h5", tmp_path / name)
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "views.h5").write_bytes(b"none")
    options = (f"hydra.run.dir={tmp_path}/run", "views.every=8")
    many = (f"views.path={tmp_path}/*/views.h5", f"camera.path={scan}/simulated/rig.json")
    shared = ("camera=from_file", f"grid.like={scan}/truth.nii.gz", *many, *options)
    assert call(mvrecon.apps.reconstruct, *shared, f"out={tmp_path}/one.nii.gz") == 1
    assert "a * in out" in capsys.readouterr().err and not (tmp_path / "one.nii.gz").exists()
    assert call(mvrecon.apps.reconstruct, *shared, f"out={tmp_path}/*.nii.gz") == 1
    assert "1 of 3 scans failed: bad" in capsys.readouterr().err
    a, b = (read_volume(tmp_path / f"{name}.nii.gz")[0] for name in ("a", "b"))
    assert torch.equal(a, b) and (tmp_path / "run" / "b" / "results.json").is_file()
    trained = ("method=trained", "method.checkpoint=x/*/net.ckpt", "views.pattern=s*.tif")
    named = compose(*many, *trained, config_name="reconstruct")
    first = mvrecon.apps.reconstruct.scans_of(ReconstructSettings(**named), tmp_path)[
        tmp_path / "a"
    ]
    assert first.method["checkpoint"] == "x/a/net.ckpt" and first.views["pattern"] == "s*.tif"
    nothing = (f"views.path={tmp_path}/*.h5", *options)
    assert call(mvrecon.apps.reconstruct, "camera.path=none", *nothing) == 1
    assert "no scan has such a path" in capsys.readouterr().err


def test_quiet_runs_print_sanity_checks_alone_and_verbose_ones_each_step(
    scan, tmp_path, capsys, monkeypatch
):
    messages, handler = [], logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())
    monkeypatch.setattr(logger, "handlers", [handler])
    lost = MeasuredViews(Measured(path=str(scan / "views.h5"))).whole().views
    lost[3] = 0
    np.save(tmp_path / "views.npy", lost.numpy())
    stored = (
        f"views.path={tmp_path}/views.npy",
        "views.kind=integrals",
        "camera=from_file",
        f"camera.path={scan}/simulated/rig.json",
        f"grid.like={scan}/truth.nii.gz",
        "method=sirt",
        "method.iterations=3",
    )
    assert call(mvrecon.apps.reconstruct, *stored, f"hydra.run.dir={tmp_path}/q", "--quiet") == 0
    said = capsys.readouterr()
    assert said.out.startswith("sanity check: lost views, zero everywhere: 3 ")
    assert said.out.count("\n") == said.out.count("sanity check: ")
    assert not messages
    assert call(mvrecon.apps.reconstruct, *stored, f"hydra.run.dir={tmp_path}/v", "-v") == 0
    steps = [line for line in messages if "residual" in line]
    assert [line.split()[0] for line in steps] == ["1", "2", "3"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("views.every=3", "views.rows=[0, 99]"), "rows"),
        (("out=volume.raw",), "ends in"),
        (("choose={every: 8}",), "does not iterate"),
        (("stop.sigma=0.1",), "does not iterate"),
        (("method=sirt", "choose={every: 1}"), "choose.every: expected at least 2"),
        (("method=sirt", "choose={every: 5, weights: [0.1, 1]}"), "sirt has no option weight"),
        (("grid.size=[8, 8, 8]",), "grid.like"),
        (("grid.centre=[0, 0, 8]",), "grid.size and grid.spacing with grid.centre"),
        (("camera.detector.pixels=[36, 41]",), "detector"),
        (("views.flat=50", "views.dark=100"), "flat field"),
        (("unit=kg",), "unit"),
        (("calibrate=tilt",), "calibrate: expected [str, ...] or null"),
        (("calibrate=[tild]",), "did you mean 'tilt'"),
        (("calibrate=[gains]", "views.every=40"), "at least two views"),
    ],
)
def test_settings_that_do_not_fit_are_refused_and_leave_no_volume(
    scan, tmp_path, options, message, capsys
):
    """Settings that do not fit views, geometry or method are an error, and no volume is written."""
    assert run(scan, tmp_path / "run", *options) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.nii.gz"))


@pytest.mark.parametrize("method", ["fdk", "sirt"])
def test_saturated_pixels_are_told_by_every_way_of_reading(scan, tmp_path, method):
    """A scan with saturated pixels is told with their number, streamed or read as a whole."""
    with pytest.warns(UserWarning, match="pixels of 40 views are saturated"):
        assert (
            run(
                scan,
                tmp_path / "run",
                f"method={method}",
                "views.saturation=49500",
                "views.flat=49000",
            )
            == 0
        )


def test_fewer_views_than_cameras_are_refused(scan, tmp_path, capsys):
    """A scan with another number of views than of cameras is an error that gives both."""
    short = tmp_path / "projections"
    shutil.copytree(scan / "projections", short)
    (short / "view_00039.tif").unlink()
    assert (
        run(
            tmp_path,
            tmp_path / "run",
            f"camera.path={scan}/geometry.xml",
            f"grid.like={scan}/truth.nii.gz",
        )
        == 1
    )
    said = capsys.readouterr().err
    assert "one camera for each of 39 views" in said and "got 40 cameras; is a view missing" in said


def test_a_scan_is_described_by_numbers(scan, tmp_path, capsys):
    """The number of views and of pixels is that of the images; lengths and angles of the simulated
    rig, which `camera=circular` has, are not taken for the scanner's.
    """
    shutil.copytree(scan / "projections", tmp_path / "projections")
    for field, name in (("dark", "offset"), ("flat", "i0")):
        (tmp_path / "projections" / f"{field}.tif").rename(tmp_path / f"projections/{name}.tif")
    images = (
        f"views.path={tmp_path}/projections",
        f"views.dark={tmp_path}/projections/offset.tif",
        f"views.flat={tmp_path}/projections/i0.tif",
        "views.flip_rows=true",  # RTK's
        f"grid.like={scan}/truth.nii.gz",
        f"hydra.run.dir={tmp_path}/run",
        "unit=HU",
    )
    known = ("camera=circular", "camera.sid=600", "camera.sdd=900")
    assert call(mvrecon.apps.reconstruct, *images, *known) == 1
    error = capsys.readouterr().err
    assert "camera.detector.pixel_mm= camera.arc_degrees= of the scanner" in error
    assert "camera.sid" not in error and not (tmp_path / "run").exists()
    rest = ("camera.arc_degrees=360", "camera.detector.pixel_mm=9")
    assert call(mvrecon.apps.reconstruct, *images, *known, *rest) == 0
    assert error_of(scan, tmp_path / "run" / "volume.nii.gz") < 0.3


def test_a_grid_larger_than_memory_is_refused_with_its_size(scan, tmp_path, capsys):
    """A grid that does not fit into memory is an error that says how large it is."""
    options = ("grid.like=null", "grid.size=[40000, 40000, 40000]", "grid.spacing=0.01")
    assert run(scan, tmp_path / "run", *options) == 1
    assert "GiB" in capsys.readouterr().err


def test_line_integrals_are_no_counts(scan, monkeypatch):
    """Line integrals given as counts, and counts given as line integrals, are refused."""

    class Counts(Scaled):
        def __init__(self, grid, cameras):
            super().__init__(Drr(grid, cameras), pixels=torch.tensor(1e-4))

    monkeypatch.setitem(PROJECTORS._parts, "counts", Counts)
    cameras = rtk_xml.read(scan / "geometry.xml", {"pixels": [36, 40], "pixel_mm": 9.0}, "IEC")
    measured = MeasuredViews(Measured(path=str(scan / "views.h5")))
    for name, unit, message in (
        ("counts", measured.stack.unit, "got line integrals in 1/mm \\* mm"),
        ("drr", "counts of activity", "made them is 'counts'"),
    ):
        A = PROJECTORS.build(name, grid=Grid.centred(4, spacing=48.0), cameras=cameras)
        with pytest.raises(ValueError, match=message):
            check_unit(unit, name, A)
