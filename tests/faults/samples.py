"""A valid file of every kind that is read, and how it is read."""

import gzip
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tifffile
import torch
import yaml

from mvrecon.apps import scan_file
from mvrecon.core.files.checks import yaml_of
from mvrecon.core.parts import CAMERAS
from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from mvrecon.data.projections.opening import open_projections
from mvrecon.data.volume_files import read_volume, save_volume
from mvrecon.geometry.cameras.files import from_file, save
from mvrecon.geometry.cameras.formats import nikon, rtk_xml
from mvrecon.geometry.cameras.formats.common import angles_in
from mvrecon.geometry.grid import Grid
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.trained import load_checkpoint as load
from mvrecon_baselines.pytorch3dunet import Example, read_example, write_example
from tests.data.projections.conftest import dicom_image
from tests.data.projections.test_nexus import exchange, tomo
from tests.data.projections.test_nikon import xtekct
from tests.data.test_vgi import vgi
from tests.faults.hostile import pickle_of, saved, with_pickle

Wrap = Callable[[bytes], bytes]
#: Readers of formats with checksums over all that is read: a damaged file is refused or has the
#: same values. Plain NIfTI, HDF5 that others wrote, cameras (JSON) and settings (YAML) have none:
#: other values are what the file says.
CHECKED = ("HDF5 volumes", "NIfTI, packed", "checkpoint")
HU = np.arange(6 * 7 * 8, dtype=np.int16).reshape(6, 7, 8)
RIG = {
    "name": "circular",
    "n_views": 3,
    "sid": 300.0,
    "sdd": 450.0,
    "detector": {"pixels": [10, 12], "pixel_mm": 9.0},
}
#: A method of few weights, as a run keeps its settings.
METHOD = {
    "geometry": {
        "grid": {"shape": [6, 6, 6], "spacing": 4.0},
        "camera": {**RIG, "n_views": 2, "detector": {"pixels": [6, 6], "pixel_mm": 9.0}},
        "projector": {"name": "drr"},
    },
    "method": {"name": "world_unet", "widths": [2]},
    "loss": {"volume": 1.0},
    "optimizer": {"name": "adamw", "lr": 1e-3, "schedule": "constant", "warmup": 0.0},
    "data_range": 0.04,
}


def checkpoint() -> dict[str, Any]:
    """What a run keeps of a small method."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        module = ReconstructionModule(**METHOD)
    kept = {
        "state_dict": module.state_dict(),
        "hyper_parameters": dict(module.hparams),
        "global_step": 3,
    }
    return {**kept, "callbacks": {"Clock": {"seconds": 1.5}}, "pytorch-lightning_version": "2.6.6"}


def read_volumes(path: Path) -> list[Stored]:
    """Every volume of a file."""
    file = VolumeFile(path)
    return [file.read(index) for index in range(len(file)) if file.orientation != "none"]


def read_views(path: Path) -> torch.Tensor:
    """Every view of a stack."""
    stack = open_projections(path)
    return stack.read(0, stack.n_views)


def read_description(path: Path) -> list[str]:
    """The command line of a scan.yaml."""
    return scan_file.expanded([f"scan={path}"])


def samples(folder: Path) -> dict[str, tuple[Callable[[Path], Any], bytes, Wrap, str]]:
    """By reader: how it reads, what is damaged, what is put around the damaged bytes, and the
    file's ending.

    NIfTI is among them where nibabel is installed.
    """
    write_volumes(
        folder / "a.h5",
        [Stored(f"p{k}", HU + k, (3.0, 2.0, 2.0)) for k in range(3)],
        orientation="LPI",
    )
    save(CAMERAS.from_config(RIG), folder / "a.json")
    hdf5, rig = ((folder / f"a.{suffix}").read_bytes() for suffix in ("h5", "json"))
    archive, whole = saved(checkpoint()), bytes
    rtk_xml.write(CAMERAS.from_config(RIG), folder / "a.xml")
    angles = "".join(f"{3.5 * k}\n" for k in range(40)).encode()
    scan = yaml.safe_dump({"views": {"path": "v.tif", "flat": 5e4}, "camera": RIG}).encode()
    settings = yaml.safe_dump({"name": "train", "plugins": [], **METHOD["geometry"]}).encode()
    return {
        "HDF5 volumes": (read_volumes, hdf5, whole, ".h5"),
        **(_nifti(folder) if find_spec("nibabel") else {}),
        **(_itk(folder) if find_spec("nibabel") and find_spec("SimpleITK") else {}),
        **_views(folder),
        "cameras": (from_file, rig, whole, ".json"),
        "Nikon's geometry": (nikon.read, xtekct(folder).read_bytes(), whole, ".xtekct"),
        "RTK's geometry": (
            partial(rtk_xml.read, detector=RIG["detector"]),
            (folder / "a.xml").read_bytes(),
            whole,
            ".xml",
        ),
        "angles": (angles_in, angles, whole, ".txt"),
        "scan.yaml": (read_description, scan, whole, ".yaml"),
        "VGStudio": (read_volume, vgi(folder).read_bytes(), whole, ".vgi"),
        "settings": (yaml_of, settings, whole, ".yaml"),
        "checkpoint": (load, archive, whole, ".ckpt"),
        "checkpoint's pickle": (load, pickle_of(archive), partial(with_pickle, archive), ".ckpt"),
    }


def _views(folder: Path) -> dict[str, tuple[Callable[[Path], Any], bytes, Wrap, str]]:
    from PIL import Image as Pillow

    pages = [Pillow.fromarray(plane.astype("u2")) for plane in HU]
    pages[0].save(folder / "v.tif", save_all=True, append_images=pages[1:])
    pages[0].save(folder / "v.png")
    np.save(folder / "v.npy", HU)
    if find_spec("pydicom"):
        dicom_image(folder / "v.dcm", HU.astype("u2"), RescaleSlope=2, RescaleIntercept=-1024)
    write_example(folder / "e.h5", Example(HU))
    with h5py.File(folder / "v.h5", "w") as file:
        views = file.create_dataset("views", data=HU.astype("f4"), compression="gzip", shuffle=True)
        views.attrs["unit"] = "1/mm * mm"
    tomo(folder / "v.nxs")
    exchange(folder / "x.h5")
    tifffile.imwrite(folder / "v.ome.tif", HU.astype("u2"), metadata={"axes": "TYX"})
    return {
        "views, Data Exchange": (read_views, (folder / "x.h5").read_bytes(), bytes, ".h5"),
        "views, OME-TIFF": (read_views, (folder / "v.ome.tif").read_bytes(), bytes, ".ome.tif"),
        "pytorch-3dunet": (read_example, (folder / "e.h5").read_bytes(), bytes, ".h5"),
        **{
            f"views, {name}": (
                read_views,
                (folder / f"v.{ending}").read_bytes(),
                bytes,
                f".{ending}",
            )
            for name, ending in (
                ("TIFF", "tif"),
                ("PNG", "png"),
                ("NumPy", "npy"),
                ("HDF5", "h5"),
                ("NeXus", "nxs"),
                ("DICOM", "dcm"),
            )
            if (folder / f"v.{ending}").exists()
        },
    }


def _itk(folder: Path) -> dict[str, tuple[Callable[[Path], Any], bytes, Wrap, str]]:
    grid = Grid.centred(size=HU.shape[::-1], spacing=(2.0, 2.0, 3.0))
    samples = {}
    for ending in (".mha", ".nrrd"):
        save_volume(folder / f"a{ending}", torch.from_numpy(HU).float(), grid)
        samples[ending[1:].upper()] = (
            read_volume,
            (folder / f"a{ending}").read_bytes(),
            bytes,
            ending,
        )
    return samples


def _nifti(folder: Path) -> dict[str, tuple[Callable[[Path], Any], bytes, Wrap, str]]:
    import nibabel

    nibabel.save(nibabel.Nifti1Image(HU, np.diag([2.0, 2.0, 3.0, 1.0])), folder / "a.nii")
    nifti = (folder / "a.nii").read_bytes()
    return {
        "NIfTI": (read_volume, nifti, bytes, ".nii"),
        "NIfTI, then packed": (
            read_volume,
            nifti,
            partial(gzip.compress, compresslevel=1),
            ".nii.gz",
        ),
        "NIfTI, packed": (read_volume, gzip.compress(nifti), bytes, ".nii.gz"),
    }
