"""Every camera that is registered keeps the contract."""

import pytest

from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras.files import save
from mvrecon.testing import check_camera
from tests.data.projections.test_nikon import xtekct
from tests.geometry.cameras.rigs import OPTIONS, random_cameras
from tests.geometry.cameras.test_formats import FORMATS, crooked

BUILTIN = sorted(["from_file", "nikon", *OPTIONS, *FORMATS])


def test_every_built_in_camera_is_tested():
    builtin = [
        name
        for name in CAMERAS.names()
        if CAMERAS.origin(name).startswith("mvrecon.geometry.cameras")
    ]
    assert builtin == BUILTIN


@pytest.mark.parametrize("name", BUILTIN)
def test_built_in_cameras_keep_the_contract(name, tmp_path):
    path = tmp_path / "rig"
    if name in FORMATS:
        FORMATS[name][0].write(crooked(), path)
        options = {"path": path, **FORMATS[name][1]}
    else:
        save(random_cameras(extent="behind"), path)
        files = {"from_file": {"path": path}, "nikon": {"path": xtekct(tmp_path)}}
        options = {**OPTIONS, **files}[name]
    check_camera(name, **options)


@pytest.mark.parametrize("extent", ["segment", "behind", "ahead", "line"])
def test_every_extent_keeps_the_contract(extent, tmp_path):
    save(random_cameras(extent=extent), tmp_path / "rig.json")
    check_camera("from_file", path=tmp_path / "rig.json")
