"""A folder of cases as a perfect detector measures them, kept from run to run."""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import torch

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused
from mvrecon.data.digests import of_grid, of_rig
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.data.storage import dataset_in, opened
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid

#: Raised where what a scene, a projector or a file of this store is has changed: older files are
#: not read.
VERSION = 2


class CaseStore:
    """A folder of cases as a perfect detector measures them, in a file each.

    A file is known by a SHA-256 digest of all that its case depends on: what `made_of` says, index,
    seed, grid and rig. What a detector adds, and gains that drifted, are not in it. Files are
    written whole or not at all, so several runs may share a folder; a file that is damaged is made
    anew.

    Args:
        folder: of the files; it is made.
        made_of: settings of scene and projector and digests of their files, as JSON has them.
        scene: its `seed_of(index, seed)` says on which seed a case depends.
    """

    def __init__(self, folder: str | Path, made_of: Mapping[str, Any], scene: Scene):
        self.folder, self.made_of = Path(folder), json.dumps(made_of, sort_keys=True)
        self.scene = scene

    def __call__(
        self, index: int, seed: int, grid: Grid, cameras: Any, make: Callable[[], Sample]
    ) -> Sample:
        """The case that is kept, or else the one that `make` makes, kept from now on.

        Explicit rays have no digest: their cases are not kept.

        Raises:
            OSError: the folder cannot be written.
        """
        if not isinstance(cameras, Cameras):
            return make()
        path = self.path(index, seed, grid, cameras)
        if path.exists():
            try:
                return _read(path, grid, cameras)
            except Refused:  # cut short or damaged: the case can be made again
                pass
        sample = make()
        with written_whole(path) as part, h5py.File(part, "w") as file:
            tensors = {"views": sample.views, "volume": sample.volume, "inside": sample.inside}
            for name, tensor in {**tensors, **sample.maps}.items():
                values, chunks = tensor.cpu().numpy(), (1, *tensor.shape[1:])
                file.create_dataset(name, data=values, fletcher32=True, chunks=chunks)
            file.attrs["name"] = sample.name
        return sample

    def path(self, index: int, seed: int, grid: Grid, cameras: Cameras) -> Path:
        """The file of a case."""
        seed = self.scene.seed_of(index, seed)
        case = [VERSION, self.made_of, index, seed, of_grid(grid), of_rig(cameras)]
        return self.folder / f"{hashlib.sha256(json.dumps(case).encode()).hexdigest()}.h5"


def _read(path: Path, grid: Grid, cameras: Cameras) -> Sample:
    """The case in a file.

    Raises:
        Refused: it is damaged, or has another size or type than this case.
    """
    volume = (1, *grid.shape)
    expected = {
        "views": ((1, len(cameras), *cameras.shape), "float32"),
        "volume": (volume, "float32"),
        "inside": (volume, "bool"),
    }
    values = {}
    with opened(path, "a case", "is not a case that can be read") as file:
        maps = {name: (volume, "float32") for name in file if name not in expected}
        for name, kind in {**expected, **maps}.items():
            dataset = dataset_in(path, file, name, "a case")
            if (dataset.shape, str(dataset.dtype)) != kind:
                raise Refused(
                    f"{path}: expected {name} as {kind}, got {dataset.shape}, {dataset.dtype}"
                )
            values[name] = torch.from_numpy(dataset[()])
        held = {str(name): values.pop(name) for name in maps}
        return Sample(**values, name=str(file.attrs["name"]), maps=held)
