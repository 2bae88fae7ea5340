"""A scan is written whole, or nothing is."""

import pytest
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.writing import Exposure, write_projections


def test_a_scan_is_written_atomically(tmp_path):
    """An interrupted write of a scan leaves no file, and existing files are not overwritten."""

    def breaking():
        yield torch.ones(4, 5)
        yield torch.full((4, 5), torch.nan)

    with pytest.raises(Refused, match="expected finite line integrals, got 20 .* in view 1"):
        write_projections(tmp_path / "scan", breaking())
    for wrong in ([], [torch.ones(4, 5), torch.ones(5, 4)], [torch.ones(2, 4, 5)]):
        with pytest.raises(Refused):
            write_projections(tmp_path / "scan", wrong)
    assert not list(tmp_path.iterdir())
    write_projections(tmp_path / "scan", torch.ones(2, 4, 5))
    with pytest.raises(FileExistsError, match="expected a new or an empty folder"):
        write_projections(tmp_path / "scan", torch.ones(2, 4, 5))
    for wrong in ({"dark": 9, "flat": 9}, {"flat": 2**16}, {"photons": 0}):
        with pytest.raises(ValueError, match="Expected"):
            Exposure(**wrong)
