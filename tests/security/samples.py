"""A valid file of every kind that is read, and how it is read."""

import gzip
import io
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import torch
import yaml

from mvrecon.cameras.files import from_file, save
from mvrecon.config import compose
from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from mvrecon.data.nifti import read_nifti
from mvrecon.engine import fit
from mvrecon.engine.checkpoints import load
from mvrecon.limits import yaml_of
from mvrecon.parts import CAMERAS

Wrap = Callable[[bytes], bytes]
HU = np.arange(6 * 7 * 8, dtype=np.int16).reshape(6, 7, 8)
RIG = {"name": "circular", "views": 3, "sid": 300.0, "sdd": 450.0, "detector": {"pixels": [10, 12], "pixel_mm": 9.0}}
SMALL = ["grid.shape=[6,6,6]", "camera.views=2", "camera.detector.pixels=[6,6]"]


def checkpoint() -> dict[str, Any]:
    """What a run keeps of a small method."""
    settings = compose(*SMALL, "model=backprojection_unet", "model.width=2")
    torch.manual_seed(0)
    module = fit.build_module(settings, settings["model"], 0.04)
    kept = {"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams), "global_step": 3}
    return {**kept, "callbacks": {"Clock": {"seconds": 1.5}}, "pytorch-lightning_version": "2.6.6"}


def saved(value: Any) -> bytes:
    """The bytes that `torch.save` writes."""
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def with_pickle(archive: bytes, pickle: bytes) -> bytes:
    """A checkpoint with another pickle in it, every checksum right."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as old, zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as new:
        for member in old.infolist():
            new.writestr(member.filename, pickle if member.filename.endswith("data.pkl") else old.read(member))
    return buffer.getvalue()


def pickle_of(archive: bytes) -> bytes:
    """The pickle in a checkpoint."""
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        return file.read(next(name for name in file.namelist() if name.endswith("data.pkl")))


def read_volumes(path: Path) -> list[Stored]:
    """Every volume of a file."""
    file = VolumeFile(path)
    return [file.read(index) for index in range(len(file)) if file.orientation != "none"]


def samples(folder: Path) -> dict[str, tuple[Callable[[Path], Any], bytes, Wrap, str]]:
    """By reader: how it reads, what is damaged, what is put around the damaged bytes, and the file's ending."""
    write_volumes(folder / "a.h5", [Stored(f"p{k}", HU + k, (3.0, 2.0, 2.0)) for k in range(3)], orientation="LPI")
    nibabel.save(nibabel.Nifti1Image(HU, np.diag([2.0, 2.0, 3.0, 1.0])), folder / "a.nii")
    save(CAMERAS.from_config(RIG), folder / "a.json")
    hdf5, nifti, rig = ((folder / f"a.{suffix}").read_bytes() for suffix in ("h5", "nii", "json"))
    archive, whole = saved(checkpoint()), bytes
    composed = compose(*SMALL)
    settings = yaml.safe_dump({key: composed[key] for key in ("name", "grid", "camera", "plugins")}).encode()
    return {
        "HDF5 volumes": (read_volumes, hdf5, whole, ".h5"),
        "NIfTI": (read_nifti, nifti, whole, ".nii"),
        "NIfTI, then packed": (read_nifti, nifti, partial(gzip.compress, compresslevel=1), ".nii.gz"),
        "NIfTI, packed": (read_nifti, gzip.compress(nifti), whole, ".nii.gz"),
        "cameras": (from_file, rig, whole, ".json"),
        "settings": (yaml_of, settings, whole, ".yaml"),
        "checkpoint": (load, archive, whole, ".ckpt"),
        "checkpoint's pickle": (load, pickle_of(archive), partial(with_pickle, archive), ".ckpt"),
    }
