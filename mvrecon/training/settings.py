"""Settings of a training run: the type, default and text of each.

Importing this file imports no part and neither torch nor Lightning: types name them.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from mvrecon.core.files.checks import plain_name
from mvrecon.core.machine import Device
from mvrecon.core.parts import CameraPart, Options, ProjectorPart, ScenePart
from mvrecon.core.quantities import NonNegativeInt, WeightsFile
from mvrecon.core.signatures import NamesOf, OptionsOf, PartOf

GridOptions: TypeAlias = Annotated[Options, OptionsOf("mvrecon.geometry.grid:Grid.centred")]
AcquisitionOptions: TypeAlias = Annotated[
    Options, OptionsOf("mvrecon.data.acquisition.detector:Acquisition")
]
DataOptions: TypeAlias = Annotated[
    Options, OptionsOf("mvrecon.data.module:CaseOptions", "mvrecon.data.module:Loading")
]
TrainerOptions: TypeAlias = Annotated[
    Options, OptionsOf("mvrecon.training.fit:TrainerOptions", "lightning.pytorch:Trainer")
]
MethodOfRun: TypeAlias = Annotated[
    Options, PartOf("method", also="mvrecon.training.fit:Assumptions")
]
OptimizerPart: TypeAlias = Annotated[
    Options, PartOf("optimizer", also="mvrecon.training.module:Schedule")
]
CallbackPart: TypeAlias = Annotated[
    Options, PartOf("callback", targets="mvrecon.training.targets:allowed")
]
LoggerPart: TypeAlias = Annotated[
    Options, PartOf("logger", targets="mvrecon.training.targets:allowed", supplied=("save_dir",))
]
#: A setting that must be given, as OmegaConf writes it.
MISSING: Any = "???"


def default(*values: Any, **entries: Any) -> Any:
    """A default that is a list or a mapping."""
    return field(default_factory=lambda: [*values] if values or not entries else {**entries})


@dataclass
class Measurement:
    """Settings shared by apps.

    Args:
        name: Name of the run folder, outputs/<name>/<date_time>.
        seed: Number of the series of random cases.
        grid: The field of view: voxels along x, y and z, and their spacing in mm.
        plugins: Modules to import first, which register parts.
    """

    name: str = MISSING
    seed: NonNegativeInt = 0
    grid: GridOptions = default(size=[32, 32, 32], spacing=4.0)
    scene: ScenePart = MISSING
    camera: CameraPart = MISSING
    projector: ProjectorPart | None = None
    acquisition: AcquisitionOptions | None = None
    plugins: str | Sequence[str] | None = default()


@dataclass
class TrainSettings(Measurement):
    """Settings of `mvrecon-train`.

    Args:
        label: Name of the main method in the table; null: the name of its file in conf/method.
        compare: Other methods of the result table, by name.
        loss: Weights of the terms of the loss; mvrecon-list loss describes them.
        device: Where it computes: auto, cpu or gpu.
        init_from: A run or a file of weights that initialise the main method.
        resume: A run folder, or a checkpoint in one, that is continued.
    """

    name: str = "train"
    projector: ProjectorPart = MISSING
    test_scene: ScenePart | None = None
    method: MethodOfRun = MISSING
    label: str | None = None
    compare: Mapping[str, MethodOfRun | None] | None = field(default_factory=dict)
    loss: Annotated[Mapping[str, float], NamesOf("loss")] = default(
        volume=1.0,
        common_field=0.0,
        per_view_gain=1e-3,
        cross_view=0.0,
        entry=0.0,
        uncertainty=1e-3,
    )
    optimizer: OptimizerPart = MISSING
    data: DataOptions = MISSING
    trainer: TrainerOptions = MISSING
    callbacks: Mapping[str, CallbackPart | None] | None = None
    logger: Mapping[str, LoggerPart | None] | None = None
    device: Device = "auto"
    init_from: WeightsFile | None = None
    resume: Path | None = None

    def methods(self) -> dict[str, Options]:
        """The methods of the run's result table by label: the main one first, under `label` or else
        its name; then those of `compare` that are not null.

        Raises:
            ValueError: a label that is the main one's or "truth", whose volume or checkpoint would
                have the name of another's (in any case), or that is not a valid file name.
        """
        label = self.label or self.method["name"]
        others = {other: method for other, method in (self.compare or {}).items() if method}
        if label in others:
            raise ValueError(
                f"compare holds {label!r}, which is the main method's own label; give this one "
                f"another by label=..., or leave the other out by compare.{label}=null"
            )
        labelled = {label: self.method, **others}
        # case-insensitive, as some file systems are
        if taken := [label for label in labelled if str(label).casefold() == "truth"]:
            raise ValueError(
                f"A method labelled {taken[0]!r} would overwrite truth.nii.gz; expected another "
                f"label"
            )
        names = {
            label: {f"{str(label).casefold()}{end}" for end in ("", ".ckpt", ".previous.ckpt")}
            for label in labelled
        }
        used = Counter(chain.from_iterable(names.values()))
        if shared := [label for label, own in names.items() if any(used[n] > 1 for n in own)]:
            raise ValueError(
                f"Methods labelled {' and '.join(map(repr, shared))} would write files of one "
                f"name, where case does not count; expected other labels"
            )
        return {
            plain_name(name, "label" if name == label else "compare"): method
            for name, method in labelled.items()
        }
