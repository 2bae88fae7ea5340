"""Corrections before a reconstruction: the same for an app, a method and a table."""

import json
import re
from dataclasses import replace

import pytest
import torch

import mvrecon as mv
import mvrecon.apps.reconstruct
from mvrecon.apps import correction
from mvrecon.apps.correction import corrected_scan
from mvrecon.apps.scan import Scan, ViewsInMemory
from mvrecon.core.parts import PROJECTORS, SCENES
from mvrecon.data.acquisition.spectra import tube
from mvrecon.data.attenuation import WATER
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras import files
from mvrecon.geometry.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.methods.calibration.alignment import translated
from mvrecon.methods.calibration.self_alignment import Aligned, self_aligned
from mvrecon.methods.classical.sirt import sirt
from mvrecon.methods.method import build_method
from mvrecon.report.cameras import camera_row, cameras_of, disturbed_cameras
from mvrecon.training.export import save_views
from tests.methods.learned.rig import small_rig
from tests.training.runs import call, trained_for_a_step

pytestmark = pytest.mark.usefixtures("blank_pictures")

SHIFT, GAIN = torch.zeros(1, 8, 2), torch.ones(1, 8)
SHIFT[0, 2], SHIFT[0, 5], GAIN[0, 5] = torch.tensor([0.9, -0.7]), torch.tensor([-0.6, 0.8]), 1.05
SIRT = "method=sirt", "method.momentum=true", "method.iterations=20"
WRONG = (SHIFT != 0).any(dim=-1) | (GAIN != 1)


@pytest.fixture(scope="module")
def case():
    """Operator, truth, and views of which two cameras are wrong."""
    grid, cameras = small_rig(n_views=8, size=24, pixels=36)
    sample = SCENES.build("ellipsoids").sample(0, 0, grid, cameras)
    views = translated(sample.views[None], SHIFT) * GAIN[:, None, :, None, None]
    return PROJECTORS.build("drr", grid=grid, cameras=cameras), sample.volume[None], views


def reconstructed(case, folder, *options: str, method=SIRT) -> tuple[float, dict]:
    """Relative error of the volume of the app, and its results."""
    A, truth, views = case
    stored = save_views(folder, "scan", views[0, 0], "1/mm")
    files.save(A.cameras, folder / "rig.json")
    fixed = (
        f"views.path={stored}/views.h5",
        f"camera.path={folder}/rig.json",
        f"grid.size={list(A.grid.size)}",
        f"grid.spacing={list(A.grid.spacing)}",
        f"hydra.run.dir={folder}/run",
        "device=cpu",
    )
    assert call(mvrecon.apps.reconstruct, *fixed, *method, *options) == 0
    volume, _ = read_volume(folder / "run" / "volume.nii.gz")
    table = json.loads((folder / "run" / "results.json").read_text())
    return ((volume - truth[0, 0]).norm() / truth.norm()).item(), table


def test_the_app_reports_wrong_cameras_and_corrects_views_or_cameras(case, tmp_path, capsys):
    for name in ("plain", "align", "calibrate"):
        (tmp_path / name).mkdir()
    plain, results = reconstructed(case, tmp_path / "plain", "left_out=true")
    assert "cameras" not in results
    disagreement = torch.tensor(results["left_out"])
    moved, results = reconstructed(case, tmp_path / "align", "correct=align", "left_out=true")
    assert "camera 2: shifted by +0." in capsys.readouterr().out
    assert (torch.tensor(results["left_out"])[[2, 5]] < disagreement[[2, 5]]).all()
    shift = torch.tensor(results["cameras"]["shift_px"])
    assert (shift - SHIFT).abs().max() < 0.15
    calibrated, _ = reconstructed(
        case, tmp_path / "calibrate", "correct=align", "self_calibrate=true"
    )
    rigs = [files.from_file(tmp_path / "calibrate" / at) for at in ("rig.json", "run/rig.json")]
    offset = (rigs[1].origin - rigs[0].origin)[2].float()
    pixels = shift[0, 2, 0] * rigs[0].u[2].float() + shift[0, 2, 1] * rigs[0].v[2].float()
    torch.testing.assert_close(offset, pixels, rtol=1e-3, atol=1e-3)
    assert max(moved, calibrated) < 0.85 * plain and abs(moved - calibrated) < 0.1 * plain


PARTS = {
    "region": Grid.centred(10, spacing=2.0, centre=(6.0, -4.0, 3.0)),
    "tight": Grid.centred(19, spacing=2.0),
}


@pytest.mark.parametrize("beam", ["cone", "parallel"])
@pytest.mark.parametrize("name", PARTS)
def test_a_grid_of_a_part_of_the_object_aligns_views_as_one_of_all_of_it(name, beam, monkeypatch):
    """By exact views of balls, of which two are shifted, and one of them is brighter; right views
    stay as measured. Also tried: slices, thick and aside, panels of 192 pixels, 40 views, 64 voxels
    a side.
    """
    monkeypatch.setattr(correction, "MAX_GRID_VOXELS", 32)
    panel = {"pixels": [40, 40], "pixel_mm": 3.0 if beam == "cone" else 2.0}
    rig = circular(24, 300.0, 450.0, panel) if beam == "cone" else parallel(24, panel)
    centres = torch.tensor([[0.0, 0, 0], [8, 5, -9], [-10, 3, 8], [2, -12, 4]])
    sizes = torch.tensor([[24.0], [4], [5], [6]]).expand(4, 3)
    values = torch.tensor([0.02, 0.04, 0.03, -0.01])
    balls = Phantom((Solids("ellipsoid", centres, torch.eye(3).expand(4, 3, 3), sizes, values),))
    shift, gain = torch.zeros(24, 2), torch.ones(24)
    shift[3], shift[9], gain[9] = torch.tensor([1.5, -1.0]), torch.tensor([-1.2, 0.5]), 1.1
    projector = {"name": "drr" if beam == "cone" else "radon"}

    def aligned(offset, factor):
        cameras = rig.shifted(offset.double())
        y = balls.integrals(*cameras.rays(), rig.ray_extent).float() * factor[:, None, None]
        scan = Scan(ViewsInMemory(y, torch.ones_like(y) > 0), rig, PARTS[name], projector)
        found, by = corrected_scan(scan, self_aligned)
        assert found.grid is scan.grid
        return by

    by = aligned(shift, gain)
    assert (by.shift_px[0] - shift).abs().max() < 0.2
    assert (by.gain[0] - gain).abs().max() < 0.02
    still = aligned(0 * shift, 0 * gain + 1)
    assert not still.shift_px.any() and (still.gain == 1).all()


@pytest.mark.parametrize("fault", ["pixel", "zinger", "column, row and cluster"])
def test_views_with_pixels_that_were_not_measured_are_aligned_as_those_without(fault):
    """Whatever these pixels hold: the shift of one view is found, and measured pixels of the
    aligned views are those of the clean scan.
    """
    rig = circular(24, 300.0, 450.0, {"pixels": [32, 44], "pixel_mm": 3.0})
    centres = torch.tensor([[0.0, 0, 0], [8, 5, -9], [-10, 3, 8], [2, -12, 4]])
    sizes = torch.tensor([[24.0], [4], [5], [6]]).expand(4, 3)
    values = torch.tensor([0.02, 0.04, 0.03, -0.01])
    balls = Phantom((Solids("ellipsoid", centres, torch.eye(3).expand(4, 3, 3), sizes, values),))
    shift = torch.zeros(24, 2)
    shift[3] = torch.tensor([1.5, -1.0])
    y = balls.integrals(*rig.shifted(shift.double()).rays(), rig.ray_extent).float()
    mask = torch.ones_like(y) > 0
    if fault == "pixel":
        mask[:, 16, 20] = False
    elif fault == "zinger":
        mask[3, 16, 20] = False
    else:
        mask[:, :, 30] = mask[:, 9] = mask[:, 20:23, 12:15] = False
    found = []
    for stored, measured in ((y, torch.ones_like(mask)), (y.where(mask, 9.0), mask)):
        scan = Scan(
            ViewsInMemory(stored, measured), rig, mv.Grid.centred(32, spacing=2.0), {"name": "drr"}
        )
        aligned, by = corrected_scan(scan, self_aligned)
        assert (by.shift_px[0] - shift).abs().max() < 0.1 and (by.gain[0] - 1).abs().max() < 0.01
        found.append(aligned.measured.whole())
    kept = found[1].mask
    assert torch.equal(kept[0], mask[0]) and (~kept[3]).sum() >= (~mask[3]).sum()
    error = (found[1].views - found[0].views)[kept]
    assert error.abs().max() < 0.02 * y.max()


def test_a_method_with_alignment_equals_the_method_on_aligned_views(case):
    A, _, views = case
    options = {"name": "sirt", "iterations": 5}
    method = Aligned(options).eval()
    corrected, by = self_aligned(A, views)
    out = method(views, A)
    torch.testing.assert_close(out.volume, sirt(A, corrected, 5))
    assert out.alignment is not None and torch.equal(out.alignment.gain, by.gain)


def test_views_are_aligned_once_in_training(case, monkeypatch):
    A, _, views = case
    batch = torch.cat([views, views.flip(-1)])
    method = Aligned({"name": "sirt", "iterations": 2}).train()
    first = method(batch, A)
    monkeypatch.setattr(method, "_corrected", None)  # a second computation would fail
    again = method(batch.flip(0), A)
    assert torch.equal(again.volume.flip(0), first.volume)
    fresh = Aligned({"name": "sirt", "iterations": 2}).eval()
    torch.testing.assert_close(first.volume, fresh(batch, A).volume)


def test_the_table_has_metrics_if_the_truth_is_known(case):
    A, _, views = case
    _, by = self_aligned(A, views)
    row = camera_row([cameras_of(by, {"shift_px": SHIFT, "gain": GAIN, "wrong": WRONG})])["cameras"]
    assert row["auc"] == 1 and row["shift_rms_px"] < 0.2 * row["true_shift_rms_px"]
    assert camera_row([cameras_of(by, {})])["cameras"].keys() == {
        "deviation",
        "shift_px",
        "gain",
        "shift_error",
        "gain_error",
    }
    assert camera_row([cameras_of(None, {})]) == {} and disturbed_cameras(None) == []
    still = replace(by, shift_px=0 * by.shift_px, gain=0 * by.gain + 1)
    assert disturbed_cameras(camera_row([cameras_of(still, {})])["cameras"]) == []


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """One step of a method that estimates its uncertainty."""
    small = "method@method.method=cross_view_small"
    return trained_for_a_step(tmp_path_factory.mktemp("run"), "uncertain", options=(small,))


def test_the_app_writes_the_standard_deviation_beside_the_volume(run, tmp_path):
    """In the volume's unit: 1000 HU are 0.0192/mm where all that may be is less than water."""
    module = mv.load(run, "uncertain").module.eval()
    A = module.projector
    truth = torch.full((1, 1, *A.grid.shape), 0.01)
    method = "method=trained", f"method.checkpoint={run}", "method.method=uncertain"
    reconstructed((A, truth, A(truth)), tmp_path, "unit=HU", method=method)
    saved, grid = read_volume(tmp_path / "run" / "volume.sigma.nii.gz")
    with torch.inference_mode():
        out = module(A(truth))
    light = (out.volume + out.sigma < WATER)[0, 0]
    assert light.any() and torch.allclose(grid.affine, A.grid.affine)
    expected = out.sigma[0, 0][light] * 1000 / WATER
    assert expected.min() > 0 and torch.allclose(saved[light], expected, rtol=1e-3, atol=0.1)


def test_an_invalid_correction_is_refused(case, tmp_path, capsys):
    """A calibration without an alignment and an unknown option are refused."""
    with pytest.raises(TypeError, match="alternations"):
        build_method({"name": "aligned", "method": {"name": "sirt"}, "alternation": 2})
    for options, message in {
        ("self_calibrate=true",): "correct=align",
        ("correct=align", "correct.alternation=2"): "did you mean 'alternations'",
        ("correct=align", "correct.A=2"): "correct has no option 'A'",
        ("correct=align", "correct.iterations=0"): "correct.iterations: expected int > 0, got 0",
        ("correct=aling",): "did you mean 'align'",
    }.items():
        with pytest.raises(AssertionError):
            reconstructed(case, tmp_path, *options)
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("options", [(), ("self_calibrate=true",)])
def test_methods_of_counts_follow_an_alignment(case, tmp_path, options):
    """The interpolation of sharp counts would have negative values, which they refuse."""
    A, truth, views = case
    rng = torch.Generator().manual_seed(0)
    counts = torch.poisson(2 * views.clamp(min=0) / views.mean(), generator=rng)
    counts = counts * views.mean() / 2
    osem = "method=osem", "method.iterations=2", "method.subsets=2"
    error, _ = reconstructed((A, truth, counts), tmp_path, "correct=align", *options, method=osem)
    assert error < 1


def test_the_app_fits_the_correction_of_beam_hardening_to_a_uniform_objects_views(tmp_path, capsys):
    """The printed coefficients, given as numbers, are the same run; without them the object reads
    3 % lower.
    """
    grid, cameras = small_rig(n_views=24, size=24, pixels=36)
    ball = SCENES.build("ellipsoids", count=(0, 0), value=0.06).sample(0, 0, grid, cameras)
    views = -tube(120.0).transmission(ball.views.double()).log().float()
    case = PROJECTORS.build("drr", grid=grid, cameras=cameras), ball.volume[None], views[None]
    volumes = {}
    for linearise in ("fit", "null"):
        (folder := tmp_path / linearise).mkdir()
        options = f"views.linearise={linearise}", "method.filter=hann"
        _, table = reconstructed(case, folder, *options, method=("method=fdk",))
        volumes[linearise] = read_volume(folder / "run" / "volume.nii.gz")[0]
        if linearise == "fit":
            fit, words = table["linearisation"], capsys.readouterr().out
    assert len(fit["coefficients"]) == 3 and fit["coefficients"][0] == 1
    printed = re.search(r"views\.linearise=(\[\S+\]): fitted", words)
    assert printed is not None
    (tmp_path / "given").mkdir()
    options = f"views.linearise={printed[1]}", "method.filter=hann"
    reconstructed(case, tmp_path / "given", *options, method=("method=fdk",))
    given, _ = read_volume(tmp_path / "given" / "run" / "volume.nii.gz")
    assert torch.allclose(given, volumes["fit"], atol=1e-4 * given.max().item())
    middle = [volumes[name][10:14, 10:14, 10:14].mean().item() for name in ("fit", "null")]
    assert middle[1] < 0.97 * middle[0] and middle[0] == pytest.approx(fit["value"], rel=0.02)
