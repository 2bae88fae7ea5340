"""Generate a data set of random events. Each is a pure function of (settings, seed, index); files
are written in parallel, and an interrupted run can be resumed.
"""

import hashlib
import json
import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from torch import Tensor
from torch.utils.data import DataLoader

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, shown, text_of
from mvrecon.core.numbers import generator, mixed, uniform
from mvrecon.core.options import check_value
from mvrecon.core.parts import CAMERAS, PROJECTORS, SCENES
from mvrecon.core.quantities import NonNegativeInt, Pair, PositiveFloat, PositiveInt
from mvrecon.core.registry import from_options
from mvrecon.core.signatures import options_of
from mvrecon.data.acquisition.acquired import NOISE, Acquired
from mvrecon.data.acquisition.detector import Acquisition, counted, emitted
from mvrecon.data.digests import files_in, of_file
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import sinogram_rig
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.threads import in_one_order
from mvrecon.operators.operator import Projector
from mvrecon.operators.radon import Radon
from mvrecon_spect.events.shards import Header, fill, header_of, verify, write_shard

#: Rays of a bin of a sinogram for each fine voxel across it, and at least.
RAYS, MIN_RAYS = 4, 8


class Sinograms:
    """Radon transform of all slices over the full circle, in (unit of the volume) * mm.

    A bin is the mean over several rays for each fine voxel, and a slice the mean of its fine
    slices: at every angle the bins sum to the slice's mass within 0.5 %.

    Opposite views are mirror images: for an even number of angles only half of them are computed,
    with identical bits.

    Args:
        grid: grid of the output slices.
        fine: factor by which the volume's grid is finer.
        angles: number over the full circle.
        bins: number of columns; None: enough for the diagonal of a slice.
    """

    def __init__(self, grid: Grid, fine: int, angles: int, bins: int | None = None):
        rig = sinogram_rig(grid, angles, bins)
        self.mirrored = angles % 2 == 0
        half = rig[list(range(angles // 2))] if self.mirrored else rig
        self.fine, self.rays = fine, max(RAYS * fine, MIN_RAYS)
        affine = grid.refined(fine).affine  # across the slices, which keep their thickness
        affine[:3, 2] = grid.affine[:3, 2]
        affine[:3, 3] += (grid.affine[:3, 2] / fine) * ((fine - 1) / 2)
        z, y, x = grid.shape
        slices = Grid((z, fine * y, fine * x), affine)
        self.operator = Radon(slices, half.refined(self.rays).binned((self.rays, 1)))
        self.shape = angles, *rig.shape

    def __call__(self, volume: Float[Tensor, "1 d h w"]) -> Float[Tensor, "a z s"]:
        slices = volume.unflatten(1, (-1, self.fine)).mean(dim=2)
        with torch.no_grad():
            rays = self.operator(slices[None])[0, 0].unflatten(-1, (-1, self.rays))
        views = rays.mean(dim=-1, dtype=torch.float64).to(rays)
        return torch.cat([views, views.flip(-1)]) if self.mirrored else views


@dataclass(frozen=True, kw_only=True)
class EventSettings:
    """Number of events, their distribution over files, and the stored arrays.

    Args:
        count: number of events.
        first: index of the first event in its series, to continue a series in another folder.
        shard: events per file; the last file may contain fewer.
        workers: number of worker processes, 0: none. Files do not depend on it.
        totals: minimum and maximum expected counts of an event, drawn uniformly in the logarithm.
            None: `acquisition.counts` for all.
        angles: number of sinogram angles over the full circle; 0: no sinograms.
        bins: bins of the sinograms; None: enough for the diagonal of a slice.
        backprojection: whether to store the back-projection of the counts.

    Raises:
        TypeError: an option of another type or range.
        ValueError: totals that do not ascend.
    """

    count: PositiveInt
    first: NonNegativeInt = 0
    shard: PositiveInt = 32
    workers: NonNegativeInt = 2
    totals: Pair[PositiveFloat] | None = None
    angles: NonNegativeInt = 256
    bins: PositiveInt | None = None
    backprojection: bool = False

    def __post_init__(self) -> None:
        for name, option in options_of(EventSettings)[0].items():
            check_value(f"events.{name}", getattr(self, name), option)
        if self.totals is not None and not self.totals[0] <= self.totals[1] < math.inf:
            raise ValueError(f"Expected events.totals that ascend, got {list(self.totals)}")

    @property
    def shards(self) -> int:
        """Number of files."""
        return -(-self.count // self.shard)

    def indices(self, shard: int) -> range:
        """Series indices of the events in a file."""
        start = self.first + shard * self.shard
        return range(start, min(start + self.shard, self.first + self.count))


#: Random series of the doses.
DOSES = 0x646F7365
#: The largest number in a bin of counts.
MOST = 2**32 - 1
Arrays = dict[str, np.ndarray]


@dataclass
class EventMaker:
    """Generates events of a scene: views by cameras, counted by a detector.

    Args:
        scene: objects and acquisition.
        grid: grid of the truth.
        cameras: the rig.
        seed: seed of the series of cases.
        settings: settings of the data set.

    Raises:
        TypeError: the seed is not an integer.
        ValueError: the acquisition has no counts, or has rig errors or electronic noise.
    """

    scene: Acquired
    grid: Grid
    cameras: Cameras
    seed: int
    settings: EventSettings

    def __post_init__(self) -> None:
        if not isinstance(self.seed, int) or isinstance(self.seed, bool):
            raise TypeError(f"Expected seed as a whole number, got {self.seed!r}")
        acquisition = self.scene.acquisition
        if self.settings.totals is None and acquisition.counts is None:
            raise ValueError(
                "Expected the counts of an event as acquisition.counts or events.totals, got none"
            )
        if acquisition.photons is not None or acquisition.disturbed is not None:
            raise ValueError(
                f"Expected an acquisition of counts without rig errors, got photons "
                f"{acquisition.photons} and disturbed {acquisition.disturbed}"
            )
        if acquisition.noise:
            raise ValueError(
                f"Expected whole counts without electronic noise, got noise {acquisition.noise}"
            )
        angles, bins, fine = self.settings.angles, self.settings.bins, acquisition.fine
        self.sinograms = Sinograms(self.grid, fine, angles, bins) if angles else None
        self.backprojector = None  # the projector without attenuation, and its sensitivity A^T 1
        if self.settings.backprojection:
            if self.scene.projector is None:
                raise ValueError("Expected a projector for events.backprojection, got none")
            options = {"grid": self.grid, "cameras": self.cameras}
            A: Projector = PROJECTORS.from_config(self.scene.projector, **options)
            with torch.no_grad():
                self.backprojector = A, A.T(torch.ones(1, 1, *A.range_shape))

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> "EventMaker":
        """Build the maker from the settings of an app."""
        grid, cameras = Grid.centred(**settings["grid"]), CAMERAS.from_config(settings["camera"])
        scene = SCENES.from_config(settings["scene"])
        acquired = Acquired(scene, settings["projector"], Acquisition.of(settings["acquisition"]))
        events = from_options(EventSettings, "events", settings["events"])
        return cls(acquired, grid, cameras, settings["seed"], events)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of an event's random parameters."""
        return tuple(self.scene.scene.parameters(self.settings.first, self.seed, self.grid))

    def __call__(self, index: int) -> Arrays:
        """The arrays of one event by name; see `mvrecon_spect.events.shards`.

        Raises:
            ValueError: values that are not finite, negative views, or counts that exceed the file's
                integer range.
        """
        where = index, self.seed, self.grid, self.cameras
        (sample, fine), acquisition = self.scene.ideal(*where), self._dosed(index)
        for name, values in (("views", sample.views), ("volume", sample.volume)):
            if not values.isfinite().all():
                raise ValueError(f"{sample.name}: expected finite {name}, got values that are not")
        ideal = emitted(sample.views, acquisition, self.cameras)
        number, dose = counted(ideal, acquisition, generator(NOISE, mixed(self.seed, index)))
        if number.max() > MOST:
            raise ValueError(f"Expected at most {MOST} counts in a bin, got {number.max():.0f}")
        arrays: Arrays = {
            "truth": sample.volume[0].numpy(),
            "ideal": sample.views[0].numpy(),
            "counts": number[0].numpy().astype(np.uint32),
            "dose": np.array(dose),
            "index": np.array(index),
        }
        if self.backprojector is not None:
            A, sensitivity = self.backprojector
            with torch.no_grad():
                sums, weight = A.T(number[None].float()), sensitivity * dose
            volume = torch.where(weight > 0, sums / weight, 0.0)[0, 0]
            arrays["backprojection"] = volume.numpy()
        arrays |= {name: values[0].numpy() for name, values in sample.maps.items()}
        if self.sinograms is not None:
            if fine is None:
                fine = self.scene.scene.finer(*where, acquisition.fine)
            arrays["radon"] = self.sinograms(fine).numpy()
        if drawn := self.scene.scene.parameters(index, self.seed, self.grid):
            arrays["pose"] = np.array(list(drawn.values()), dtype=np.float64)
        return arrays

    def _dosed(self, index: int) -> Acquisition:
        """The acquisition with the given expected counts of one event."""
        if self.settings.totals is None:
            return self.scene.acquisition
        low, high = (math.log(total) for total in self.settings.totals)
        rng = generator(DOSES, mixed(self.seed, index))
        return replace(self.scene.acquisition, counts=math.exp(uniform(rng, low, high)))


#: The file of the shards' SHA-256 digests, as `sha256sum --check` reads it.
SUMS = "SHA256SUMS"
#: Version, incremented when the same settings generate different events.
VERSION = 2
#: Settings that determine the events.
DEPENDS = ("seed", "grid", "scene", "camera", "projector", "acquisition", "events")
#: Assumed maximum ratio of the mean event size to that of the first event.
MARGIN = 1.2


def write_events(folder: Path, maker: EventMaker, made_of: Mapping[str, Any]) -> list[Path]:
    """Write all missing events of a folder and return the paths of all files.

    Files are written atomically and depend only on the settings and their number: an interrupted
    run can be resumed and gives the same bytes for any number of workers. Existing files are
    checked first.

    Args:
        folder: folder of the files, which the caller has claimed
            (`mvrecon.core.files.atomic.claimed`).
        maker: generates the events.
        made_of: settings of the app; events depend on those in `DEPENDS`.

    Raises:
        OSError: insufficient disk space.
        Refused: the folder contains a damaged file or one of other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    affine = tuple(maker.grid.affine.flatten().tolist())
    parts = {name: made_of[name] for name in DEPENDS}
    defaults = {field.name: field.default for field in fields(EventSettings)}
    given = parts["events"].items()  # an option at its default equals an omitted one
    parts["events"] = {k: v for k, v in given if k != "workers" and v != defaults[k]}
    parts["files"] = {path: of_file(path) for path in sorted(set(files_in(parts)))}
    text = json.dumps([VERSION, parts], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()
    header = Header(digest, maker.seed, affine, maker.columns)
    paths = [folder / f"events-{k:05d}.h5" for k in range(maker.settings.shards)]
    sums = {path.name: _checked(path, maker, k, header) for k, path in enumerate(paths)}
    sums = {name: digest for name, digest in sums.items() if digest}
    missing = [k for k, path in enumerate(paths) if path.name not in sums]
    if missing:
        check_room(folder, maker, sum(len(maker.settings.indices(k)) for k in missing))
    _write_sums(folder, sums)
    make = partial(_made, maker, header, folder)
    with in_one_order():  # one torch thread, as in worker processes, for identical bits
        workers = maker.settings.workers
        made = DataLoader(missing, batch_size=None, collate_fn=make, num_workers=workers)  # type: ignore[arg-type]
        console = Console(stderr=True)
        for name, digest in track(made, "Events", len(missing), transient=True, console=console):
            sums[name] = digest
            _write_sums(folder, sums)
    return paths


def check_room(folder: Path, maker: EventMaker, count: int) -> None:
    """Check the disk space for a number of events, estimated from the first one.

    Raises:
        OSError: insufficient disk space.
    """
    with h5py.File("event", "w", driver="core", backing_store=False) as file:
        fill(file, 1, [maker(maker.settings.first)])
        one = sum(array.id.get_storage_size() for array in file.values())
    need, free = round(MARGIN * count * one), shutil.disk_usage(folder).free
    text = f"{count} events need up to {need / 2**30:.2f} GiB; {free / 2**30:.2f} GiB are free"
    if need > free:
        raise OSError(f"{folder}: {text}. Choose another folder by hydra.run.dir=..., or fewer")
    Console(stderr=True, highlight=False).print(f"{text}.")


def _made(maker: EventMaker, header: Header, folder: Path, shard: int) -> tuple[str, str]:
    """Write a file and return its name and digest."""
    path = folder / f"events-{shard:05d}.h5"
    write_shard(path, header, maker.settings.indices(shard), maker)
    return path.name, of_file(path)


def _checked(path: Path, maker: EventMaker, shard: int, header: Header) -> str | None:
    """Digest of an existing valid file; None if there is no file."""
    if not path.exists():
        return None
    got, count = header_of(path)
    if got != header or count != len(maker.settings.indices(shard)):
        raise Refused(
            f"{path}: is of other settings: got {count} events, settings {got.settings[:16]}, "
            f"expected {len(maker.settings.indices(shard))}, {header.settings[:16]}; choose "
            f"another folder by hydra.run.dir=..."
        )
    digest, expected = of_file(path), _sums(path.parent).get(path.name)
    if expected is None:
        verify(path)
    elif digest != expected:
        raise Refused(
            f"{path}: is damaged: got sha256 {digest[:16]}, expected {expected[:16]} as in "
            f"{SUMS}; delete it to have it made again"
        )
    return digest


def _sums(folder: Path) -> dict[str, str]:
    path = folder / SUMS
    if not path.is_file():
        return {}
    lines = [line.split("  ") for line in text_of(path).splitlines()]
    if any(len(line) != 2 for line in lines):
        raise Refused(f"{path}: expected lines of a digest and a name, got {shown(lines)}")
    return {name: digest for digest, name in lines}


def _write_sums(folder: Path, sums: Mapping[str, str]) -> None:
    with written_whole(folder / SUMS) as part:
        part.write_text("".join(f"{sums[name]}  {name}\n" for name in sorted(sums)))
