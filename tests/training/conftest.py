"""A finished run for the tests of run folders."""

import pytest

import mvrecon.apps.train
from tests.training.lives import OPTIONS
from tests.training.runs import call, rig_file


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A finished run with a rig from a file, and its command line."""
    place = tmp_path_factory.mktemp("run")
    options = [option for option in OPTIONS if not option.startswith("camera")]
    options += [
        "camera=from_file",
        f"camera.path={rig_file(place)}",
        f"hydra.run.dir={place}/run",
        "seed=3",
        "method.n_cameras=3",
    ]
    assert call(mvrecon.apps.train, *options) == 0
    return place / "run", options
