"""What every reader of texts has in common."""

import pytest

from mvrecon.core.files.checks import json_of, yaml_of
from mvrecon.core.files.keys import section_entries
from mvrecon.geometry.cameras.formats.common import angles_in, number_lines

READERS = {
    "numbers": ("0\n1.5\n3\n", angles_in, [0, 1.5, 3]),
    "a column by its pattern": ("angle,t\n0,1\n2,1\n", angles_in, [0, 2]),
    "a column by its name": ("theta,angle\n0,1\n2,3\n", angles_in, [0, 2]),
    "lines": ("1 2\n3 4\n", number_lines, [[1, 2], [3, 4]]),
    "JSON": ('{"a": 1}', json_of, {"a": 1}),
    "YAML": ("a: 1", yaml_of, {"a": 1}),
    "sections": ("[A]\nb=1\n", lambda path: [*section_entries(path)], [("[a]", "b", "1")]),
}


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_the_mark_of_utf_8_is_no_part_of_a_text(kind, mark, tmp_path):
    """As spreadsheets and editors of Windows write it: before numbers it is no name of a column."""
    text, read, expected = READERS[kind]
    path = tmp_path / "a.txt"
    path.write_bytes(mark + text.encode())
    place = f"{path}:theta" if "name" in kind else path
    assert read(place) == expected
