"""Every camera that is registered keeps the contract; cameras that break it are caught."""

import dataclasses

import pytest
import torch

from mvrecon.core.parts import CAMERAS
from mvrecon.core.registry import Registry
from mvrecon.geometry.cameras.files import save
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.testing import camera as contract, check_camera
from tests.geometry.cameras.rigs import OPTIONS, random_cameras
from tests.geometry.cameras.test_formats import FORMATS, crooked

BUILTIN = sorted(["from_file", *OPTIONS, *FORMATS])


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
        options = {**OPTIONS, "from_file": {"path": path}}[name]
    check_camera(name, **options)


@pytest.mark.parametrize("extent", ["segment", "behind", "ahead", "line"])
def test_every_extent_keeps_the_contract(extent, tmp_path):
    save(random_cameras(extent=extent), tmp_path / "rig.json")
    check_camera("from_file", path=tmp_path / "rig.json")


class Skewed(contract.Cameras):
    """Its projection is off by a hundredth of a pixel."""

    def project(self, xyz):
        return super().project(xyz) + torch.tensor([0.01, 0, 0], dtype=torch.float64)


class Coupled(contract.Cameras):
    """Its cameras know of each other: the answer depends on how many there are."""

    def project(self, xyz):
        return super().project(xyz) * (
            1 if len(self) == 1 else torch.tensor([1, 1, 1 + 1e-6], dtype=torch.float64)
        )


def of_kind(kind):
    rig = circular(**OPTIONS["circular"])
    return kind(**{field.name: getattr(rig, field.name) for field in dataclasses.fields(rig)})


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: [1, 2], "expected Cameras, got list"),
        (
            lambda: circular(**(OPTIONS["circular"] | {"start_degrees": torch.rand(()).item()})),
            "differs from call to call",
        ),
        (lambda: of_kind(Skewed), "pixel centres at w = -2.0 are missed by 0.01 px"),
        (lambda: of_kind(Coupled), "camera 0 differs when alone"),
    ],
)
def test_broken_cameras_are_caught(build, message, monkeypatch):
    cameras = Registry("camera")
    cameras.register("broken")(build)
    monkeypatch.setattr(contract, "CAMERAS", cameras)
    with pytest.raises(AssertionError, match=message):
        contract.check_camera("broken")
