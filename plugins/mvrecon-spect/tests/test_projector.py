"""A pinhole's counts follow the inverse square law of a point source, with no 1/r^2 in the
projector.
"""

import pickle
import subprocess
import sys
from copy import deepcopy
from math import pi

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon_spect.operators.projector import Spect, sensitivity

LENGTH, DIAMETER, PIXEL, SIDE, RADIUS = 89.0, 2.3, 0.8, 64, 18.0


def pinhole(**change) -> Cameras:
    """One pinhole in the origin that looks along +z, its detector 89 mm behind it."""
    corner = -PIXEL * (SIDE - 1) / 2
    exact = {"dtype": torch.float64}
    record = {
        "source": torch.zeros(1, 3, **exact),
        "origin": torch.tensor([[corner, corner, -LENGTH]], **exact),
        "u": torch.tensor([[PIXEL, 0.0, 0.0]], **exact),
        "v": torch.tensor([[0.0, PIXEL, 0.0]], **exact),
        "shape": (SIDE, SIDE),
        "extent": "behind",
    }
    return Cameras(**{**record, **change})


def total(x: float, z: float) -> float:
    """All counts from a sphere of unit activity concentration centred in (x, 0, z)."""
    grid = Grid.centred((40, 40, 40), 1.0, (x, 0.0, z))
    fine = voxel_centres(grid.refined(2)) - grid.centre
    inside = (fine.norm(dim=-1) < RADIUS).to(torch.float64)
    volume = torch.nn.functional.avg_pool3d(inside[None, None], 2)
    return Spect(grid, pinhole(), DIAMETER, backend="reference")(volume).sum().item()


def test_counts_of_a_sphere_follow_the_inverse_square_law():
    assert total(0, 194) / total(0, 294) == pytest.approx((294 / 194) ** 2, rel=5e-3)


def test_a_sphere_is_projected_like_a_point_at_its_centre():
    activity = 4 / 3 * pi * RADIUS**3
    assert total(0, 244) == pytest.approx(activity * DIAMETER**2 / (16 * 244**2), rel=5e-3)
    cosine = 200 / (200**2 + 20**2) ** 0.5
    assert total(20, 200) == pytest.approx(
        activity * DIAMETER**2 * cosine**3 / (16 * 200**2), rel=5e-3
    )


def test_sensitivity_from_axis_to_corner_follows_cos4():
    centred = sensitivity(pinhole(), DIAMETER)[0]
    half = PIXEL / 2  # the four central pixels lie half a pixel off the axis in u and v
    assert centred[SIDE // 2, SIDE // 2].item() == pytest.approx(
        DIAMETER**2 * PIXEL**2 / (16 * LENGTH**2) / (1 + 2 * (half / LENGTH) ** 2) ** 2, rel=1e-12
    )
    corner = PIXEL * (SIDE - 1) / 2
    ratio = ((LENGTH**2 + 2 * half**2) / (LENGTH**2 + 2 * corner**2)) ** 2
    assert (centred[0, 0] / centred[SIDE // 2, SIDE // 2]).item() == pytest.approx(ratio, rel=1e-12)


@pytest.mark.parametrize(
    ("backend", "dtype", "tolerance"),
    [("reference", torch.float64, 1e-12), ("auto", torch.float32, 1e-5)],
)
def test_the_adjoint_matches(backend: str, dtype: torch.dtype, tolerance: float):
    torch.manual_seed(0)
    A = Spect(
        Grid.centred(size=(14, 10, 12), spacing=4.0, centre=(3.0, -2.0, 150.0)),
        pinhole(),
        backend=backend,
    )
    x = torch.rand(1, 2, 12, 10, 14, dtype=dtype)
    y = torch.rand(1, 2, 1, SIDE, SIDE, dtype=dtype)
    left, right = (A(x) * y).sum(dtype=torch.float64), (x * A.T(y)).sum(dtype=torch.float64)
    assert left.item() == pytest.approx(right.item(), rel=tolerance)
    assert left > 0


@pytest.mark.parametrize("options", [{}, {"acceptance_degrees": 20.0}, {"blur": True}], ids=str)
@pytest.mark.parametrize("mu", [None, 0.01])
def test_it_can_be_sent_to_another_process(options: dict, mu: float | None):
    grid, rig = Grid.centred(12, spacing=10.0), dcspect80(pixels=8, columns=[0, 9])
    attenuation = None if mu is None else mu * torch.rand(grid.shape)
    assert pickle.dumps(Spect(grid, rig, 4.0, attenuation, **options))


@pytest.mark.parametrize("name", ["mu", "diameter_mm", "blur", "response", "acceptance_degrees"])
def test_an_option_is_not_assigned_to_a_built_operator(name: str):
    """Its tables would stay those of before; other options: intrinsic_mm, method, collimator_mu."""
    A = Spect(Grid.centred((4, 4, 4), 4.0, (0, 0, 150)), pinhole())
    for operator in (A, deepcopy(A)):
        with pytest.raises(AttributeError, match=rf"another Spect\(grid, cameras, {name}="):
            setattr(operator, name, 5.0)


def test_it_is_found_by_name_with_its_options():
    A = PROJECTORS.build(
        "spect", grid=Grid.centred((4, 4, 4), 4.0, (0, 0, 150)), cameras=pinhole(), diameter_mm=3.0
    )
    assert isinstance(A, Spect)
    assert A.diameter_mm == 3.0


def test_its_configuration_composes():
    from mvrecon.apps.config import compose

    settings = compose("projector=spect", "projector.blur=true")["projector"]
    assert settings == {"name": "spect", "blur": True}


def test_invalid_cameras_and_diameters_are_refused():
    grid = Grid.centred((4, 4, 4), 4.0, (0, 0, 150))
    flipped = pinhole(extent="segment", v=torch.tensor([[0.0, -PIXEL, 0.0]]))
    with pytest.raises(ValueError, match="extent 'behind', got 'segment'"):
        Spect(grid, flipped)
    with pytest.raises(ValueError, match="diameter must be positive mm, got 0"):
        Spect(grid, pinhole(), diameter_mm=0)


USE = """
import torch
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon_spect.operators.projector import Spect

grid, rig = Grid.centred((12, 10, 9), 12.0), dcspect80(pixels=[7, 9], columns=[0, 7], rows=[0, 2])
for dtype in (torch.float32, torch.float64):
    for options in ({}, {"mu": 0.01}, {"blur": True}, {"mu": 0.01, "blur": True}):
        A = Spect(grid, rig, **options).to(dtype)
        x = torch.rand(1, 2, *grid.shape, dtype=dtype, requires_grad=True)
        A.T(A(x)).sum().backward()
"""


@pytest.mark.long
def test_nothing_is_compiled_after_the_warm_up(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    said = [
        subprocess.run([sys.executable, *command], capture_output=True, text=True, check=True)
        for command in (("-m", "mvrecon.apps.warmup"), ("-c", USE))
    ]
    assert ["compiling kernels" in run.stderr for run in said] == [True, False]
