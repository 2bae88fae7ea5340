"""Names of labelled structures."""

from pathlib import Path

import pytest

from mvrecon.data.hdf5 import structures_of


def test_names_and_labels_are_read():
    text = "1=Brainstem, 10=PTV70,255=Left eye"
    assert structures_of(Path("a.h5"), text) == {"Brainstem": 1, "PTV70": 10, "Left eye": 255}


@pytest.mark.parametrize(
    "text", [None, "", "Brainstem", "0=Air", "256=Far", "1=A,1=B", "1=A,2=A", "1=A,", "1=A=B"]
)
def test_other_texts_are_refused_with_what_was_expected(text):
    with pytest.raises(ValueError, match="a.h5: expected .* such as '1=Brainstem,2=SpinalCord'"):
        structures_of(Path("a.h5"), text)
