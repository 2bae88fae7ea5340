"""A run that goes on to more steps than it was begun with."""

from pathlib import Path
from typing import Any

from mvrecon.core.files.atomic import claimed
from mvrecon.core.files.runs import RESULTS
from mvrecon.core.machine import world
from mvrecon.data.module import SceneData
from mvrecon.training import run_folder
from mvrecon.training.checkpoints import finished, unfinished
from mvrecon.training.module import Settings, methods, share
from mvrecon.training.progress import tell
from mvrecon.training.storage import read, write


def lengthened(settings: Settings, folder: Path, steps: int) -> Settings:
    """A run's settings with more steps, written into its folder; every method goes on from its last
    checkpoint, that of a finished training too.

    The learning rate follows the schedule over all the steps from where the training is: that of
    the cosine rises again. The table of results goes: it is one of the shorter training.

    Args:
        settings: of the run.
        folder: of the run.
        steps: `trainer.max_steps` from now on.

    Raises:
        RuntimeError: another process is at work in the folder.
        ValueError: fewer steps than the run has, a run whose length is no number of steps, or
            several processes at once.
    """
    before = settings["trainer"]["max_steps"]
    if steps == before:
        return settings
    if world() > 1:
        raise ValueError(f"A run is lengthened by one process, got {world()}")
    if not 0 < before < steps:
        raise ValueError(
            f"{folder} was begun with trainer.max_steps={before}; expected more, got {steps}"
        )
    longer = {**settings, "trainer": {**settings["trainer"], "max_steps": steps}}
    with claimed(folder):
        run_folder.check(folder, settings)
        for method in methods(settings):
            done, last = finished(folder, method), unfinished(folder, method)
            if done.exists():
                write(last, _going_on(read(done)))
                done.unlink()
        (folder / RESULTS).unlink(missing_ok=True)
        run_folder.start(folder, longer)  # at the end: what breaks off before is a run as it was
    tell(_sentence(settings, before, steps))
    return longer


def _going_on(checkpoint: dict[str, Any]) -> dict[str, Any]:
    """A finished training's checkpoint as one in the middle of its last epoch, if this was cut
    short: for Lightning an epoch is over when the training is.
    """
    if not checkpoint.get(SceneData.__qualname__, {}).get("seen"):
        return checkpoint
    progress = checkpoint["loops"]["fit_loop"]["epoch_progress"]
    for counts in (progress["total"], progress["current"]):
        for stage in ("processed", "completed"):
            counts[stage] -= 1
    return {**checkpoint, "epoch": checkpoint["epoch"] - 1}


def _sentence(settings: Settings, before: int, steps: int) -> str:
    """What becomes of the learning rate."""
    optimizer = settings["optimizer"]
    name, warmup = optimizer.get("schedule", "cosine"), optimizer.get("warmup", 0.0)
    old, new = (share(name, before, n, warmup) for n in (before, steps))
    return (
        f"{before} steps become {steps}: the learning rate follows the schedule {name!r} over all "
        f"{steps}, at step {before} with {new:.0%} of its highest in place of {old:.0%}"
    )
