"""Every top-level setting of the apps: its type, its default, and its text in `--help`.

Importing this file imports no part and neither torch nor Lightning: types name them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from mvrecon.core.parts import (
    CameraPart,
    FactorsPart,
    MethodPart,
    Options,
    OptionsOf,
    PartOf,
    ProjectorPart,
    ScatterPart,
    ScenePart,
)
from mvrecon.core.quantities import NonNegativeFloat, NonNegativeInt, WeightsFile
from mvrecon.training.settings import (
    MISSING,
    AcquisitionOptions,
    DataOptions,
    GridOptions,
    Measurement,
    MethodOfRun,
    TrainerOptions,
    TrainSettings,
    default,
)

ViewsOptions: TypeAlias = Annotated[Options, OptionsOf("mvrecon.data.projections.views:Measured")]
AlignOptions: TypeAlias = Annotated[
    Options,
    OptionsOf("mvrecon.methods.calibration.self_alignment:self_aligned", passed=2),
]
#: Sections of settings that are no parts, for `mvrecon-list setting`.
SECTIONS: dict[str, Any] = {
    "grid": GridOptions,
    "views": ViewsOptions,
    "data": DataOptions,
    "acquisition": AcquisitionOptions,
    "correct": AlignOptions,
    "trainer": TrainerOptions,
}


@dataclass
class SimulateSettings(Measurement):
    """Settings of `mvrecon-simulate`.

    Args:
        seed: series of random cases; 0 is the test series of runs
        rtk: also write files for RTK: geometry.xml in IEC axes, 16-bit TIFF with dark and flat
            fields
        picture: mosaic: all views as one picture with a colour bar, mosaic.png
        cases: indices of the scene's cases
    """

    name: str = "simulate"
    rtk: bool = False
    picture: Literal["mosaic"] | None = None
    cases: Sequence[NonNegativeInt] = default(0)


@dataclass
class ReconstructSettings:
    """Settings of `mvrecon-reconstruct`.

    Args:
        name: the run folder is outputs/<name>/<date_time>
        grid: size and spacing (and centre), or like; without: a trained network's own, or what
            seen_by of the views see (default 1.0; of a half fan 0.5), at the detector's resolution
            at the isocentre
        out: the volume's file (.nii, .nii.gz, .mha, .nrrd; plugins add others); null: volume.nii.gz
            in the run folder; of several scans with a *
        unit: of the volume that is written: 1/mm (of counts: activity, kBq/ml), or HU (water is
            0.0192/mm, air 0)
        stop: sigma: standard deviation of the line integrals' noise: stops where the noise explains
            the residual
        choose: chooses the iterations on left-out views: {every: 8}; with {every: 8, weights:
            [1.0e-4, 1.0e-3]} also the weight
        calibrate: fits the rig to the views first: [offset_u, tilt]; offset_v, slant, swivel for
            all views, shifts and gains for each (docs/calibration.md)
        scatter: of counts, with mvrecon-spect: {name: given, path: ...}, {name: dew, lower: ...} or
            {name: tew, ...} (docs/spect_corrections.md)
        factors: of counts, with mvrecon-spect: {name: detector, flood: ..., half_life_s: ...,
            dead_time_us: ..., branching: ...} (docs/spect_corrections.md)
        self_calibrate: with correct=align: corrects the cameras instead of the views
        left_out: true: error of each view as predicted by all others; one more reconstruction a
            view
        device: or cpu, gpu
        plugins: modules to import first; they register parts
    """

    views: ViewsOptions = MISSING
    camera: CameraPart = MISSING
    projector: ProjectorPart = MISSING
    method: MethodPart = MISSING
    correct: AlignOptions | None = None
    name: str = "reconstruct"
    grid: Annotated[Options, OptionsOf("mvrecon.apps.scan:GridOfScan")] = field(
        default_factory=dict
    )
    out: Path | None = None
    unit: Literal["1/mm", "HU"] = "1/mm"
    stop: Mapping[str, NonNegativeFloat | None] = default(sigma=None)
    choose: Annotated[Options, OptionsOf("mvrecon.apps.run_method:Choose")] | None = None
    calibrate: Sequence[str] | None = None
    scatter: ScatterPart | None = None
    factors: FactorsPart | None = None
    self_calibrate: bool = False
    left_out: bool = False
    device: str = "auto"
    plugins: str | Sequence[str] | None = default()


@dataclass
class EvalSettings:
    """Settings of `mvrecon-eval`; null or empty ones are those of the run.

    Args:
        name: the folder of the table is outputs/<name>/<date_time>
        checkpoint: a run's folder, or a checkpoint in it
        grid: grid.size=[48,48,48] evaluates on another grid
        data: data.sizes.test=8 evaluates 8 scenes
        compare: further methods, name -> method
        device: or cpu, gpu
        save: also save every case's volumes and pictures
        plugins: modules to import first; they register parts
    """

    name: str = "eval"
    checkpoint: WeightsFile = MISSING
    test_scene: ScenePart | None = None
    acquisition: AcquisitionOptions | None = None
    camera: Annotated[Options, PartOf("camera", partial=True)] | None = None
    grid: GridOptions | None = field(default_factory=dict)
    data: DataOptions | None = field(default_factory=dict)
    compare: Mapping[str, MethodOfRun | None] | None = field(default_factory=dict)
    device: str = "auto"
    save: bool = False
    plugins: str | Sequence[str] | None = default()


#: The record of each app.
RECORDS: dict[str, type] = {
    "train": TrainSettings,
    "eval": EvalSettings,
    "simulate": SimulateSettings,
    "reconstruct": ReconstructSettings,
}
