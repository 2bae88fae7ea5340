"""Events on disk: contents follow the physics; workers, kills and damage do not change a byte."""

import multiprocessing
import resource
import shutil
import struct
from collections import namedtuple
from copy import deepcopy
from hashlib import sha256
from pathlib import Path
from weakref import ref

import h5py
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from mvrecon.core.files.checks import Refused
from mvrecon.data.scenes.phantoms import RandomDerenzo
from mvrecon.geometry.grid import Grid
from mvrecon_spect.events.making import SUMS, EventMaker, Sinograms, write_events
from mvrecon_spect.events.shards import Events, Header, fill, header_of, write_shard, write_view

DETECTOR = {"pixels": [10, 9], "pixel_mm": 12.0}
SETTINGS = {
    "seed": 3,
    "grid": {"size": [10, 12, 8], "spacing": 6.0, "centre": [5, -4, 3]},
    "scene": {"name": "derenzo", "field": 0.5},
    "camera": {
        "name": "circular", "n_views": 3, "sid": 200.0, "sdd": 300.0, "detector": DETECTOR,
    },
    "projector": {"name": "drr"},
    "acquisition": {"counts": 2e4, "closed_form": False},
    "events": {"count": 5, "first": 7, "shard": 2, "angles": 8, "backprojection": True},
}  # fmt: skip
ALL = ("truth", "ideal", "counts", "radon", "dose", "pose", "backprojection")


def settings(**events):
    return {**SETTINGS, "events": {**SETTINGS["events"], **events}}


def write(folder, **events):
    return write_events(folder, EventMaker.of(settings(**events)), settings(**events))


def digests(folder):
    return {p.name: sha256(p.read_bytes()).hexdigest() for p in folder.glob("events-*.h5")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "events"
    write(folder, workers=0)
    return folder


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "events")


def test_counts_follow_the_ideal_views_and_the_truth_its_pose(folder):
    events = Events(folder, ALL)
    squares = []
    assert len(events) == 5 and [events[k]["index"] for k in range(5)] == [7, 8, 9, 10, 11]
    for event in (events[k] for k in range(5)):
        expected, number = event["ideal"] * event["dose"], event["counts"]
        assert expected.sum().item() == pytest.approx(2e4, rel=1e-5)
        assert torch.equal(number, number.round()) and number.min() >= 0
        assert abs(number.sum().item() - 2e4) < 5 * 2e4**0.5
        bright = expected > 5
        squares.append((number[bright] - expected[bright]) ** 2 / expected[bright])
        pose = dict(zip(events.columns, event["pose"].tolist(), strict=True))
        place = events.grid.to_index(torch.tensor([[pose[f"{axis}_mm"] for axis in "xyz"]]))
        weights = event["truth"][0].double()
        axes = [torch.arange(n, dtype=torch.float64) for n in weights.shape]
        z, y, x = torch.meshgrid(*axes, indexing="ij")
        middle = [(weights * axis).sum() / weights.sum() for axis in (x, y, z)]
        assert torch.allclose(torch.stack(middle), place[0].double(), atol=0.5)
        inside = event["backprojection"][event["truth"] > 0].mean()
        assert inside > event["backprojection"][event["truth"] == 0].mean()
    chi = torch.cat(squares)
    assert chi.mean().item() == pytest.approx(1, abs=5 * (2 / len(chi)) ** 0.5)


def test_every_view_of_a_sinogram_has_the_mass_of_its_slice(folder):
    event = Events(folder, ("truth", "radon"))[0]
    mass = event["truth"][0].sum(dim=(1, 2)) * 6.0
    assert event["radon"].shape == (1, 8, 8, 16)
    sums = event["radon"][0].sum(dim=-1)
    assert torch.allclose(sums, mass.expand(8, 8), rtol=5e-3, atol=1e-2)


def test_a_sinogram_is_the_radon_transform_at_theta_with_s_along_it():
    """A voxel at (x, y) is seen at s = x cos theta + y sin theta."""
    grid = Grid.centred(size=(12, 12, 3), spacing=5.0, centre=(10, 20, 30))
    volume = torch.zeros(1, *grid.refined(2).shape)
    volume[0, 2:4, 16:18, 6:8] = 1  # slice 1, y = +12.5, x = -12.5 mm from the centre
    whole = Sinograms(grid, 2, 12, bins=31)(volume)
    theta = torch.arange(12) * 2 * torch.pi / 12
    s = (torch.arange(31) - 15) * 5.0
    assert not whole[:, 0].any() and not whole[:, 2].any()
    seen = (whole[:, 1] * s).sum(dim=1) / whole[:, 1].sum(dim=1)
    assert torch.allclose(seen, -12.5 * theta.cos() + 12.5 * theta.sin(), atol=1.0)
    odd = Sinograms(grid, 2, 3, bins=31)(volume)  # not mirrored
    assert torch.equal(odd, whole[::4])


@pytest.mark.parametrize("fine", [1, 2, 3])
@pytest.mark.parametrize("spacing", [(4.0, 4.0, 4.0), (4.0, 5.0, 4.0)])
def test_a_sinogram_keeps_the_mass_of_each_slice_at_every_angle(fine: int, spacing: tuple):
    """Of thin rods with sharp edges, whatever the fine voxels; a single ray a bin is up to 30 %
    off.
    """
    grid = Grid.centred(size=(32, 32, 32), spacing=spacing)
    scene = RandomDerenzo(radius_mm=40, height_mm=70, fill=None)
    volume = scene.finer(0, 0, grid, None, fine)
    x, y, _ = spacing
    mass = volume[0].unflatten(0, (-1, fine)).double().mean(dim=1).sum(dim=(1, 2)) * x * y / fine**2
    sums = Sinograms(grid, fine, 24)(volume).double().sum(dim=-1) * min(x, y)
    full = mass > 0.01 * mass.max()
    assert full.sum() > 10
    assert (sums[:, full] / mass[full] - 1).abs().max() < 5e-3


def test_events_are_the_same_bytes_for_any_number_of_workers(folder, tmp_path):
    """A data set of events has the same bytes for any number of worker processes, and whether
    defaults are given or not.
    """
    write(tmp_path, workers=2, totals=None, bins=None)
    assert digests(tmp_path) == digests(folder) and len(digests(folder)) == 3
    lines = (tmp_path / SUMS).read_text().splitlines()
    assert {line.split("  ")[1]: line.split("  ")[0] for line in lines} == digests(folder)


def test_a_killed_run_of_events_resumes_without_duplicates(copy, folder, monkeypatch):
    """A killed run resumes with the missing files and does not change the others."""
    (copy / "events-00001.h5").unlink()
    (copy / SUMS).unlink()  # killed before it was written
    before = (copy / "events-00000.h5").stat()
    one = EventMaker.__call__

    def killed(maker, index):
        if index == 10:
            raise KeyboardInterrupt
        return one(maker, index)

    monkeypatch.setattr(EventMaker, "__call__", killed)
    with pytest.raises(KeyboardInterrupt):
        write(copy, workers=0)
    assert len(digests(copy)) == 2 and not list(copy.glob(".*.part"))
    monkeypatch.setattr(EventMaker, "__call__", one)
    write(copy, workers=0)
    assert digests(copy) == digests(folder)
    assert (copy / "events-00000.h5").stat().st_mtime_ns == before.st_mtime_ns


def test_damaged_files_and_files_of_other_settings_are_refused(copy):
    """A file of events of other settings, cut short or with a wrong byte is refused by name."""
    with pytest.raises(Refused, match="events-00000.h5: is of other settings"):
        write(copy, workers=0, angles=6)
    path = copy / "events-00001.h5"
    whole = bytearray(path.read_bytes())
    with h5py.File(path) as file:
        info = file["ideal"].id.get_chunk_info(0)
    whole[info.byte_offset + info.size // 2] ^= 4
    path.write_bytes(whole)
    with pytest.raises(Refused, match="events-00001.h5: is damaged.*delete it"):
        write(copy, workers=0)
    (copy / SUMS).unlink()
    with pytest.raises(Refused, match="events-00001.h5: is damaged.*delete it"):
        write(copy, workers=0)
    with pytest.raises(Refused, match="events-00001.h5: event 0 cannot be read"):
        Events(copy, ("ideal",))[2]
    path.unlink()  # libhdf5 takes a file that is still open in this process for the whole one
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(Refused, match="events-00001.h5: cannot be opened"):
        Events(copy)


def test_a_cycle_in_the_name_heap_is_refused(copy, monkeypatch):
    """A file of events whose list of free blocks is a circle is refused before libhdf5 opens it."""
    path = copy / "events-00000.h5"
    with h5py.File(path, "w") as file:  # of the format that has such a heap
        file["truth"] = np.ones((2, 3, 4, 5), "f4")
    whole = bytearray(path.read_bytes())
    offset, data = struct.unpack_from("<QQ", whole, whole.index(b"HEAP") + 16)
    struct.pack_into("<Q", whole, data + offset, offset)
    path.write_bytes(whole)
    monkeypatch.setattr(h5py, "File", None)  # libhdf5 would take all memory
    with pytest.raises(Refused, match="events-00000.h5: .*got a circle"):
        Events(copy)


def test_a_disk_without_room_for_events_is_refused(tmp_path, monkeypatch):
    """Insufficient disk space is reported before any event is generated."""
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 7, 3))
    with pytest.raises(OSError, match=r"5 events need up to 0\.00 GiB; 0\.00 GiB are free"):
        write(tmp_path, workers=0)
    assert digests(tmp_path) == {}


def test_counts_that_could_be_negative_are_refused(copy):
    """A file of events whose counts have a sign is refused."""
    with h5py.File(copy / "events-00002.h5", "r+") as file:
        counts = file["counts"][:].astype("i4")
        del file["counts"]
        file.create_dataset("counts", data=-counts, chunks=(1, *counts.shape[1:]))
    with pytest.raises(Refused, match="has counts as int32 .*whole numbers of at least 0"):
        Events(copy)


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_worker_processes_read_the_same_events(folder, start):
    events = Events(folder)
    counts = torch.stack([events[k]["counts"] for k in range(5)])  # opens files before the fork
    loader = DataLoader(events, batch_size=5, num_workers=1, multiprocessing_context=start)
    (batch,) = list(loader)
    assert torch.equal(batch["counts"], counts) and batch["truth"].shape == (5, 1, 8, 12, 10)
    again = deepcopy(events)  # by its pickled state, which open files have not
    assert torch.equal(again[4]["counts"], counts[4])


def test_only_one_event_is_in_memory_at_a_time(tmp_path):
    """When an event is generated, all previous ones but the last have been written and freed."""
    kept = []

    def make():
        for k in range(4):
            assert all(one() is None for one in kept[:-1])
            values = np.full((50, 50), float(k), "f4")
            kept.append(ref(values))
            yield {"truth": values}
            del values

    with h5py.File(tmp_path / "a.h5", "w") as file:
        fill(file, 4, make())
        assert file["truth"][:, 0, 0].tolist() == [0, 1, 2, 3]


def summed(folder, pipe):
    """Sum of all truths in a process that may have 48 MiB more than it has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + 48 * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    events = Events(folder, ("truth",))
    pipe.send(sum(event["truth"].sum().item() for event in (events[k] for k in range(len(events)))))


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="limits are Linux's")
def test_a_data_set_larger_than_memory_is_written_and_read(tmp_path):
    """160 MiB are read within 48."""
    volume = np.zeros((64, 128, 128), "f4")
    rest = {"ideal": volume[:1], "counts": np.zeros((1, 1, 1), "u4"), "dose": np.float64(1)}

    def make(index):
        volume[:] = index
        return {"truth": volume, "index": np.int64(index), **rest}

    header = Header("none", 0, tuple(torch.eye(4).flatten().tolist()))
    for shard in range(2):
        write_shard(
            tmp_path / f"events-{shard}.h5", header, range(20 * shard, 20 * shard + 20), make
        )
    fork = multiprocessing.get_context("fork")
    receiver, sender = fork.Pipe()
    process = fork.Process(target=summed, args=(tmp_path, sender))
    process.start()
    process.join(300)
    assert process.exitcode == 0
    assert receiver.recv() == volume.size * sum(range(40))


def test_pytorch_3dunet_reads_an_event_without_a_copy(folder, tmp_path, monkeypatch):
    write_view(tmp_path / "views" / "e.h5", folder / "events-00001.h5", 1)
    event = Events(folder, ("truth", "backprojection"))[3]
    monkeypatch.chdir("/")
    with h5py.File(tmp_path / "views" / "e.h5") as file:
        assert np.array_equal(file["label"][...], event["truth"][0])
        assert np.array_equal(file["raw"][...], event["backprojection"][0])
    assert (tmp_path / "views" / "e.h5").stat().st_size < 20_000
    for item, raw in ((2, "backprojection"), (0, "radon"), (0, "none")):
        with pytest.raises(Refused, match=r"events-00001\.h5: "):
            write_view(tmp_path / "x.h5", folder / "events-00001.h5", item, raw)


def test_totals_are_drawn_within_their_range():
    maker = EventMaker.of(settings(totals=[1e3, 1e5], angles=0, backprojection=False))
    totals = [maker._dosed(index).counts for index in range(50)]
    assert 1e3 <= min(totals) < 3e3 and 3e4 < max(totals) <= 1e5
    assert abs(maker(7)["counts"].sum() - totals[7]) < 5 * totals[7] ** 0.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"events": {"count": 2, "totals": [9, 3]}}, "totals that ascend"),
        ({"acquisition": {}}, "acquisition.counts or events.totals"),
        ({"acquisition": {"photons": 10.0}, "events": {"count": 1, "totals": [1, 2]}}, "photons"),
        ({"acquisition": {"counts": 1e3, "noise": 1.0}}, "electronic noise"),
        ({"projector": None}, "projector for events.backprojection"),
    ],
)
def test_invalid_event_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        EventMaker.of({**SETTINGS, **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 1.5}, "seed as a whole number, got 1.5"),
        ({"events": None}, "events is a mapping of count, first, .*got None"),
        ({"events": {"count": 0}}, "events.count: expected int > 0, got 0"),
        ({"events": {"count": True}}, "events.count: expected int > 0, got True"),
        ({"events": {"count": 2, "bins": 0}}, "events.bins: expected int > 0 or null, got 0"),
        ({"events": {"count": 2, "first": -1}}, "events.first: expected int >= 0, got -1"),
        ({"events": {"count": 2, "totals": [9]}}, r"events.totals: expected .*, got \[9\]"),
        ({"events": {"count": 2, "totals": [0, 9]}}, r"events.totals: expected .*got \[0, 9\]"),
        ({"events": {"count": 1, "backprojection": "nope"}}, "expected bool, got 'nope'"),
    ],
)
def test_settings_of_the_wrong_type_are_refused(change, message):
    with pytest.raises(TypeError, match=message):
        EventMaker.of({**SETTINGS, **change})


def test_missing_arrays_are_named(folder, tmp_path):
    with pytest.raises(LookupError, match="no array 'count'; did you mean 'counts'"):
        Events(folder, ("count",))
    with pytest.raises(FileNotFoundError, match="no files events-"):
        Events(tmp_path)
    assert header_of(folder / "events-00002.h5")[1] == 1
