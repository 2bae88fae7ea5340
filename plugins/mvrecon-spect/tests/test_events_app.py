"""`mvrecon-events` as a user calls it."""

import sys
import tomllib
from pathlib import Path

import h5py
import pytest

import mvrecon_spect.events.app
from mvrecon.core.parts import CAMERAS

GRID = ("grid.size=[16,16,16]", "grid.spacing=8")


def call(folder, *options):
    """Run the app with a command line."""
    patch = pytest.MonkeyPatch()
    line = ["mvrecon-events", *options, f"hydra.run.dir={folder}", "hydra/job_logging=none"]
    patch.setattr(sys, "argv", line)
    try:
        mvrecon_spect.events.app.main()
    finally:
        patch.undo()


def test_the_plugin_brings_the_command():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    assert project["project"]["scripts"] == {"mvrecon-events": "mvrecon_spect.events.app:main"}


def test_simulate_rejects_an_events_experiment_in_one_line(monkeypatch, capsys):
    from mvrecon.apps import simulate

    monkeypatch.setattr(sys, "argv", ["mvrecon-simulate", "experiment=events"])
    with pytest.raises(SystemExit):
        simulate.main()
    assert capsys.readouterr().err == (
        "mvrecon-simulate: experiment/events sets 'events', which is not here: mistyped, or of "
        "another app\n"
    )


def test_a_stopped_run_resumes_with_any_number_of_workers(tmp_path, capsys):
    small = (*GRID, "seed=7", "scene=ellipsoids", "acquisition.counts=1e4", "projector=drr")
    options = (*small, "camera=circular", "camera.n_views=2", "camera.detector.pixels=[8,8]")
    events = ["events.count=3", "events.shard=2", "events.workers=0", "events.angles=4"]
    folder = tmp_path / "run"
    call(folder, *options, *events)
    names = sorted(p.name for p in (folder / "events").iterdir())
    assert names == ["SHA256SUMS", "events-00000.h5", "events-00001.h5"]
    whole = (folder / "events" / "events-00001.h5").read_bytes()
    (folder / "events" / "events-00001.h5").unlink()
    call(folder, *options, *events, "events.workers=1")
    assert (folder / "events" / "events-00001.h5").read_bytes() == whole
    with pytest.raises(SystemExit):
        call(folder, *options, *events, "events.count=4")
    assert "got events.count=4, expected 3" in capsys.readouterr().err
    assert CAMERAS.build("from_file", path=folder / "rig.json").shape == (8, 8)
    with h5py.File(folder / "events" / "events-00000.h5") as file:
        assert file["truth"].shape == (2, 16, 16, 16) and file["radon"].shape == (2, 4, 16, 23)
