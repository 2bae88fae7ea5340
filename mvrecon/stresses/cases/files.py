"""Files that are cut short, damaged, or not what they say; loaders in other processes; boards and tables."""

import hashlib
import json
import logging
from collections.abc import Iterator
from importlib.util import find_spec
from multiprocessing import get_all_start_methods
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from mvrecon.benchmarks.operators import Operators
from mvrecon.cameras.rigs import circular
from mvrecon.data.dataset import SceneDataset
from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from mvrecon.data.nifti import read_nifti
from mvrecon.data.volumes import Hdf5Volumes
from mvrecon.engine import storage
from mvrecon.engine.checkpoints import load
from mvrecon.engine.loggers import Board
from mvrecon.geometry.grid import Grid
from mvrecon.limits import Refused
from mvrecon.projectors.drr import Drr
from mvrecon.stresses.apart import python
from mvrecon.stresses.case import DoesNotApply, once
from mvrecon.stresses.refusals import none_of, refusal
from mvrecon.stresses.samples import RIG, checkpoint
from mvrecon.stresses.subject import Subject
from mvrecon.testing.damage import DECLARED, HEADERS, LINKS, instead, linked, nifti
from mvrecon.testing.hostile import saved
from mvrecon.testing.plugins import plugin
from mvrecon.viz import montage

SHAPE, MM = (6, 12, 10), (2.0, 2.0, 2.0)


def volumes(count: int) -> Iterator[Stored]:
    """A slab of water that moves, in air, and last nothing but noise, which does not shrink when it is packed."""
    x = np.linspace(-1, 1, SHAPE[2])
    for k in range(count - 1):
        rod = np.where(abs(x - 0.1 * k) < 0.6, 0, -1000).astype("i2")
        yield Stored(f"pt_{k}", np.tile(rod, (*SHAPE[:2], 1)), MM)
    noise = np.random.default_rng(0).integers(-(2**15), 2**15, SHAPE)
    yield Stored("noise", noise.astype("i2"), MM)


def damaged_volumes(subject: Subject) -> float:
    """A volume file that is cut short, emptied, none at all, or has a bit flipped where its numbers are."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.h5"
        write_volumes(path, volumes(3))
        whole, wrong = path.read_bytes(), {}
        cuts = {"10 %": len(whole) // 10, "50 %": len(whole) // 2, "all but a byte": len(whole) - 1, "nothing": 0}
        texts = {name: whole[:size] for name, size in cuts.items()} | {"zeros": bytes(4096), "text": b"hello"}
        for name, raw in texts.items():
            path.write_bytes(raw)
            wrong[name] = refusal(lambda: VolumeFile(path).read(0), r"a\.h5: (not an HDF5 file|cannot be opened)")
        path.write_bytes(whole)
        with h5py.File(path) as file:
            dataset: Any = file["ct"]
            chunks = [dataset.id.get_chunk_info(k) for k in range(3)]
        rng, expected = Random(0), [VolumeFile(path).read(k).ct for k in range(3)]
        for k in (1, 2):
            for _ in range(12):
                raw, place = bytearray(whole), chunks[k].byte_offset + rng.randrange(chunks[k].size)
                raw[place] ^= 1 << rng.randrange(8)
                path.write_bytes(raw)
                wrong[f"volume {k}, byte {place}"] = _silent(path, k, expected[k])
    return none_of(wrong)


def _silent(path: Path, k: int, expected: np.ndarray) -> str:
    """Empty where a volume is refused, or read as it was written."""
    try:
        found = VolumeFile(path).read(k).ct
    except Refused as error:
        return "" if f"a.h5: volume {k} cannot be read" in str(error) else str(error)
    return "" if np.array_equal(found, expected) else "read otherwise than it was written, without an error"


def strange_volumes(subject: Subject) -> float:
    """A volume file of another layout, one that declares more than it holds, and one that leads elsewhere."""
    changes = dict(DECLARED) | {f"a way out, {kind}": (linked(kind), "link, a group or stored") for kind in LINKS}
    changes |= {
        "no dataset": (lambda file: file.pop("ct"), "has no dataset 'ct'"),
        "three axes": (instead("ct", data=np.zeros((2, 4, 4), "i2")), r"'ct': \(2, 4, 4\)"),
        "text": (instead("ct", data=np.full((2, 1, 1, 1), b"a", "S3")), "expected numbers"),
        "a number": (instead("ct", data=1.0), r"'ct': \(\)"),
        "NaN spacing": (instead("spacing", data=np.full((2, 3), np.nan)), "expected positive mm"),
        "cm": (lambda file: file.attrs.update(units="cm"), "units"),
        "all sizes wrong": (instead("id", data=[b"a"]), r"'ct': \(2, .*'spacing': \(2, 3\), 'id': \(1,\)"),
    }
    wrong = {}
    with TemporaryDirectory() as folder:
        for name, (change, saying) in changes.items():
            path = Path(folder) / "a.h5"
            write_volumes(path, volumes(2))
            with h5py.File(path, "r+") as file:
                change(file)
            wrong[name] = refusal(lambda path=path: VolumeFile(path).read(0), rf"a\.h5: .*{saying}")
    return none_of(wrong)


def strange_nifti(subject: Subject) -> float:
    """NIfTI headers that declare what is not there, or an affine that is no grid."""
    if not find_spec("nibabel"):
        raise DoesNotApply("NIfTI needs nibabel: pip install 'mvrecon[io]'")
    wrong = {}
    with TemporaryDirectory() as folder:
        for suffix in (".nii", ".nii.gz"):
            for name, (header, saying) in HEADERS.items():
                path = nifti(Path(folder) / f"a{suffix}", bytes(128), **header)
                wrong[f"{name}, {suffix}"] = refusal(lambda path=path: read_nifti(path), rf"a\.nii.*{saying}")
        path = nifti(Path(folder) / "bomb.nii.gz", bytes(2**24), dim=[3, 1024, 1024, 1024, 1, 1, 1, 1], vox_offset=352)
        wrong["a bomb"] = refusal(lambda: read_nifti(path), "bomb.*declares")
    return none_of(wrong)


def fuzzed(subject: Subject) -> float:
    """Damaged copies of a file of every kind: read or refused by name, within 256 MiB, no crash, and none hangs."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "found.json"
        done = python("-m", "mvrecon.stresses.fuzzing", "0", "30", str(out))
        found = json.loads(out.read_text()) if out.exists() else {}
    wrong = {"the process": "" if done.returncode == 0 else f"ended with {done.returncode}: {done.stderr[-200:]}"}
    for reader, result in found.items():
        wrong[reader] = "; ".join(result["failures"][:3])
        if not wrong[reader] and result["peak"] > 2**28:
            wrong[reader] = f"took {result['peak'] / 2**20:.0f} MiB"
    return none_of(wrong)


def damaged_checkpoints(subject: Subject) -> float:
    """Checkpoints with a flipped bit, or cut short, lead to the one before; those of another method nowhere."""
    kept, rng, wrong = checkpoint(), Random(0), {}
    with TemporaryDirectory() as folder:
        last = Path(folder) / "a.ckpt"
        for step in (3, 6):
            storage.write(last, {**kept, "global_step": step})
        whole = last.read_bytes()
        spoils = {f"cut to {n}": whole[:n] for n in (0, len(whole) // 10, len(whole) // 2, len(whole) - 1)}
        for place in (0, 21, len(whole) - 1, *rng.sample(range(len(whole)), 20)):
            flipped = bytearray(whole)
            flipped[place] ^= 1 << rng.randrange(8)
            spoils[f"byte {place}"] = bytes(flipped)
        for name, raw in spoils.items():
            last.write_bytes(raw)
            step = storage.read_newest(last)["global_step"]
            wrong[name] = "" if step == 3 else f"step {step} is read, expected 3, of the one before"
        storage.previous(last).write_bytes(whole[:-1])
        wrong["both"] = refusal(lambda: storage.read_newest(last), r"a\.previous\.ckpt is (damaged|cut)", Refused)
        first = next(iter(kept["state_dict"]))
        fewer = {name: value for name, value in kept["state_dict"].items() if name != first}
        forms = {
            "another size": {**kept, "state_dict": {**kept["state_dict"], first: torch.zeros(3, 3)}},
            "a weight too few": {**kept, "state_dict": fewer},
            "a weight too many": {**kept, "state_dict": {**kept["state_dict"], "spare.weight": torch.zeros(3)}},
            "no settings": {name: value for name, value in kept.items() if name != "hyper_parameters"},
            "an option of the future": {
                **kept,
                "hyper_parameters": {**kept["hyper_parameters"], "model": {"name": "sirt", "warp": 9}},
            },
        }
        for name, form in forms.items():
            last.write_bytes(saved(form))
            named = {"a weight too many": "spare.weight", "no settings": "hyper_par", "an option of the future": "warp"}
            wrong[name] = refusal(lambda: load(last), rf"a\.ckpt: .*{named.get(name, first)}", Refused)
    return none_of(wrong)


def loaders(subject: Subject) -> float:
    """Batches of a volume file that is open here, from none, forked and spawned workers: how many differ in any bit."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.h5"
        write_volumes(path, volumes(4))
        scene: Any = Hdf5Volumes(path=str(path), crop="none")
        cases = SceneDataset(scene, Grid.centred((4, 4, 4), 6.0), _rig(), range(3), 0, cache=False)
        expected = _hashes(cases, workers=0)
        differing = 0
        for start in {"fork", "spawn"} & set(get_all_start_methods()):
            found = _hashes(cases, workers=2 if start == "fork" else 1, start=start)  # a spawned one imports all anew
            differing += sum(a != b for a, b in zip(found, expected, strict=True))
    return float(differing)


def _rig() -> Any:
    return circular(**{name: value for name, value in RIG.items() if name != "name"})


def _hashes(cases: SceneDataset, workers: int, start: str | None = None) -> list[str]:
    loader = DataLoader(
        cases, 2, num_workers=workers, multiprocessing_context=start, persistent_workers=start == "fork"
    )
    batches = [batch for _ in range(1 + (start != "spawn")) for batch in loader]
    batches = batches * 2 if start == "spawn" else batches
    return [hashlib.sha256(_bytes(batch)).hexdigest() for batch in batches]


def _bytes(batch: dict[str, Any]) -> bytes:
    tensors = [value.numpy().tobytes() for value in batch.values() if isinstance(value, Tensor)]
    return b"".join([*tensors, " ".join(batch["name"]).encode()])


def boards(subject: Subject) -> float:
    """Numbers and pictures that are no good ones on the board, and what a resumed run logs again."""
    with TemporaryDirectory() as folder:
        board = Board(folder)
        for step in range(6):
            board.experiment.add_scalar("loss", torch.nan if step == 1 else float(step), step)
        for name, image in _pictures().items():
            board.experiment.add_image(name, image, 0, dataformats="HWC")
        board.experiment.add_histogram("none", torch.zeros(1), 0)
        board.finalize("failed")
        again = Board(folder)
        again.rewind(3)
        for step in (3, 4):
            again.experiment.add_scalar("loss", 10.0 + step, step)
        again.finalize("success")
        found = _logged(Path(folder))
    expected = [(0, 0.0), (2, 2.0), (3, 13.0), (4, 14.0)]
    wrong = {"scalars": "" if found == expected else f"the board tells {found}, expected {expected}"}
    return none_of(wrong)


def _pictures() -> dict[str, np.ndarray]:
    """Of one voxel, of many, of NaN, of negative values, of nothing."""
    one, many = torch.rand(1, 1, 1), torch.rand(2, 3, 1500)
    spoiled = torch.rand(4, 4, 4)
    spoiled[1] = torch.nan
    truths = {"one": one, "many": many, "NaN": spoiled, "negative": -torch.rand(4, 4, 4), "zero": torch.zeros(4, 4, 4)}
    found = {f"planes/{name}": montage.planes(x, {"x": x}, 1.0) for name, x in truths.items()}
    found |= {f"mip/{name}": montage.projections(x, {"x": x}, 1.0) for name, x in truths.items()}
    return found | {f"views/{name}": montage.views(x.nan_to_num(), x) for name, x in truths.items()}


def _logged(folder: Path) -> list[tuple[int, float]]:
    """The finite numbers that TensorBoard shows of a loss."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logging.disable(logging.WARNING)  # it says that a run was resumed
    try:
        events = EventAccumulator(str(folder)).Reload().Scalars("loss")
    finally:
        logging.disable(logging.NOTSET)
    return [(event.step, event.value) for event in events if np.isfinite(event.value)]


class Scaled(Drr):
    """A projector that is fast, and wrong by five percent."""

    def forward(self, volume: Tensor) -> Tensor:
        return 1.05 * super().forward(volume)


def honest_benchmarks(subject: Subject) -> float:
    """A row of the benchmark has the error of that very operator beside its time: of one that is wrong by 5 % too."""
    base = {"n": 8, "views": 2, "device": "cpu", "threads": 1, "scene": "box"}
    plan: dict[str, Any] = {"sizes": {"about": {}, "vary": {"n": [8]}}}
    parts = [{"name": "drr", "method": "siddon"}, {"name": "scaled", "method": "siddon"}]
    with TemporaryDirectory() as folder, plugin(Path(folder), {"projector.scaled": f"{__name__}:Scaled"}):
        bench = Operators(parts, base, plan, rays=2, repeats=1)
        rows = [row for jobs in bench.groups() for row in bench.measure(jobs, [], lambda text: None)]
    sound, scaled = rows
    wrong = {
        "a time without an error": "" if all({"error_thin", "forward_ms"} <= set(row) for row in rows) else f"{rows}",
        "the fault": "" if abs(scaled["error_thin"] - sound["error_thin"]) > 0.01 else f"{rows} do not show it",
    }
    return none_of(wrong)


CASES = (
    once(62, "volume files that are damaged", "refused by name, no bit read otherwise", damaged_volumes),
    once(63, "volume files that are something else", "refused by name", strange_volumes),
    once(63, "NIfTI that declares what is not there", "refused by name", strange_nifti),
    once(64, "forked and spawned workers", "the same batches to the last bit", loaders),
    once(66, "damaged files of every kind", "read, or refused by name; none hangs", fuzzed),
    once(70, "checkpoints that are damaged", "the one before is read, or refused by name", damaged_checkpoints),
    once(73, "a board of bad numbers and pictures", "shown; logged again, once", boards),
    once(80, "the benchmark of a wrong operator", "its error beside its time", honest_benchmarks),
)
