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
    assert project["project"]["scripts"]["mvrecon-events"] == "mvrecon_spect.events.app:main"


def test_simulate_rejects_an_events_experiment_in_one_line(monkeypatch, capsys):
    from mvrecon.apps import simulate

    monkeypatch.setattr(sys, "argv", ["mvrecon-simulate", "experiment=events"])
    with pytest.raises(SystemExit):
        simulate.main()
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert "experiment/events sets 'events', which is no setting of this app" in text


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


def test_a_failing_part_changes_no_file(tmp_path, capsys):
    """A wrong option of a part, counts that are missing, and a damaged file of a finished run; the
    grid's fitted detector is in the settings as numbers.
    """
    small = (*GRID, "seed=7", "scene=ellipsoids", "projector=drr", "camera=circular")
    options = (*small, "camera.n_views=2", "camera.detector.pixel_mm=fit", "events.workers=0")
    counts = ("acquisition.counts=1e4", "events.count=2", "events.shard=1")
    folder, new = tmp_path / "run", tmp_path / "new"
    call(folder, *options, *counts)
    assert "pixel_mm: fit" not in (folder / "config.yaml").read_text()
    shard = folder / "events" / "events-00001.h5"
    shard.write_bytes(shard.read_bytes()[:-100])
    before = files_of(folder)
    for place, more, message in (
        (folder, counts, "is it cut short"),
        (new, (*counts, "scene.sped=1"), "sped"),
        (new, ("acquisition.counts=null", "events.totals=null"), "counts of an event"),
        (new, (*counts, "plugins=[sped]"), "sped"),
    ):
        with pytest.raises(SystemExit):
            call(place, *options, *more)
        assert message in capsys.readouterr().err
        assert not new.exists()
    assert files_of(folder) == before


def files_of(folder):
    """Every file but the lock, and its bytes."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {path: path.read_bytes() for path in files}
