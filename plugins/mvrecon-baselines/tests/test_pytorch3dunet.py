"""Files of pytorch-3dunet: round trip, and layout as read by plain h5py."""

import h5py
import numpy as np
import pytest

from mvrecon.core.files.checks import Refused
from mvrecon_baselines.pytorch3dunet import Example, read_example, write_example

RAW = np.random.default_rng(0).random((5, 6, 7)).astype("f4")


@pytest.mark.parametrize("channels", [None, 2])
def test_values_and_labels_round_trip_with_their_dtype(channels, tmp_path):
    raw = RAW if channels is None else np.stack([RAW] * channels)
    label = (RAW > 0.5).astype("u2")
    write_example(tmp_path / "a.h5", Example(raw, label))
    back = read_example(tmp_path / "a.h5")
    for got, expected in zip(back, (raw, label), strict=True):
        assert got.dtype == expected.dtype and np.array_equal(got, expected)
    with h5py.File(tmp_path / "a.h5") as file:  # as pytorch-3dunet's own reader asks for them
        assert np.array_equal(file["raw"][...], raw) and np.array_equal(file["label"][...], label)


def test_a_prediction_file_has_no_label(tmp_path):
    write_example(tmp_path / "a.h5", Example(RAW))
    assert read_example(tmp_path / "a.h5").label is None


def test_invalid_files_are_refused(tmp_path):
    """A file of pytorch-3dunet with other axes, sizes or types is refused, and none is written."""
    path = tmp_path / "a.h5"
    for wrong in (
        Example(RAW[0]),
        Example(RAW, RAW[:, :3]),
        Example(RAW, RAW[None, None]),
        Example(RAW > 0.5),
    ):
        with pytest.raises(Refused, match=r"a\.h5: "):
            write_example(path, wrong)
    assert not path.exists()
    with pytest.raises(FileNotFoundError, match="expected a file of pytorch-3dunet"):
        read_example(path)
    with h5py.File(path, "w") as file:
        file["volumes"] = RAW
    with pytest.raises(Refused, match=r"no dataset 'raw', only \['volumes'\]"):
        read_example(path)
    write_example(path, Example(RAW))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(Refused, match=r"a\.h5: cannot be opened .*is it cut short"):
        read_example(path)


@pytest.mark.parametrize("place", ["/", "raw"])
def test_a_factor_of_the_values_is_refused_by_name(place, tmp_path):
    path = tmp_path / "a.h5"
    write_example(path, Example(RAW))
    with h5py.File(path, "r+") as file:
        file[place].attrs["scale_factor"] = 2.0
    with pytest.raises(Refused, match="scale_factor"):
        read_example(path)
