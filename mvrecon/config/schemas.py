"""The top-level settings of the apps, so that a mistyped one is an error instead of a silent
extra.
"""

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING


@dataclass
class Measurement:
    """The top-level keys that the apps share: what is measured, by which rig, and how."""

    name: str = MISSING
    seed: int = 0
    grid: Any = None
    scene: Any = None
    camera: Any = None
    projector: Any = None
    acquisition: Any = None
    plugins: Any = field(default_factory=list)


@dataclass
class Simulation(Measurement):
    """Every top-level key of `mvrecon-simulate`."""

    rtk: bool = False
    cases: list[int] = MISSING
    events: Any = None


@dataclass
class Settings(Measurement):
    """Every top-level key of `mvrecon-train`, so that a mistyped one is an error instead of a
    silent extra.
    """

    test_scene: Any = None
    method: Any = None
    label: str | None = None
    compare: Any = field(default_factory=dict)
    loss: Any = field(default_factory=dict)
    optimizer: Any = None
    data: Any = None
    trainer: Any = None
    callbacks: Any = None
    logger: Any = None
    device: str = "auto"
    init_from: str | None = None
    resume: str | None = None


@dataclass
class ScanSettings:
    """Every top-level key of `mvrecon-reconstruct`."""

    name: str = MISSING
    views: Any = None
    camera: Any = None
    projector: Any = None
    grid: Any = MISSING
    method: Any = None
    correct: Any = None
    self_calibrate: bool = False
    left_out: bool = False
    out: str | None = None
    unit: str = MISSING
    stop: Any = None
    choose: Any = None
    calibrate: Any = None
    device: str = "auto"
    plugins: Any = field(default_factory=list)


@dataclass
class Evaluation:
    """Every top-level key of `mvrecon-eval`; settings that the run fixes, such as the method, are
    not keys.
    """

    name: str = MISSING
    checkpoint: str = MISSING
    test_scene: Any = None
    acquisition: Any = None
    camera: Any = None
    grid: Any = field(default_factory=dict)
    data: Any = None
    compare: Any = field(default_factory=dict)
    device: str = "auto"
    save: bool = False
    plugins: Any = field(default_factory=list)


SCHEMAS = {
    "schema": Settings,
    "evaluation_schema": Evaluation,
    "simulation_schema": Simulation,
    "reconstruction_schema": ScanSettings,
}
