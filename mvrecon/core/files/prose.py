"""What texts in a header say in words of its values: entries of any program, and prose."""

import re
from collections.abc import Iterable

from mvrecon.core.files.checks import MILLIMETRES
from mvrecon.core.files.keys import IMAGE_EFFECTS, has_effect, mentions

#: An entry in a comment, as Dectris writes it.
LINE = re.compile(r"^\s*# *(\w+)[ =:]+(.*?)\s*$", re.MULTILINE)
#: Entries of any text: a name, `=`, `:`, a tabulator or a blank before a number, and a word or a
#: list; and elements of XML.
ENTRY = re.compile(
    r"(?<!\w)([A-Za-z_][\w .()/-]{0,60}?)(?:[\"']?[ ]*[:=\t][ \t]*[\"']?|[ ]+(?=[-+]?\.?\d))"
    r"(?=(\[[^\]]{1,200}\]|\([^)]{1,200}\)|[^\s\"',;<>}\])]+))"
)
ELEMENT = re.compile(r"<([\w:.-]{1,60})(?:\s[^<>]{0,200})?>\s*([^<>\s][^<>]{0,200})</")
NAMED = re.compile(
    r"\b(?:name|key)\s*=\s*[\"']([^\"'<>]{1,60})[\"'][^<>]{0,200}?(?:value\s*=\s*[\"']|>\s*)"
    r"([^\"'<>]{1,200})"
)
PAIR = re.compile(r"<(?:name|key)>\s*([^<>]{1,60}?)\s*</\w+>\s*<[\w:.-]{1,60}>\s*([^<>]{1,200})</")
#: Characters of a line of prose that are named, and words by which it states what was done to grey
#: values.
PROSE_SHOWN = 80
PROSE = re.compile(
    r"(?<![<\w])(scaled|multiplied|divided|subtract(ed|ion)|correct(ed|ion)|normali[sz](ed|ation)|"
    r"flipped|mirrored|rotated|transposed|inverted|lineari[sz]ed|logarithms?|"
    r"log.transform(ed)?|optical densit(y|ies)|(ln|log(10|2|e)?) ?\()\b",
    re.IGNORECASE,
)
#: Names of scales of the display, of stages and lenses; and units of other things than values.
OF_DISPLAY = re.compile(
    r"spatial|^stage|zoom|magnif|auto.?scale|scale.?bar|display|look.?up|pixel.?(size|spacing)|"
    r"(?<![a-z])(date|time)(?=\W*$|.?(unit|scale))",
    re.IGNORECASE,
)
OTHER_UNITS = {
    *MILLIMETRES,
    *("count", "counts", "adu", "dn", "pixel", "pixels", "px", "inch", "in"),
    *("s", "sec", "ms", "us"),
    *("deg", "degrees", "rad"),
    *("v", "kv", "kev", "ev", "ma", "ua", "a", "w", "c", "k", "bit", "bits"),
}


def statements(text: str) -> list[str]:
    """Names of the entries of a text that may change values: lines of a name and a value, JSON,
    XML; and the starts of lines of prose with a word of `PROSE`.
    """
    lines = LINE.sub("", text).splitlines()
    parts = [(x, ENTRY.findall(x) if mentions(x, IMAGE_EFFECTS) else []) for x in lines]
    found = [pair for _, pairs in parts for pair in pairs]
    for pattern in (LINE, ELEMENT, NAMED, PAIR):
        found += pattern.findall(text)
    prose = {
        line.strip()[:PROSE_SHOWN]
        for line, pairs in parts
        if PROSE.search(line) and not any(mentions(name, IMAGE_EFFECTS) for name, _ in pairs)
    }
    return sorted(
        prose
        | {
            name.strip()
            for name, value in found
            if not OF_DISPLAY.search(name)
            and any(
                has_effect(name, part.rstrip("xX"), IMAGE_EFFECTS)
                and part.lower() not in OTHER_UNITS
                for part in re.findall(r"[^\s,;()\[\]]+", value)
            )
        }
    )


def said(texts: Iterable[tuple[str, str]]) -> list[str]:
    """The statements of texts, behind the names of the texts."""
    return [f"{name}: {entry}" for name, text in texts for entry in statements(text)]
