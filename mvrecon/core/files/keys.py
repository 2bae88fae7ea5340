"""The keys of a file format that can change values, units or geometry, as the table that its reader
consults and that `docs/file_formats.md` shows.
"""

import difflib
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mvrecon.core.files.checks import Refused, shown, text_of


class Key(NamedTuple):
    """A key of a format's header.

    Args:
        name: the key as the format spells it, or several, separated by ", "; in one that is
            ignored, "*" stands for any characters and "?" for one.
        use: "applied" to values or geometry; "compared" with what it repeats, and refused where it
            contradicts that; "refused" unless its value is one of `allowed`; or "ignored", for the
            reason in `note`.
        note: a few words for the table.
        allowed: values of a refused key that change nothing; a missing key is always accepted.
    """

    name: str
    use: Literal["applied", "compared", "refused", "ignored"]
    note: str = ""
    allowed: tuple[Any, ...] = ()

    @property
    def names(self) -> list[str]:
        """Each of its names."""
        return self.name.split(", ")


#: Words of unknown keys that change values, units or the order of values, and the value of such a
#: key, or the values, that change nothing.
EFFECTS = {
    "(?<!gr[ae]y)scal(e|ing)(?!_?(types?|bar))|slope|factor|(?<!\\ba)gain|multipl(?!ex)|exponent|"
    "conversion(?!.?(soft|script|prog))|coefficient": 1,
    "offset|intercept|bias|skip": 0,
    "fill|missing|valid(?!at)|nodata": math.nan,
    "mirror|flip|transpos": 0,
    "unit(?!y)|calibrat|quanti(?!t)|unsigned|endian|logarithm|"
    "(?<![a-z])order(?![a-z])|(byte|ax[ei]s|dim[a-z]{0,20}|index|storage).?order": None,
}
#: Words of fields and texts beside images, which also state how these were corrected or turned.
IMAGE_EFFECTS = {
    **EFFECTS,
    "flip|mirror|transpos|invert|revers(?!ion)|swap|polar_angle|tilt|"
    "(image|frame|detector|camera).?rotat": 0,
    "correct(ed|ion)|subtract|normali[sz]|distort|dark.?field|flat.?field|linear|"
    "(?<![a-z])log(?=.?(appl|conv|corr|data|imag|intens|scal|transf))|fft|"
    "background(?!.?colou?r)|black.?level|pedestal|bit.?shift": 0,
    "gamma(?!.?ray)": 1,
    "(?<!\\ba)gain": (1, 0),  # 0 dB
}
#: Note of a key of free text.
FREE_TEXT = "but for a warning of entries such as slope = 2"
#: Values of any key with such a word that change nothing.
OFF = ("no", "none", "off", "false", "unknown")
#: Unknown keys that a warning names, and characters of a name that are searched for words.
NAMED, SEARCHED = 8, 256
#: Values of an unknown key that state nothing.
NOTHING = ("", "none", "unknown", "{}", "{none}")
#: Similarity of letters, by `difflib`, from which an unknown key may be a misspelled known one.
SLIP = 0.9


def has_effect(name: str, value: Any, effects: Mapping[str, Any] = EFFECTS) -> bool:
    """Whether a key that a format's reader does not know may change what it reads: its name has a
    word of `effects`, and its value is not the one that changes nothing.
    """
    neutral = _neutral(name, effects)
    if not neutral:
        return False
    values = neutral[-1] if isinstance(neutral[-1], tuple) else (neutral[-1],)
    return _plain(value) not in (*map(_plain, values), *OFF)


def _neutral(name: str, effects: Mapping[str, Any]) -> list[Any]:
    start = name[:SEARCHED]
    return [none for words, none in effects.items() if re.search(words, start, re.IGNORECASE)]


def check_unknown(
    path: str | Path,
    stated: Iterable[tuple[str, str]],
    keys: Sequence[Key],
    effects: Mapping[str, Any] = EFFECTS,
    in_texts: Sequence[str] = (),
) -> None:
    """Check the keys of a header that are not in the table of its format: those that may change
    what is read are refused, and one warning names the others, unless their values state nothing
    or, as a slope of 1, change nothing.

    Args:
        path: path of the file.
        stated: keys of the header with their values.
        keys: table of the format.
        effects: words of unknown keys that change what is read; see `EFFECTS`.
        in_texts: effects that texts of the header state (`prose.stated_effects`), for the same
            warning.

    Raises:
        Refused: an unknown key with one of these words and a value that has an effect, or with the
            name of a known key but for a typing error; the message names it.
    """
    names_in_use = [name for key in keys if key.use != "ignored" for name in key.names]
    used = {letters: name for name in names_in_use if (letters := _letters(name))}
    pairs = [(name, value) for name, value in stated if value.strip().lower() not in NOTHING]
    names = {*unknown_names((name for name, _ in pairs), keys)}
    unknown = [(name, value) for name, value in pairs if name in names]
    for name, value in unknown:
        near = difflib.get_close_matches(_letters(name), used, n=1, cutoff=SLIP)
        if near or has_effect(name, value, effects):
            slip = f"; did you mean {used[near[0]]}? Else" if near else ";"
            raise Refused(
                f"{path}: expected keys whose effect is known, got {_brief(name)} {shown(value)}"
                f"{slip} apply it, and remove the key"
            )
    ordinary = [name for name, _ in unknown if not _neutral(name, effects)]
    warn_of_unknown(path, [*ordinary, *in_texts])


def unknown_names(names: Iterable[str], keys: Sequence[Key]) -> list[str]:
    """Return the names that are in no key of a format, each once."""
    patterns = (re.escape(name) for key in keys for name in key.names)
    known = re.compile("|".join(patterns).replace(r"\*", ".*").replace(r"\?", "."))
    return [name for name in dict.fromkeys(names) if not known.fullmatch(name)]


def unknown_entries(stated: Mapping[str, str], keys: Sequence[Key]) -> list[str]:
    """Names of the entries of a header that are in no key of a format regardless of case; not those
    whose value is zero, empty or a word such as "off", or, as a gain of 1, changes nothing.
    """
    known = [key._replace(name=key.name.lower()) for key in keys]
    nothing = (0, *OFF, *NOTHING)
    unknown = {*unknown_names((name.lower() for name in stated), known)}
    return [
        name
        for name in stated
        if name.lower() in unknown
        and _plain(stated[name]) not in nothing
        and (not _neutral(name, IMAGE_EFFECTS) or has_effect(name, stated[name], IMAGE_EFFECTS))
    ]


def warn_of_unknown(path: str | Path, names: Iterable[str]) -> None:
    """Warn, in one line, of keys that a format's reader does not know, and ignores.

    Args:
        path: path of the file, or of the folder of a set of files.
        names: names of the unknown keys, of which those with a word of `IMAGE_EFFECTS` come first;
            of none there is no warning.
    """
    unknown = sorted(dict.fromkeys(names), key=lambda name: not _neutral(name, IMAGE_EFFECTS))
    if unknown:
        more = f" and {len(unknown) - NAMED} others" if len(unknown) > NAMED else ""
        warnings.warn(
            f"{path}: ignores keys that mvrecon does not know: "
            f"{', '.join(map(_brief, unknown[:NAMED]))}{more}; if one changes values or geometry, "
            f"apply it to the file first",
            stacklevel=2,  # one place for every caller, so that Python shows it once
        )


def section_entries(path: str | Path) -> Iterator[tuple[str, str, str]]:
    """The entries of a text of sections, `[section]` and lines `name=value`: section with its
    brackets and name in lower case, and value; entries before the first section have "".
    """
    section = ""
    for line in map(str.strip, text_of(path, strict=False).splitlines()):
        name, found, value = line.partition("=")
        if line.startswith("["):
            section = name.lower()
        elif found:
            yield section, name.strip().lower(), value.strip()


def check_keys(path: str | Path, keys: Sequence[Key], value_of: Callable[[str], Any]) -> None:
    """Check the refused keys of a header.

    Args:
        path: path of the file, for the message.
        keys: keys of its format.
        value_of: value of a key by its name; None or empty if it is missing. Texts are compared
            regardless of case, and as numbers where they are numbers.

    Raises:
        Refused: a key whose value is not allowed; the message names it.
    """
    for key in keys:
        if key.use != "refused":
            continue
        value = value_of(key.name)
        if not _missing(value) and _plain(value) not in map(_plain, key.allowed):
            expected = " or ".join(map(str, key.allowed))
            raise Refused(
                f"{path}: expected {f'{key.name} {expected}' if expected else f'no {key.name}'}, "
                f"got {shown(value)}{f': {key.note}' if key.note else ''}"
            )


def _missing(value: Any) -> bool:
    return value is None or (hasattr(value, "__len__") and len(value) == 0)


def _brief(name: str) -> str:
    return name if len(name) < SEARCHED and name.isprintable() else shown(name)


def _letters(name: str) -> str:
    """The letters of a name, without those of its section (`file1.size`)."""
    return re.sub(r"[\W\d_]", "", name[:SEARCHED].lower().rpartition(".")[2])


def _plain(value: Any) -> Any:
    """The word that a text repeats, as 0 of "0 0 0", else the text, in lower case; a finite number
    where there is one.
    """
    words = str(value).lower().split()
    text = words[0] if len(set(words)) == 1 else " ".join(words)
    try:
        return float(text) if math.isfinite(float(text)) else text
    except ValueError:
        return text
