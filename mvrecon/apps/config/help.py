"""The text of `--help`: examples first, then an app's choices and settings, in sentences."""

import json
import re
from textwrap import fill
from typing import Any

from mvrecon.apps.command_line import DOCUMENTATION
from mvrecon.apps.config.choices import app_file, choices_by_group, groups_of
from mvrecon.apps.settings import MISSING, RECORDS
from mvrecon.core.files.checks import yaml_of
from mvrecon.core.signatures import options_of

#: Columns of the text.
WIDTH = 100
#: Meaning of a group that is in no list of defaults.
PART = "A part of the method."
END = f"""
--cfg job prints all settings as composed, -m runs a sweep, --config-dir adds a folder of your own
experiment/*.yaml, --hydra-help lists the other flags. mvrecon-list KIND shows the options of each
part, mvrecon-list setting those of grid, views, data, acquisition and trainer.
{DOCUMENTATION}"""


def help_text(app: str, record: type | None = None) -> str:
    """The text of an app's `--help`, from its file of choices and its record of settings.

    The comment at the top of the file is the beginning, with the examples; the comments of its
    defaults are sentences about the choices. A plugin's file has the defaults of its settings.

    Args:
        app: name of its file of choices.
        record: a dataclass of all its settings; None: that of mvrecon's own app.
    """
    text = app_file(app).read_text(encoding="utf-8")
    body = re.sub(r"\A(?:#.*\n)+", "", text)
    about = re.sub(r"^# ?", "", text[: len(text) - len(body)], flags=re.MULTILINE)
    parts = [f"{about}\nUsage: mvrecon-{app} [group=choice ...] [key=value ...]"]
    meanings = dict(re.findall(r"^  - ([\w@]+): \S+ +# (.*)", body, re.MULTILINE))
    known, taken = choices_by_group(), groups_of(app)
    chosen = [
        _entry(key, default, meanings.get(key, PART), f"Choices: {', '.join(known[group])}")
        for key, default in taken.items()
        if (group := key.partition("@")[0]) in known
    ]
    if chosen:
        parts.append("Choices, with their defaults:\n" + "\n".join(chosen))
    values = yaml_of(app_file(app))
    filled = {key.rpartition("@")[2] for key in taken}
    options = {k: o for k, o in options_of(record or RECORDS[app])[0].items() if k not in filled}
    entries = [_entry(key, values.get(key, o.default), o.text) for key, o in options.items()]
    parts.append("Settings, with their defaults:\n" + "\n".join(entries))
    return "\n\n".join(parts) + "\n" + END


def example_of(app: str) -> str:
    """The first setting of the examples in an app's file of choices."""
    example = re.search(r"^#   mvrecon-\S+ (\S+=\S+)", app_file(app).read_text("utf-8"), re.M)
    return example[1] if example else "name=mine"


def _entry(key: str, default: Any, *sentences: str) -> str:
    """A setting and its default as on a command line, and below it what it means."""
    value = re.sub(r'"([^"]*)"', r"\1", json.dumps(default)).replace("{}", "null")
    pad = " " * 6
    lines = [
        fill(text, WIDTH, initial_indent=pad, subsequent_indent=pad, break_on_hyphens=False)
        for text in sentences
        if text
    ]
    return "\n".join([f"  {key}" if default == MISSING else f"  {key}={value}", *lines])
