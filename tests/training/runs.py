"""Tests of run folders share this: apps called by their command lines, a crowd of processes, and a
rig in a file.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras import files
from mvrecon.training import fit, run_folder
from mvrecon.training.settings import TrainSettings

RIG = {
    "name": "circular",
    "n_views": 3,
    "sid": 400.0,
    "sdd": 800.0,
    "detector": {"pixels": [12, 12], "pixel_mm": 22.0},
}
NOON = "2026-01-01_12-00-00"


def contents(folder):
    """Every file of a folder, and its bytes."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def call(app, *options):
    """Run an app with a command line; its exit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [app.__name__, *options, "hydra/job_logging=none"])
        try:
            app.main()
        except SystemExit as stop:
            return stop.code
    return 0


def trained_for_a_step(folder, *methods, options=()):
    """A run folder of so many methods of the smoke experiment, each trained for one step, with more
    options.
    """
    main, *others = methods
    compared = [f"+method@compare.{name}={name}" for name in others]
    length = ("trainer.max_steps=1", "trainer.val_check_interval=1")
    settings = TrainSettings(
        **compose("experiment=smoke", f"method={main}", *compared, *length, *options)
    )
    run_folder.start(folder, vars(settings))
    for label in methods:
        fit.fit(label, settings, fit.build_data(settings), folder)
    return folder


def crowd(kind, folder):
    """What the processes of a crowd answered, and what they said."""
    command = [sys.executable, "-m", "tests.training.crowd", kind, str(folder)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    root = Path(__file__).parents[2]
    done = subprocess.run(
        command, cwd=root, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


def rig_file(folder, shift=0.0):
    """A rig in a file, its sources shifted by some mm along x."""
    cameras = CAMERAS.from_config(RIG)
    shifted = replace(cameras, source=cameras.source + torch.tensor([shift, 0.0, 0.0]))
    files.save(shifted, folder / "rig.json")
    return folder / "rig.json"
