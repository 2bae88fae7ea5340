"""Every top-level setting of the apps: its type, its default, and its text in `--help`.

Importing this file imports no part and neither torch nor Lightning: types name them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypedDict

from mvrecon.core.files.checks import Refused
from mvrecon.core.machine import Device
from mvrecon.core.parts import (
    CameraPart,
    FactorsPart,
    MethodPart,
    Options,
    ProjectorPart,
    ScatterPart,
    ScenePart,
)
from mvrecon.core.quantities import NonNegativeFloat, NonNegativeInt, WeightsFile
from mvrecon.core.signatures import OptionsOf, PartOf
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

ViewsOptions: TypeAlias = Annotated[Options, OptionsOf("mvrecon.data.projections.options:Measured")]
AlignOptions: TypeAlias = Annotated[
    Options, OptionsOf("mvrecon.methods.calibration.self_alignment:self_aligned", passed=2)
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
        seed: Number of the series of random cases; 0 is the test series of runs.
        rtk: Also writes files for RTK: geometry.xml in IEC axes, and 16-bit TIFF with dark and flat
            fields.
        picture: mosaic writes all views as one picture with a colour bar, mosaic.png.
        cases: Indices of the scene's cases, such as [0, 3].
    """

    name: str = "simulate"
    rtk: bool = False
    picture: Literal["mosaic"] | None = None
    cases: Sequence[NonNegativeInt] = default(0)


class Further(TypedDict, total=False):
    """How a further measurement differs from the first, see `complete`.

    Args:
        views: options of its views, such as another path or dataset.
        camera: options of its rig.
        projector: options of the projector, such as mu and intrinsic_mm at its energy.
        scatter: scatter in its counts.
        factors: options of the factors, such as branching at its energy, or time_s of a frame.
    """

    views: ViewsOptions
    camera: Annotated[Options, PartOf("camera", partial=True)]
    projector: Annotated[Options, PartOf("projector", partial=True)]
    scatter: ScatterPart | None
    factors: Annotated[Options, PartOf("factors", partial=True)] | None


@dataclass
class ReconstructSettings:
    """Settings of `mvrecon-reconstruct`.

    Args:
        name: Name of the run folder, outputs/<name>/<date_time>.
        grid: The voxels: size (one number or [x,y,z]) and spacing in mm (and centre), or
            like=volume.nii.gz for those of another volume, in its order of axes. By default those
            of a trained network, else what seen_by (a share, by default 1.0) of the views see, or
            the views of a half fan measure together, at the detector's resolution at the
            isocentre.
        out: File of the volume (.nii, .nii.gz, .mha, .nrrd; plugins add others), of several scans
            with a *; null: volume.nii.gz in the run folder.
        unit: Unit of the written volume: 1/mm (of counts: activity, kBq/ml), or HU (water is
            0.0192/mm, air 0).
        stop: stop.sigma is the standard deviation of the noise of the line integrals; iterations
            end where this noise explains the residual.
        choose: Chooses the number of iterations on left-out views, {every: 8}, and the weight of a
            prior as well, {every: 8, weights: [1.0e-4, 1.0e-3]}.
        calibrate: Numbers of the rig that are fitted to the views first, such as [offset_u, tilt];
            offset_v, slant and swivel of all views, shifts and gains of each
            (docs/calibration.md).
        scatter: Estimate of the scatter in counts, with mvrecon-spect: {name: given, path: ...},
            {name: dew, lower: ...} or {name: tew, ...} (docs/spect_corrections.md).
        factors: Corrections of counts for the detector and decay, with mvrecon-spect: {name:
            detector, flood: ..., half_life_s: ..., dead_time_us: ..., branching: ...}
            (docs/spect_corrections.md).
        joint: Further counts of the same object in the same likelihood, such as other photopeaks or
            gated frames: what differs from the first, [{views: {path: ...}, projector: {mu: ...},
            factors: {branching: ...}}] (docs/spect_corrections.md).
        estimate_shifts: With joint=[...], estimates how far the object is shifted in each
            measurement, and lets the cameras follow it.
        self_calibrate: With correct=align, moves the cameras instead of the views.
        left_out: Also predicts each view from all others and reports the error, at the cost
            of one more reconstruction per view.
        device: Where it computes: auto, cpu or gpu.
        plugins: Modules to import first, which register parts.
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
    joint: Sequence[Annotated[Options, OptionsOf("mvrecon.apps.settings:Further")]] | None = None
    estimate_shifts: bool = False
    self_calibrate: bool = False
    left_out: bool = False
    device: Device = "auto"
    plugins: str | Sequence[str] | None = default()


@dataclass
class EvalSettings:
    """Settings of `mvrecon-eval`; null or empty ones are those of the run.

    Args:
        name: Name of the folder of the table, outputs/<name>/<date_time>.
        checkpoint: Folder of the run, or a checkpoint in it.
        grid: Another grid, such as grid.size=[48,48,48].
        data: Other test data, such as data.sizes.test=8 for 8 scenes.
        compare: Further methods of the table, by name.
        device: Where it computes: auto, cpu or gpu.
        save: Also writes the volumes and pictures of every case.
        plugins: Modules to import first, which register parts.
    """

    name: str = "eval"
    checkpoint: WeightsFile = MISSING
    test_scene: ScenePart | None = None
    acquisition: AcquisitionOptions | None = None
    camera: Annotated[Options, PartOf("camera", partial=True)] | None = None
    grid: GridOptions | None = field(default_factory=dict)
    data: DataOptions | None = field(default_factory=dict)
    compare: Mapping[str, MethodOfRun | None] | None = field(default_factory=dict)
    device: Device = "auto"
    save: bool = False
    plugins: str | Sequence[str] | None = default()


#: What a further measurement takes over from the first.
OWN = ("views", "camera", "projector", "factors")


def complete(settings: ReconstructSettings) -> ReconstructSettings:
    """The settings with all options of every further measurement: its own, or else those of the
    first; a part with another name has only its own.

    Raises:
        Refused: views that are those of another measurement, or scatter that is left out where the
            first has some.
    """
    known: list[Any] = [dict(settings.views)]
    found: list[Options] = []
    for number, own in enumerate(settings.joint or ()):
        if settings.scatter and "scatter" not in own:
            raise Refused(
                f"joint.{number}: expected its own scatter (null: none), as the first views have "
                f"some, got none"
            )
        given = {key: vars(settings)[key] for key in OWN}
        changes = {key: _merged(given[key], value) for key, value in own.items() if key in given}
        whole = {**given, **changes, "scatter": own.get("scatter")}
        if whole["views"] in known:
            raise Refused(
                f"joint.{number}.views: expected other views than those of another measurement, "
                f"got {own.get('views', {})}"
            )
        known.append(whole["views"])
        found.append(whole)
    return replace(settings, joint=found or None)


def _merged(first: Any, own: Any) -> Any:
    """A mapping with another's entries in the place of its own, at any depth."""
    if not isinstance(first, Mapping) or not isinstance(own, Mapping):
        return own
    if own.get("name", first.get("name")) != first.get("name"):
        return own
    return {**first, **{key: _merged(first.get(key), value) for key, value in own.items()}}


#: The record of each app.
RECORDS: dict[str, type] = {
    "train": TrainSettings,
    "eval": EvalSettings,
    "simulate": SimulateSettings,
    "reconstruct": ReconstructSettings,
}
