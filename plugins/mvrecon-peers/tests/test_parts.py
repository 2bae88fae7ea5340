"""The plugin's parts: an absent library is named, parts are chosen by name, imports are lazy."""

import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
import torch
import yaml

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.operators.drr import Drr

GRID = Grid.centred(size=(7, 7, 5), spacing=2.0)
CONE = circular(4, 40.0, 70.0, {"pixels": [5, 7], "pixel_mm": [2.1, 2.3]}, start_degrees=13.0)
STACK = parallel(3, {"pixels": [5, 7], "pixel_mm": 2.0}, 60.0)
PLUGIN = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
PARTS: dict[str, dict[str, str]] = {"projector": {}, "method": {}}
for key, where in PLUGIN["entry-points"]["mvrecon.plugins"].items():
    kind, _, part = key.partition(".")
    if kind in PARTS:
        PARTS[kind][part] = where
LIBRARIES: dict[str, tuple[str, str, Grid, Cameras]] = {
    "rtk": ("itk", "itk-rtk", GRID, CONE),
    "nanodrr": ("nanodrr.data", "nanodrr", GRID, CONE),
    "diffdrr": ("diffdrr.renderers", "diffdrr", GRID, CONE),
    "astra": ("astra", "astra-toolbox", GRID, STACK),
    "mbirtorch": ("mbirtorch", "mbirtorch", GRID, CONE),
    "skimage": ("skimage.transform", "scikit-image", GRID, STACK),
}


@pytest.mark.parametrize("name", LIBRARIES)
def test_a_missing_library_is_reported_with_the_install_command(
    name: str, monkeypatch: pytest.MonkeyPatch
):
    module, package, grid, rig = LIBRARIES[name]
    monkeypatch.setitem(sys.modules, module, None)
    where, _, attribute = PARTS["projector"][name].partition(":")
    with pytest.raises(ImportError, match=f"pip install {package}"):
        getattr(import_module(where), attribute)(grid, rig)


@pytest.mark.parametrize("kind", PARTS)
def test_every_part_has_a_config_of_its_name(kind: str):
    folder = Path(__file__).parents[1] / "mvrecon_peers" / "conf" / kind
    chosen = {file.stem: yaml.safe_load(file.read_text()) for file in folder.glob("*.yaml")}
    assert chosen == {name: {"name": name} for name in PARTS[kind]}
    for where in PARTS[kind].values():
        module, _, attribute = where.partition(":")
        assert callable(getattr(import_module(module), attribute))


def test_importing_the_parts_imports_no_library():
    import subprocess

    modules = [where.partition(":")[0] for parts in PARTS.values() for where in parts.values()]
    code = f"import sys\nfor module in {modules}: __import__(module)\n"
    code += (
        "print({'itk', 'nanodrr', 'diffdrr', 'astra', 'mbirtorch', 'skimage'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=900, check=True
    )
    assert done.stdout == "set()\n"


@pytest.mark.parametrize("name", ["astra_methods.astra_sirt", "rtk_methods.rtk_cg"])
def test_methods_refuse_views_that_require_a_gradient(name: str):
    """They compute outside torch; a gradient would be lost."""
    module, method = name.split(".")
    A = Drr(GRID, CONE)
    views = torch.ones(1, 1, *A.range_shape, requires_grad=True)
    with pytest.raises(ValueError, match="Expected tensors without gradient for"):
        getattr(import_module(f"mvrecon_peers.{module}"), method)(A, views)
