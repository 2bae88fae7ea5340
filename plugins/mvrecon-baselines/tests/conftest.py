"""Small operators, and the entry points of the plugin."""

import sys
import tomllib
from importlib import invalidate_caches
from pathlib import Path

import pytest

from mvrecon.core.parts import CAMERAS, PROJECTORS
from mvrecon.core.registry import GROUP, installed
from mvrecon.geometry.grid import Grid

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module", autouse=True)
def plugin(tmp_path_factory):
    """The entry points, whether the plugin is installed or only on Python's path."""
    folder = tmp_path_factory.mktemp("plugin")
    about = folder / f"mvrecon_baselines-{PROJECT['version']}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {PROJECT['name']}\nVersion: {PROJECT['version']}\n"
    )
    points = PROJECT["entry-points"][GROUP].items()
    (about / "entry_points.txt").write_text(
        "\n".join([f"[{GROUP}]", *(f"{name} = {where}" for name, where in points)])
    )
    sys.path.insert(0, str(folder))
    invalidate_caches()
    installed.cache_clear()
    yield
    sys.path.remove(str(folder))
    invalidate_caches()
    installed.cache_clear()


@pytest.fixture
def fan():
    """Fans over one slice."""

    def make(n_views=8, size=16, **options):
        grid = Grid.centred(size=(size, size, 1), spacing=160 / size)
        detector = {"pixels": [1, 2 * size], "pixel_mm": 360 / (2 * size)}
        rig = {"n_views": n_views, "sid": 500.0, "sdd": 1000.0, "detector": detector}
        return PROJECTORS.build(
            "drr", grid=grid, cameras=CAMERAS.build("circular", **rig, **options)
        )

    return make


@pytest.fixture
def stack():
    """Parallel beams over a stack of slices, a detector row for each of them."""

    def make(n_views=8, size=16, slices=3):
        grid = Grid.centred(size=(size, size, slices), spacing=160 / size)
        detector = {"pixels": [slices, 2 * size], "pixel_mm": [160 / size, 180 / (2 * size)]}
        cameras = CAMERAS.build("parallel", n_views=n_views, detector=detector)
        return PROJECTORS.build("radon", grid=grid, cameras=cameras)

    return make


@pytest.fixture
def cone():
    """Cone beams over a cube."""

    def make(n_views=4, size=12, pixels=12):
        grid = Grid.centred(size, spacing=2.0)
        detector = {"pixels": [pixels, pixels], "pixel_mm": 5.0 * size / pixels}
        rig = {"n_views": n_views, "sid": 100.0, "sdd": 200.0, "detector": detector}
        return PROJECTORS.build("drr", grid=grid, cameras=CAMERAS.build("circular", **rig))

    return make
