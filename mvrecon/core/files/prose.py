"""What texts in a header state: entries of any program, and lines of prose."""

import re
from collections.abc import Iterable

from mvrecon.core.files.keys import IMAGE_EFFECTS, has_effect

#: An entry in a comment, as Dectris writes it, a value in an element of XML, and an object within
#: one of JSON.
LINE = re.compile(r"^\s*# *(\w+)[ =:]+(.*?)\s*$", re.MULTILINE)
ELEMENT = re.compile(r"<([\w:.-]+)[^<>]*>\s*([^<>\s][^<>]*)</")
OBJECT = re.compile(r"\"\s*:\s*\{\s*\"")
#: Where a text divides: lines, parts of lists, elements.
PART = re.compile(r"[\n\r;<>{}]|,(?=\s*[\"'[])|,(?=\s*[^\W\d][\w .-]{0,60}[:=])")
#: An entry, a name and a value; and the name of another within its value, but in brackets.
ENTRY = re.compile(r"([^\W\d][^:=\t\"']*?)[\"']?\s*[:=\t]\s*(.*)")
INNER, BRACKETS = re.compile(r"[^\W\d][\"']?\s*[:=]"), re.compile(r"\([^()]*\)")
#: Characters of a part of a text that are shown.
SHOWN = 80
#: Words of prose, beside those of keys, on what was done to grey values.
PROSE = {
    **IMAGE_EFFECTS,
    r"divided|rotated|optical.?densit|(?<![a-z])(ln|log(10|2|e)?) ?\(": None,
}


def statements(text: str) -> dict[str, str]:
    """What a text states, in parts: the values of entries (lines of a name and a value, JSON, XML)
    by their names; and other lines with words, and lines of several entries, by themselves.
    """
    found: dict[str, str] = {}
    lines = ELEMENT.sub(r"\n\1: \2\n<", LINE.sub(r"\1: \2", text))
    for part in PART.split(OBJECT.sub(".", lines)):
        plain = part.strip(" \t,[]()#*\"'")
        entry = ENTRY.fullmatch(plain)
        name, value = entry.groups() if entry else (plain, plain)
        if not (entry or re.search(r"[^\W\d]{2}", name)) or part.startswith(("/", "?", "!")):
            continue
        several = INNER.search(BRACKETS.sub("", value))
        value = re.sub(r"[\s,\"'()[\]]+", " ", value)
        name = plain if several or found.get(name, value) != value else name
        found[name if len(name) <= SHOWN else f"{name[:SHOWN]}..."] = value
    return found


def said(texts: Iterable[tuple[str, str]]) -> list[str]:
    """The parts of texts that may state what was done to values, behind the names of the texts: an
    entry whose name has a word of `PROSE` and whose value has an effect, and a line with one.
    """
    return [
        f"{name}: {part}"
        for name, text in texts
        for part, value in statements(text).items()
        if has_effect(part, value, PROSE)
    ]
