"""Scenes, modes and report of `bench=skip`, one by one."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.data.hdf5 import Stored, write_volumes
from mvrecon.geometry.grid import Grid
from mvrecon_bench.benchmarks.fills import cube, filled, phantom_body
from mvrecon_bench.benchmarks.skip import Bed, SkipTrial, compared, difference, panels, rig

N = 16


def test_modes_are_compared_with_off_and_include_the_mask_time():
    def setup(mode):
        if mode == "box":
            raise ValueError("no box")
        value = {"off": 1.0, "cropped": 1.0, "auto": 1.5}[mode]
        pause = {"off": 0.03, "cropped": 0.02, "auto": 0.01}[mode]

        def act():
            time.sleep(pause)
            return torch.tensor([value, 0.0])

        build = (lambda: time.sleep(0.02)) if mode == "auto" else None
        A = SimpleNamespace(skipped=SimpleNamespace(mode=mode, why="because"))
        return SkipTrial(A, act, build=build, charged=True)

    rows = compared(setup, ["off", "cropped", "auto", "box"], 3, "cpu")
    assert rows["box"] == {"status": "skipped: ValueError: no box"}
    auto = rows["auto"]
    assert auto["error"] == 0.5 and auto["differing"] == 1 and auto["why"] == "because"
    assert (
        rows["off"]["error"] == rows["cropped"]["differing"] == 0 and "build_ms" not in rows["off"]
    )
    assert auto["build_ms"] >= 20 and auto["ms"] >= 30
    assert rows["cropped"]["over_full"] > 1 > rows["off"]["over_crop"]


def test_minus_zero_differs_from_zero():
    assert difference(torch.tensor([0.0, 1.0]), torch.tensor([-0.0, 1.0])) == {
        "error": 0,
        "differing": 1,
    }


def test_a_body_fills_the_specified_fraction():
    grid = Grid.centred((20, 20, 20), 10.0)
    for fill, axes in (
        (0.35, (1.35, 1.0, None)),
        (0.8, (1.35, 1.0, None)),
        (0.09, (1.0, 1.0, 1.5)),
        (1, (1.0, 1.0, 1.0)),
    ):
        volume = phantom_body(grid, fill, axes)
        assert (volume > 0).double().mean().item() == pytest.approx(fill, abs=0.01)
        through = bool((volume[0] > 0).any())
        assert through == (axes[2] is None or fill == 1)
    with pytest.raises(ValueError, match="in \\(0, 1\\]"):
        phantom_body(grid, 0.0)


def test_the_shipped_scenes_fill_the_specified_fractions():
    scenes = compose("bench=skip", config_name="bench")["bench"]["scenes"]
    wanted = {
        "derenzo": 0.0033,
        "ventricle": 0.0073,
        "head_neck": 0.09,
        "torso35": 0.35,
        "torso80": 0.8,
        "full": 1.0,
    }
    assert list(scenes) == list(wanted)
    for name, part in wanted.items():
        volume, _ = filled(scenes[name], cube(scenes[name], 32))
        if name not in ("derenzo", "ventricle"):  # whose voxels are filled in part
            volume = volume > 0
        assert volume.double().mean().item() == pytest.approx(part, rel=0.05), name


def test_head_and_neck_is_a_patient_if_a_file_is_given(tmp_path):
    hu = np.full((12, 12, 12), -1000, np.int16)
    hu[3:9, 2:10, 4:8] = 40
    hu[:, 11] = -900  # the couch
    path = tmp_path / "ct.h5"
    write_volumes(path, [Stored("pt_1", hu, (10.0, 10.0, 10.0))])
    scene = {
        "volume": {"name": "hdf5", "path": str(path)},
        "instead": {"name": "random"},
        "field_mm": 120,
    }
    volume, source = filled(scene, cube(scene, 12))
    assert source.startswith("pt_1") and volume.shape == (12, 12, 12)
    assert (volume > 0).sum() == pytest.approx(6 * 8 * 4, rel=0.2)
    without = {**scene, "volume": {"name": "hdf5", "path": None}}
    assert filled(without, cube(scene, 12))[1].startswith("random")


def test_cameras_cover_the_cube():
    circle = {"name": "circular", "n_views": 3, "sid": 500.0, "sdd": 1000.0, "cover": 2.0}
    cameras = rig(circle, 256.0, 8)
    assert len(cameras) == 3 and cameras.shape == (8, 8)
    assert cameras.u.norm(dim=1).tolist() == pytest.approx([2 * 256 / 8] * 3)
    assert len(rig({"name": "dcspect80", "pixels": 5, "rows": [0]}, 256.0, 8)) == 20


def test_the_hull_contains_the_object_and_cropping_keeps_the_operator():
    scene = {"volume": {"name": "ventricle", "field": 0.3}}
    cameras = rig(
        {"name": "circular", "n_views": 4, "sid": 1000.0, "sdd": 1536.0, "cover": 1.536}, 256.0, N
    )
    grid = cube(scene, N)
    bed = Bed(filled(scene, grid)[0][None, None], grid, cameras, "siddon")
    assert (bed.within_hull.mask | ~bed.mask).all() and not bed.within_hull.mask.all()
    dense, cropped = bed.operator("off"), bed.operator("cropped")
    assert bed.box.size < 0.2 * N**3
    torch.testing.assert_close(
        cropped(bed.cut(bed.volume, "cropped")), dense(bed.volume), rtol=1e-4, atol=1e-3
    )
    torch.testing.assert_close(
        bed.pasted(bed.cut(bed.volume, "cropped"), "cropped"), bed.volume, rtol=0, atol=0
    )


def test_the_plot_shows_mode_auto():
    common = {"scene": "full", "task": "adjoint", "status": "ok", "over_crop": 1.0}
    rows = [
        {**common, "mode": mode, "over_full": times}
        for mode, times in (("off", 1.0), ("auto", 0.9), ("box", 0.5))
    ]
    (kinds,) = panels(rows).values()
    assert list(kinds.values()) == [[("full", 0.9)], [("full", 1.0)]]
