"""A camera that breaks its contract is caught, and the message says how."""

import dataclasses

import pytest
import torch

from mvrecon.core.registry import Registry
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.testing import camera as contract
from tests.geometry.cameras.rigs import OPTIONS


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
