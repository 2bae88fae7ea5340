"""Keys of a header that its reader does not know are refused or named, never ignored in silence."""

import warnings

import pytest

from mvrecon.core.files.checks import Refused
from mvrecon.core.files.keys import Key, check_unknown

KEYS = (
    Key("Size, Data Offset", "applied"),
    Key("file1.Datatype", "compared"),
    Key("Note, ????|????, dim[*], its_*", "ignored"),
)


@pytest.mark.parametrize(
    "name", ["Size", "Note", "0028|1053", "dim[3]", "its_scale", "Slope", "DataShift"]
)
def test_keys_of_the_table_and_those_that_state_nothing_are_ignored(name):
    """Also patterns, a slope of 1, and a key without a value."""
    value = {"Slope": "1.0 1.0", "DataShift": " None "}.get(name, "2")
    with warnings.catch_warnings(action="error"):
        check_unknown("a", [(name, value)], KEYS)


@pytest.mark.parametrize(
    ("name", "hint"),
    [("slope", ""), ("0028-1053 scale", ""), ("my_units", ""), ("sizes2 factor", "")]
    + [(name, "did you mean Data Offset") for name in ("DATAOFFSET", "data_ofset", "Data Offset 2")]
    + [("file1.Datatypes", "did you mean file1.Datatype"), ("SIZE", "did you mean Size")],
)
def test_unknown_keys_that_may_change_what_is_read_are_refused_by_name(name, hint):
    """By a word of effect, or as a known key but for a typing error."""
    with pytest.raises(Refused, match=f"got {name} '2'.*{hint}"):
        check_unknown("a", [("Foo", "2"), (name, "2")], KEYS)


def test_one_warning_names_all_other_unknown_keys():
    """Once each, the first of many, and none that is not in the table for a character."""
    stated = [("Size", "2"), ("0028|105", "2"), ("Foo", "2"), ("Foo", "3")]
    stated += [(f"Bar{k}", "x") for k in range(9)]
    with pytest.warns(
        UserWarning, match=r"a: .*know: 0028\|105, Foo, Bar0, .* and 3 other"
    ) as found:
        check_unknown("a", stated, KEYS)
    assert len(found) == 1
