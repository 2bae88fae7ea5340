"""A checkpoint is a list of numbers: loading it never executes code."""

import io
import struct
import zipfile
from pathlib import Path

import pytest
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.training.checkpoints import check_archive, finished, read_newest, unfinished
from mvrecon.training.trained import load_checkpoint
from tests.faults.hostile import SETTINGS, Payload, pickle_of, pickles, saved, with_pickle
from tests.faults.samples import checkpoint


@pytest.fixture
def sentinel(tmp_path: Path) -> Path:
    """A file that only a hostile sample makes."""
    return tmp_path / "sentinel"


@pytest.fixture(scope="module")
def kept() -> dict:
    """A valid checkpoint."""
    return checkpoint()


def written(path: Path, raw: bytes) -> Path:
    path.write_bytes(raw)
    return path


def repacked(archive: bytes, **changes: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(archive)) as old:
        return {**{name: old.read(name) for name in old.namelist()}, **changes}


def zipped(members: dict[str, bytes], packing: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", packing) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return buffer.getvalue()


def test_a_valid_checkpoint_loads(kept: dict, tmp_path: Path):
    found = load_checkpoint(written(tmp_path / "a.ckpt", saved(kept)))
    assert found.steps == 3 and found.seconds == 1.5
    weights = found.module.state_dict()
    assert all(torch.equal(weights[name], value) for name, value in kept["state_dict"].items())


@pytest.mark.parametrize("name", sorted(pickles(Path("sentinel"))))
def test_a_pickle_builds_tensors_and_plain_values_only(
    name: str, kept: dict, sentinel: Path, tmp_path: Path
):
    """A checkpoint whose pickle names anything but tensors and plain values is refused, and none of
    it runs.
    """
    evil = pickles(sentinel)[name]
    for raw in (with_pickle(saved(kept), evil), evil):
        with pytest.raises(
            Refused, match=r"evil\.ckpt: (its pickle names|is cut short or no checkpoint)"
        ):
            load_checkpoint(written(tmp_path / "evil.ckpt", raw))
    assert not sentinel.exists()


def test_a_library_that_extends_torchs_allow_list_does_not_extend_ours(
    kept: dict, sentinel: Path, tmp_path: Path
):
    path = written(tmp_path / "evil.ckpt", saved({**kept, "x": Payload(f"touch {sentinel}")}))
    with (
        torch.serialization.safe_globals([__import__("os").system]),
        pytest.raises(Refused, match="its pickle names .*system"),
    ):
        load_checkpoint(path)
    assert not sentinel.exists()


def test_the_malicious_sample_works_if_unpickled(sentinel: Path, tmp_path: Path):
    path = written(tmp_path / "evil.ckpt", saved({"x": Payload(f"touch {sentinel}")}))
    torch.load(path, weights_only=False)
    assert sentinel.exists()


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_in_a_checkpoint_are_names_and_numbers(name: str, kept: dict, tmp_path: Path):
    """Settings in a checkpoint that are no names and numbers are refused."""
    evil = {**kept, "hyper_parameters": {**kept["hyper_parameters"], **SETTINGS[name]}}
    with pytest.raises(Refused, match=r"evil\.ckpt: has the settings .*expected names and numbers"):
        load_checkpoint(written(tmp_path / "evil.ckpt", saved(evil)))


def test_unregistered_parts_are_not_imported(kept: dict, tmp_path: Path):
    evil = {
        **kept,
        "hyper_parameters": {**kept["hyper_parameters"], "method": {"name": "os.system"}},
    }
    with pytest.raises(Refused, match="No method is named 'os.system'"):
        load_checkpoint(written(tmp_path / "evil.ckpt", saved(evil)))


def test_a_loss_term_is_needed_only_if_it_had_a_weight(kept: dict, tmp_path: Path):
    """A method trained without a plugin's term loads where that plugin is not installed."""
    for weight, error in ((0.0, None), (0.5, "No loss is named 'elsewhere'")):
        parameters = {**kept["hyper_parameters"], "loss": {"volume": 1.0, "elsewhere": weight}}
        file = written(tmp_path / "a.ckpt", saved({**kept, "hyper_parameters": parameters}))
        if error is None:
            assert load_checkpoint(file).module.hparams["loss"] == {"volume": 1.0}
        else:
            with pytest.raises(Refused, match=error):
                load_checkpoint(file)


def test_archives_cannot_expand_without_limit(kept: dict, tmp_path: Path):
    """A checkpoint with packed members is refused before they unfold."""
    members = repacked(saved(kept), **{"archive/data/0": bytes(2**26)})
    raw = zipped(members, zipfile.ZIP_DEFLATED)
    with pytest.raises(Refused, match="packed or overlap"):
        load_checkpoint(written(tmp_path / "bomb.ckpt", raw))


def test_members_that_share_their_bytes_are_refused(kept: dict, tmp_path: Path):
    """A checkpoint whose members share their bytes is refused."""
    raw = saved({**kept, "x": torch.zeros(2**16)})
    start, entries = raw.index(b"PK\x01\x02"), []
    while raw[start : start + 4] == b"PK\x01\x02":
        name, extra, comment = struct.unpack("<3H", raw[start + 28 : start + 34])
        entries.append(raw[start : start + 46 + name + extra + comment])
        start += len(entries[-1])
    large = max(entries, key=lambda entry: struct.unpack("<I", entry[24:28]))
    overlapping = raw[: raw.index(b"PK\x01\x02")] + b"".join([*entries, *[large] * 60])
    end = struct.pack(
        "<4s4H2IH",
        b"PK\x05\x06",
        0,
        0,
        len(entries) + 60,
        len(entries) + 60,
        # fmt: skip
        len(overlapping) - raw.index(b"PK\x01\x02"),
        raw.index(b"PK\x01\x02"),
        0,
    )
    with pytest.raises(Refused, match="packed or overlap"):
        check_archive(written(tmp_path / "bomb.ckpt", overlapping + end))


@pytest.mark.parametrize(
    "name", ["../evil", "/etc/evil", "archive/../../evil", "archive/code/evil.py", "evil"]
)
def test_archive_members_cannot_refer_to_other_files(name: str, kept: dict, tmp_path: Path):
    """A checkpoint with a member that no checkpoint has, or that leads out of it, is refused."""
    raw = zipped(repacked(saved(kept), **{name: b"x"}))
    with pytest.raises(Refused, match="which no checkpoint does"):
        load_checkpoint(written(tmp_path / "evil.ckpt", raw))


@pytest.mark.parametrize("method", ["../../evil", "/etc/evil", "..", "a/b"])
def test_a_methods_name_is_never_used_as_a_path(method: str, tmp_path: Path):
    """A method's name never leads out of the run folder."""
    for place in (finished, unfinished):
        with pytest.raises(Refused, match="has the name"):
            place(tmp_path, method)


def test_a_storage_is_no_longer_than_its_file(kept: dict, tmp_path: Path):
    """A checkpoint that declares more numbers than its file holds is refused."""
    archive = saved({**kept, "x": torch.zeros(300)})
    longer = pickle_of(archive).replace(b"M\x2c\x01", b"J" + struct.pack("<i", 2**30))
    with pytest.raises(ValueError, match=r"evil\.ckpt"):
        load_checkpoint(written(tmp_path / "evil.ckpt", with_pickle(archive, longer)))


def test_weights_of_another_method_are_reported(kept: dict, tmp_path: Path):
    """Weights that do not fit the settings beside them are refused, with their names."""
    first = next(iter(kept["state_dict"]))
    weights = {**kept["state_dict"], first: torch.zeros(3, 3)}
    with pytest.raises(Refused, match=rf"a\.ckpt: does not fit (.|\n)*{first}"):
        load_checkpoint(written(tmp_path / "a.ckpt", saved({**kept, "state_dict": weights})))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_weights_that_are_not_finite_are_refused(value: float, kept: dict, tmp_path: Path):
    """A checkpoint with a weight that is not a finite number is refused, to be evaluated and to be
    gone on from.
    """
    name = next(
        name
        for name, weight in kept["state_dict"].items()
        if weight.is_floating_point() and weight.numel()
    )
    weight = kept["state_dict"][name].clone()
    weight.view(-1)[-1] = value
    for key in ("state_dict", "current_model_state"):
        path = written(
            tmp_path / f"{key}.ckpt", saved({**kept, key: {**kept["state_dict"], name: weight}})
        )
        for reader in (load_checkpoint, read_newest):
            with pytest.raises(
                Refused, match=rf"{key}\.ckpt: 1 weights are not finite, 'method.* among them"
            ):
                reader(path)


def without(mapping: dict, name: str) -> dict:
    return {key: value for key, value in mapping.items() if key != name}


FUTURE = {"method": {"name": "sirt", "warp": 9}}
#: What is done to a checkpoint whose first weight has this name, and what the refusal names.
AMISS = {
    "a weight too few": (
        lambda kept, first: {**kept, "state_dict": without(kept["state_dict"], first)},
        None,
    ),
    "a weight too many": (
        lambda kept, first: {
            **kept,
            "state_dict": {**kept["state_dict"], "spare.weight": torch.zeros(3)},
        },
        "spare.weight",
    ),
    "no settings": (lambda kept, first: without(kept, "hyper_parameters"), "hyper_par"),
    "an option of the future": (
        lambda kept, first: {**kept, "hyper_parameters": {**kept["hyper_parameters"], **FUTURE}},
        "warp",
    ),
}


@pytest.mark.parametrize("name", AMISS)
def test_a_checkpoint_of_another_method_or_version_is_refused_with_the_reason(
    name: str, kept: dict, tmp_path: Path
):
    """A checkpoint that lacks weights or settings, or has those of another version, is refused with
    their names.
    """
    change, named = AMISS[name]
    first = next(iter(kept["state_dict"]))
    with pytest.raises(Refused, match=rf"(?s)a\.ckpt: .*{named or first}"):
        load_checkpoint(written(tmp_path / "a.ckpt", saved(change(kept, first))))


def test_weights_are_loaded_as_saved_or_not_at_all(kept: dict, tmp_path: Path):
    """A checkpoint without mvrecon's own checksum, with a bit flipped in a weight is refused."""
    raw = bytearray(saved(kept))
    weight = next(value for value in kept["state_dict"].values() if value.numel() > 8)
    raw[raw.index(weight.numpy().tobytes()) + 1] ^= 1
    with pytest.raises(
        Refused, match=r"a\.ckpt: its '.*/data/\d+' is damaged: the checksum does not fit"
    ):
        load_checkpoint(written(tmp_path / "a.ckpt", bytes(raw)))
