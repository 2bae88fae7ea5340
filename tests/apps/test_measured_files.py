"""`mvrecon-reconstruct` on the files of beamlines and laboratories: the shortest commands of
docs/scan.md give the attenuation of a cylinder that is known in closed form.
"""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch

import mvrecon.apps.reconstruct
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras.formats import nikon
from mvrecon.geometry.grid import voxel_centres
from tests.data.projections.test_nexus import exchange, tomo
from tests.data.projections.test_nikon import images, xtekct
from tests.training.runs import call

PAGE = Path(__file__).parents[2] / "docs" / "scan.md"
#: Views of parallel beams, pixels of a row, rows, the pitch in mm, and the attenuation in 1/mm.
COUNT, WIDTH, ROWS, PITCH, MU = 60, 32, 3, 0.002, 30.0
#: The cylinder's radius, and its place (x, y), in pixels.
RADIUS, PLACE = 6.0, (4.0, -2.5)
FLAT, DARK = 50_000, 200


@pytest.fixture(autouse=True)
def _quick(blank_pictures, monkeypatch):
    monkeypatch.setattr("mvrecon.apps.sanity_checks.sanity_checks", lambda *_: [])


def grey(degrees):
    """Grey values of a cylinder along z [m v u], at camera angles."""
    a = np.radians(degrees)[:, None]
    s = np.arange(WIDTH) - (WIDTH - 1) / 2 - (PLACE[1] * np.cos(a) - PLACE[0] * np.sin(a))
    chord = 2 * MU * PITCH * np.sqrt(np.clip(RADIUS**2 - s**2, 0, None))
    light = DARK + (FLAT - DARK) * np.exp(-chord)
    return np.repeat(light[:, None], ROWS, axis=1).round().astype("u2")


def check(path, pitch=PITCH):
    """The volume has the attenuation inside the cylinder, at its place, and zero elsewhere."""
    volume, grid = read_volume(path)
    x, y, _ = voxel_centres(grid).reshape(-1, 3).T / pitch
    distance = torch.hypot(x - PLACE[0], y - PLACE[1])
    values = volume.flatten().double() * pitch / PITCH
    inside, outside = values[distance < RADIUS - 1.5], values[distance > RADIUS + 1.5]
    assert abs(inside.mean().item() - MU) < 0.02 * MU
    assert inside.std() < 0.05 * MU and abs(outside.mean().item()) < 0.02 * MU


def run(folder, *options):
    """Exit of the command in a run folder of its own."""
    place = folder / f"run_{len(list(folder.glob('run_*')))}"
    out = folder / "volume.nii.gz"
    out.unlink(missing_ok=True)
    return call(mvrecon.apps.reconstruct, *options, f"out={out}", f"hydra.run.dir={place}")


def frames(degrees):
    """Two flat and two dark frames before the views, and the keys."""
    fields = [np.full((ROWS, WIDTH), value, "u2") for value in (FLAT, FLAT, DARK, DARK)]
    return np.concatenate([fields, grey(degrees)]), np.array([1, 1, 2, 2, *[0] * len(degrees)])


def nexus(path, degrees, **changed):
    """A scan as NXtomo."""
    values, keys = frames(degrees)
    return tomo(
        path,
        values,
        size=(b"um", 2.0, 2.0),
        sample__rotation_angle=np.concatenate([np.zeros(4), degrees]),
        instrument__detector__image_key=keys,
        instrument__detector__image_key_control=None,
        **changed,
    )


def command(words):
    """The first command of docs/scan.md with these words, without its `out`."""
    text = PAGE.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = re.findall(r"^mvrecon-reconstruct .*", text, re.MULTILINE)
    line = next(line for line in lines if words in line)
    return [word for word in shlex.split(line)[1:] if not word.startswith("out=")]


@pytest.mark.parametrize(
    "degrees",
    [np.arange(COUNT) * 180 / COUNT, np.linspace(0, 180, COUNT), 45 + np.linspace(0, 360, COUNT)],
    ids=["half a turn", "with both ends", "a full turn with both ends"],
)
def test_nexus_in_one_command(degrees, tmp_path, monkeypatch):
    """Frames, fields, angles and pitch are the file's; a direction that is measured twice counts
    once.
    """
    nexus(tmp_path / "scan.nxs", degrees)
    monkeypatch.chdir(tmp_path)
    assert run(tmp_path, *command("scan.nxs")) == 0
    check(tmp_path / "volume.nii.gz")


def test_data_exchange_and_angles_in_a_file(tmp_path, monkeypatch, capsys):
    """Data Exchange states no pitch, which is asked for; angles in a file replace its own."""
    degrees = np.arange(COUNT) * 3 + np.random.default_rng(1).uniform(0, 2, COUNT)
    fields = {
        "data": grey(degrees),
        "data_white": np.full((1, ROWS, WIDTH), FLAT, "u2"),
        "data_dark": np.full((1, ROWS, WIDTH), DARK, "u2"),
    }
    exchange(tmp_path / "scan.h5", theta=degrees, **fields)
    monkeypatch.chdir(tmp_path)
    assert run(tmp_path, "views.path=scan.h5") == 1
    assert "Expected camera.detector.pixel_mm= of the scanner" in capsys.readouterr().err
    assert run(tmp_path, *command("views.path=scan.h5")) == 0
    check(tmp_path / "volume.nii.gz")
    exchange(tmp_path / "scan.h5", theta=None, **fields)
    np.savetxt(tmp_path / "angles.txt", degrees)
    assert run(tmp_path, *command("camera.angles=angles.txt")) == 0
    check(tmp_path / "volume.nii.gz")
    assert run(tmp_path, "views.path=scan.h5") == 1
    assert "states no geometry" in capsys.readouterr().err


def test_a_single_image_is_asked_about_and_read_as_a_sinogram(tmp_path, monkeypatch, capsys):
    """One image of a slice with the angles as rows; its flat field is a number."""
    degrees = np.linspace(0, 360, COUNT)
    tifffile.imwrite(tmp_path / "sinogram.tif", grey(degrees)[:, 0])
    monkeypatch.chdir(tmp_path)
    options = command("views.layout=sinogram")
    fields = (f"views.flat={FLAT}", f"views.dark={DARK}")
    mine = [o for o in options if not o.startswith(("views.flat", "camera.arc", "camera.detector"))]
    mine += [*fields, f"camera.arc_degrees={360 * COUNT / (COUNT - 1)}"]
    mine += [f"camera.detector.pixel_mm={PITCH}"]
    assert run(tmp_path, *[o for o in mine if "layout" not in o]) == 1
    assert "views.layout=sinogram reads its rows as 60 views" in capsys.readouterr().err
    assert run(tmp_path, *mine) == 0
    check(tmp_path / "volume.nii.gz")


def test_a_nikon_folder_in_one_command(tmp_path, monkeypatch):
    """Images, rig and white level are those of the .xtekct; the object lies at its place."""
    degrees, pixels = 6.0, (9, WIDTH)
    entries = {
        "Projections": COUNT,
        "SrcToObject": 2.0,
        "SrcToDetector": 4.0,
        "AngularStep": degrees,
        "ObjectOffsetX": 0.001,
        "WhiteLevel": FLAT,
        "DetectorPixelsY": pixels[0],
        "DetectorPixelsX": pixels[1],
        **dict.fromkeys(("DetectorPixelSizeX", "DetectorPixelSizeY"), 2 * PITCH),
    }
    (tmp_path / "scan").mkdir()
    rig = nikon.read(xtekct(tmp_path / "scan", **entries))
    # chords of a long cylinder along z, whose rays hardly rise
    ends = (x.numpy()[:, :2] for x in (rig.source, rig.origin + (pixels[0] // 2) * rig.v))
    source, first = ends
    place = first[:, None] + np.arange(WIDTH)[None, :, None] * rig.u.numpy()[:, None, :2]
    way = place - source[:, None]
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    middle = np.array(PLACE) * PITCH - source
    miss = way[..., 0] * middle[:, None, 1] - way[..., 1] * middle[:, None, 0]
    chord = 2 * MU * np.sqrt(np.clip((RADIUS * PITCH) ** 2 - miss**2, 0, None))
    light = (FLAT * np.exp(-chord)).round().astype("u2")
    images(tmp_path / "scan", np.repeat(light[:, None, ::-1], pixels[0], axis=1))
    monkeypatch.chdir(tmp_path)
    assert run(tmp_path, *command("tooth.xtekct")) == 0
    check(tmp_path / "volume.nii.gz")
