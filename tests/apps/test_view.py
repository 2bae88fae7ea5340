"""`mvrecon-view`: positions of voxels on the page, permitted resources, and errors."""

import base64
import re
import sys

import numpy as np
import pytest
import torch

import mvrecon as mv
from mvrecon.apps.view import PICTURES, main, view
from mvrecon.geometry.cameras.files import save
from mvrecon.report.viz.page import MAX_VOXELS, box_matrix, reduced


@pytest.fixture(scope="module")
def marked(tmp_path_factory):
    """A NIfTI file with axes towards the left and the back, turned about z, with one bright voxel;
    its place in world mm; and a rig.
    """
    nibabel, folder = pytest.importorskip("nibabel"), tmp_path_factory.mktemp("view")
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.array([[c, -s, 0, 5.0], [s, c, 0, -7.0], [0, 0, 1, 3.0], [0, 0, 0, 1]])
    affine = turn @ np.diag([-2.0, -3.0, 4.0, 1.0])
    values = np.zeros((7, 9, 5), np.float32)
    values[1, 6, 3] = 1.0
    nibabel.save(nibabel.Nifti1Image(values, affine), folder / "head.nii.gz")
    save(mv.circular(3, 200.0, 300.0, {"pixels": [4, 4], "pixel_mm": 20.0}), folder / "rig.json")
    return folder, (affine @ [1, 6, 3, 1])[:3]


def test_the_app_and_the_page_have_the_same_pictures():
    assert PICTURES == tuple(MAX_VOXELS)


def test_a_marker_is_where_nifti_says_in_every_picture(marked):
    k3d, (folder, place) = pytest.importorskip("k3d"), marked
    text = view(folder / "head.nii.gz", folder / "rig.json", folder / "a.html").read_text()
    plot = k3d.plot()
    plot.load_binary_snapshot(base64.b64decode(re.search(r"var data = '([^']+)'", text)[1]))
    shown = {o.name: o for o in plot.objects if o.name in MAX_VOXELS}
    assert set(shown) == set(MAX_VOXELS) and shown["slices"].visible and not shown["mip"].visible
    for picture in shown.values():
        values = np.asarray(picture.volume)
        index = np.argwhere(values == values.max())[0][::-1]
        cube = (index + 0.5) / values.shape[::-1] - 0.5
        world = np.asarray(picture.model_matrix).reshape(4, 4) @ [*cube, 1]
        np.testing.assert_allclose(world[:3], place, atol=1e-3)
    letters = {o.text: np.array(o.position) for o in plot.objects if o.type == "TextureText"}
    assert letters["R"][0] > letters["L"][0] and letters["A"][1] > letters["P"][1]
    assert letters["H"][2] > letters["F"][2]
    assert {"view 0", "cameras", "rays", "grid"} <= {o.name for o in plot.objects}


def test_a_page_opens_on_the_volume_whatever_the_rig(marked):
    """All of the grid's corners are in the field of view, and the outermost near its edge."""
    k3d, (folder, _) = pytest.importorskip("k3d"), marked
    text = view(folder / "head.nii.gz", folder / "rig.json", folder / "b.html").read_text()
    plot = k3d.plot()
    plot.load_binary_snapshot(base64.b64decode(re.search(r"var data = '([^']+)'", text)[1]))
    eye, target = np.array(plot.camera[:3]), np.array(plot.camera[3:6])
    rays = mv.read_volume(folder / "head.nii.gz")[1].corners().numpy() - eye
    cosines = rays @ (target - eye) / np.linalg.norm(rays, axis=1) / np.linalg.norm(target - eye)
    half = plot.camera_fov / 2
    assert 0.6 * half < np.degrees(np.arccos(cosines)).max() < half


def test_a_page_loads_nothing_from_elsewhere(marked):
    """A page that mvrecon-view writes loads nothing: it has no address of a program, style or
    picture, and its policy forbids any.
    """
    pytest.importorskip("k3d")
    folder, _ = marked
    text = view(folder / "head.nii.gz", out=folder / "b.html").read_text()
    head = text[: text.index("[K3D") if "[K3D" in text else 2000]
    assert "default-src 'none'" in head and "<title>head</title>" in text
    tags = re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", text)
    assert tags and not [tag for tag in tags if re.search(r"\b(?:src|href)\s*=", tag)]
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    assert "http" not in policy and "*" not in policy


def test_blocks_of_a_large_volume_keep_their_position():
    grid = mv.Grid.centred(size=(13, 12, 8), spacing=(1.0, 2.0, 3.0), centre=(5.0, 6.0, 7.0))
    volume = torch.zeros(grid.shape)
    volume[4:6, 6:8, 10:12] = 1.0
    whole = (grid.to_world(torch.tensor([10.5, 6.5, 4.5], dtype=torch.float64))).numpy()
    for most in (False, True):
        values, coarse = reduced(volume, grid, 200, most)
        assert values.numel() <= 200 and values.max() == 1 and tuple(values.shape) == coarse.shape
        z, y, x = (values == values.max()).nonzero()[0].tolist()
        index = (np.array([x, y, z]) + 0.5) / values.shape[::-1] - 0.5
        np.testing.assert_allclose((box_matrix(coarse) @ [*index, 1])[:3], whole)


@pytest.mark.parametrize("shape", [(1, 300, 200), (2, 90, 700), (70, 1, 900), (5000, 3, 1)])
def test_thin_volumes_keep_to_the_limit_too(shape):
    grid = mv.Grid.centred(size=shape[::-1], spacing=1.0)
    for limit in (1, 50, 1000):
        values, coarse = reduced(torch.full(shape, 3.0), grid, limit)
        assert values.numel() <= limit and tuple(values.shape) == coarse.shape
        assert values.unique().tolist() == [3.0]


def test_without_its_library_the_app_reports_what_to_install(marked, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "k3d", None)
    with pytest.raises(SystemExit, match="1"):
        main([str(marked[0] / "head.nii.gz")])
    assert "A page needs K3D: pip install 'mvrecon[view]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--window", "2", "1"], "from a lower to a higher value, got 2.0 to 1.0"), ([], "finite")],
)
def test_a_page_of_invalid_content_is_refused(options, message, tmp_path, capsys):
    pytest.importorskip("nibabel")
    grid = mv.Grid.centred(4, spacing=1.0)
    volume = torch.ones(grid.shape) if options else torch.full(grid.shape, torch.nan)
    mv.save_volume(tmp_path / "v.nii.gz", volume, grid)
    with pytest.raises(SystemExit, match="1"):
        main([str(tmp_path / "v.nii.gz"), *options])
    assert re.fullmatch(f"mvrecon-view: .*{message}.*\n", capsys.readouterr().err)


@pytest.mark.parametrize("out", ["head.nii.gz", "rig.json"])
def test_a_page_never_replaces_an_input(out, marked, monkeypatch, capsys):
    folder, _ = marked
    before = {path: path.read_bytes() for path in folder.iterdir()}
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit, match="1"):
        main(["head.nii.gz", "rig.json", "--out", str(folder / out)])
    assert "is an input; expected another --out" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
