"""The table of keys in docs/file_formats.md is that of the readers: scripts/docs/file_keys.py."""

import pytest

from mvrecon.core.files.checks import Refused
from mvrecon.core.files.keys import Key, check_keys
from scripts.docs import file_keys


def test_the_table_of_keys_is_that_of_the_readers(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["file_keys.py", "--check"])
    assert file_keys.main() == 0, capsys.readouterr().out


def test_no_format_lists_a_key_twice():
    for keys in file_keys.FORMATS.values():
        names = [name for key in keys for name in key.name.split(", ")]
        assert len({*names}) == len(names)


@pytest.mark.parametrize("value", [None, "", [], 1, 1.0, "1.0", "ONE "])
def test_a_missing_or_allowed_key_is_accepted(value):
    check_keys("a", [Key("slope", "refused", allowed=(1, "one"))], {"slope": value}.get)


@pytest.mark.parametrize("value", [0, 2, "2", "two", [3]])
def test_another_value_is_refused_with_the_name_of_the_key(value):
    keys = [Key("slope", "refused", "multiply by it", (1, "one")), Key("note", "ignored")]
    with pytest.raises(Refused, match=r"a: expected slope 1 or one, got .*: multiply by it"):
        check_keys("a", keys, {"slope": value, "note": value}.get)
