"""The plugin's parts: an absent library is named, defaults are configured, imports are lazy."""

import sys
import tomllib
from importlib import import_module
from inspect import signature
from pathlib import Path

import pytest
import yaml

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid

GRID = Grid.centred(size=(7, 7, 5), spacing=2.0)
CONE = circular(4, 40.0, 70.0, {"pixels": [5, 7], "pixel_mm": [2.1, 2.3]}, start_degrees=13.0)
STACK = parallel(3, {"pixels": [5, 7], "pixel_mm": 2.0}, 60.0)
PLUGIN = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
PARTS = {
    k.partition(".")[2]: v
    for k, v in PLUGIN["entry-points"]["mvrecon.plugins"].items()
    if k[:9] == "projector"
}
LIBRARIES: dict[str, tuple[str, str, Grid, Cameras]] = {
    "rtk": ("itk", "itk-rtk", GRID, CONE),
    "nanodrr": ("nanodrr.data", "nanodrr", GRID, CONE),
    "diffdrr": ("diffdrr.renderers", "diffdrr", GRID, CONE),
    "astra": ("astra", "astra-toolbox", GRID, STACK),
    "mbirtorch": ("mbirtorch", "mbirtorch", GRID, CONE),
    "skimage": ("skimage.transform", "scikit-image", GRID, STACK),
}


@pytest.mark.parametrize("name", LIBRARIES)
def test_a_library_that_is_absent_is_named_with_what_installs_it(
    name: str, monkeypatch: pytest.MonkeyPatch
):
    module, package, grid, rig = LIBRARIES[name]
    monkeypatch.setitem(sys.modules, module, None)
    where, _, attribute = PARTS[name].partition(":")
    with pytest.raises(ImportError, match=f"pip install {package}"):
        getattr(import_module(where), attribute)(grid, rig)


def test_every_part_is_configured_by_its_own_defaults():
    folder = Path(__file__).parents[1] / "mvrecon_peers" / "conf" / "projector"
    assert {file.stem for file in folder.glob("*.yaml")} == set(PARTS) == set(LIBRARIES)
    for name, where in PARTS.items():
        module, _, attribute = where.partition(":")
        parameters = signature(getattr(import_module(module), attribute)).parameters
        options = {
            key: p.default for key, p in parameters.items() if key not in ("grid", "cameras")
        }
        assert yaml.safe_load((folder / f"{name}.yaml").read_text()) == {"name": name} | options


def test_every_reconstructor_is_configured_by_its_own_defaults():
    folder = Path(__file__).parents[1] / "mvrecon_peers" / "conf" / "reconstructor"
    methods = {
        k.partition(".")[2]: v
        for k, v in PLUGIN["entry-points"]["mvrecon.plugins"].items()
        if k.startswith("reconstructor")
    }
    assert {file.stem for file in folder.glob("*.yaml")} == set(methods)
    for name, where in methods.items():
        module, _, attribute = where.partition(":")
        _, _, *options = signature(getattr(import_module(module), attribute)).parameters.values()
        expected = {"name": name} | {option.name: option.default for option in options}
        assert yaml.safe_load((folder / f"{name}.yaml").read_text()) == expected


def test_importing_the_parts_imports_no_library():
    import subprocess

    code = f"import sys\nfor m in {[w.partition(':')[0] for w in PARTS.values()]}: __import__(m)\n"
    code += (
        "print({'itk', 'nanodrr', 'diffdrr', 'astra', 'mbirtorch', 'skimage'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=900, check=True
    )
    assert done.stdout == "set()\n"
