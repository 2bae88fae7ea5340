"""The methods of a run by their labels."""

from mvrecon.engine.module import Settings
from mvrecon.files.checks import plain_name


def methods(settings: Settings) -> dict[str, Settings]:
    """The methods of a run's result table by label: the main one first, under `label` or, where the
    settings have none, its class's name; then those of `compare` that are not null.

    Raises:
        ValueError: the main method's label is taken twice, or a label is no plain name: files are
            called by it. "truth" is refused: its file is the truth's own.
    """
    main = settings["method"]
    label = settings.get("label") or main["name"]
    others = {label: model for label, model in settings["compare"].items() if model}
    if label in others:
        raise ValueError(
            f"compare holds {label!r}, which is the main method's own label; give this one another "
            f"by label=..., or leave the other out by compare.{label}=null"
        )
    labelled = {label: main, **others}
    # whatever the case: some file systems do not tell it
    if taken := [label for label in labelled if str(label).casefold() == "truth"]:
        raise ValueError(
            f"A method labelled {taken[0]!r} would overwrite truth.nii.gz; expected another label"
        )
    return {plain_name(label, "a method"): model for label, model in labelled.items()}
