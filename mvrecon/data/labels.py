"""Names of the structures that a volume file labels."""

import re
from pathlib import Path

from mvrecon.files.checks import Refused, shown

#: A label and the name of its structure.
NAMED = re.compile(r"([1-9][0-9]{0,2})=([^=,]+)")


def structures_of(path: Path, text: str | None) -> dict[str, int]:
    """Label of each structure by its name, from a text such as "1=Brainstem,2=SpinalCord".

    Raises:
        Refused: no text, another form, labels above 255, or a label or a name that comes twice.
    """
    entries = [NAMED.fullmatch(entry.strip()) for entry in (text or "").split(",")]
    named = {entry[2]: int(entry[1]) for entry in entries if entry}
    if len(set(named.values())) < len(entries) or max(named.values()) > 255:
        raise Refused(
            f"{path}: expected the attribute labels to name each structure once, such as "
            f"'1=Brainstem,2=SpinalCord' with labels from 1 to 255, got {shown(text)}"
        )
    return named
