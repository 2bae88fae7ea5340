"""What must not compose: settings that are missing, misspelt, or made to harm. Not from within an app of Hydra's."""

from pathlib import Path

from mvrecon.config import compose
from mvrecon.testing import hostile
from mvrecon_bench.stresses.refusals import refusal

Wrong = dict[str, str]
#: Overrides with a typing mistake, and what the error must hold.
MISSPELT = {"projectr=drr": "projectr", "projector=dr": "drr.*radon", "gird.shape=[4,4,4]": "gird"}


def compositions(folder: Path) -> dict[str, Wrong]:
    """What each did that should have been refused; empty: nothing. Hostile ones are written to the folder."""
    sentinel = folder / "sentinel"
    found = {
        "missing": {
            "a setting that must be given": refusal(
                lambda: compose(config_name="eval"), "must be given: checkpoint=", LookupError
            )
        },
        "misspelt": {
            line: refusal(lambda line=line: compose(line), saying, Exception) for line, saying in MISSPELT.items()
        },
        "hostile": {
            name: _told(folder, text, "only a command line may") for name, text in hostile.experiments(sentinel).items()
        },
    }
    found["hostile"] |= {
        f"name {name!r}": _told(folder, f"name: {name!r}", "the name") for name in hostile.WAYS_OUT[:2]
    }
    found["hostile"] |= {
        "an environment variable": _told(folder, "name: ${oc.env:HOME}", "environment variables"),
        "a bomb": _told(folder, hostile.BOMB, "unfolds to more than"),
        "a tag": _told(folder, f'name: !!python/object/apply:os.system ["touch {sentinel}"]', "constructor|not YAML"),
        "the sentinel": "something ran" if sentinel.exists() else "",
    }
    return found


def _told(folder: Path, text: str, saying: str) -> str:
    return refusal(lambda: compose(*hostile.experiment(folder, text)), saying, Exception)
