"""Texts in a header: entries of any program, and lines of prose."""

import re
from collections.abc import Iterable

from mvrecon.core.files.keys import IMAGE_EFFECTS, has_effect

#: An element of XML with a value, and what is no content: names, declarations and marks of others.
ELEMENT = re.compile(r"<([\w:.-]+[^<>]*)(?<!/)>\s*([^<>\s][^<>]*)</[^<>]*>")
MARKUP = re.compile(r"</[^<>]*>|<[\w:.-]+>|<\?[^<>]*>|<!(?:\w[^<>]*>|--|\[CDATA\[)|-->|\]\]>")
#: An object within one of JSON, lists of numbers and numbers below their name, and where a text
#: divides: lines, parts of lists, elements.
OBJECT = re.compile(r"\"\s*:\s*\{\s*\"")
BELOW = re.compile(r"([:=,[])\s*[\n\r]\s*(?=[-+.\d[])")
PART = re.compile(r"[\0-\x08\n-\x1f;<>{}]|,(?=\s*[\"'[])|,(?=\s*[^\W\d][\w .-]{0,60}[:=])")
#: An entry, a name and a value; and the name of another within its value, but no path or address.
ENTRY = re.compile(r"([^\W\d][^:=\t\"']*?)[\"']?\s*[:=\t]\s*(.*)")
INNER = re.compile(r"(?:[^\W\d][\"']?\s*:|\w[\"']?\s*=)(?![\\/])")
#: Characters of a part of a text that are shown.
SHOWN = 80
#: Words of prose, beside those of keys, on what was done to grey values or to angles.
WORDS = {
    **IMAGE_EFFECTS,
    r"divided|rotated|optical.?densit|(?<![a-z])(ln|log(10|2|e)?) ?\(": None,
    "(?<!counter)(?<!counter.)(?<!anti)(?<!anti.)clock.?wise": None,
}
WORD = re.compile("|".join(WORDS))


def statements(text: str) -> dict[str, tuple[str, str]]:
    """Return the parts of a text, each with its value: entries (lines of a name and a value,
    JSON, XML) by their names, with their values where these differ; and other lines with letters
    by themselves.
    """
    found: dict[str, tuple[str, str]] = {}
    text = MARKUP.sub("\n", ELEMENT.sub(r"\n\1 = \2\n", BELOW.sub(r"\1 ", text)))
    for part in PART.split(OBJECT.sub(".", re.sub(" +", " ", text))):
        plain = part.strip(" \t,[]#*\"'!?/")
        entry = ENTRY.fullmatch(plain)
        name, value = entry.groups() if entry else (plain, plain)
        if entry or re.search(r"[^\W\d_]|[^\0-\x7f]", name):
            value = re.sub(r"[\s,\"'()[\]]+", " ", value)
            once = found.get(name, (value,))[0] == value
            found[name if once else f"{name} = {value}"] = value, plain
    return found


def stated_effects(texts: Iterable[tuple[str, str]]) -> list[str]:
    """The parts of texts that may state what was done to values, behind the names of the texts:
    those with a word of `WORDS`, unless the value of an entry changes nothing.
    """
    return [
        f"{title}: {brief(name, *found)}"
        for title, text in texts
        for name, found in statements(text).items()
        if has_effect(name, found[0], WORDS) or _word_at(found[0]) >= 0
    ]


def brief(name: str, value: str, part: str) -> str:
    """The name of an entry, or the whole part if its value contains further entries or a word of
    `WORDS`, in one line, cut to the characters around its first such word.
    """
    shown = part if INNER.search(value) or _word_at(value) >= 0 else name
    shown = "".join(filter(str.isprintable, " ".join(shown.split())))
    first = max(0, min(_word_at(shown) - SHOWN // 2, len(shown) - SHOWN))
    cut = shown[first : first + SHOWN]
    return f"{'...' * (first > 0)}{cut}{'...' * (first + SHOWN < len(shown))}"


def _word_at(text: str) -> int:
    """Where the first word of `WORDS` is in a text; -1 without one."""
    found = WORD.search(text.lower())  # faster than regardless of case
    return found.start() if found else -1
