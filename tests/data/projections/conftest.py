"""One small scan in every form that is read."""

import h5py
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from PIL import Image as Pillow
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian

from mvrecon.data.dicom_image import PRIVATE
from mvrecon.data.projections.views import Measured, MeasuredViews

VIEWS, ROWS, COLUMNS = 12, 6, 8
#: Tag and type of DICOM-CT-PD's private attributes.
CT_PD = {
    name: (tag, {"": "CS", "<f4": "FL", "<u2": "US"}[kind]) for tag, (name, kind) in PRIVATE.items()
}


def grey():
    """Grey values of twelve views, no two pixels alike."""
    count = VIEWS * ROWS * COLUMNS
    values = np.random.default_rng(1).permutation(count).astype("u2") * 100 + 500
    return values.reshape(VIEWS, ROWS, COLUMNS)


def dicom_image(path, values, **tags):
    """A DICOM image of unsigned 16-bit pixels [v u] or [m v u]."""
    meta = FileMetaDataset()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    meta.MediaStorageSOPClassUID = pydicom.uid.CTImageStorage
    meta.MediaStorageSOPInstanceUID = tags.get("SOPInstanceUID", pydicom.uid.generate_uid())
    dataset = FileDataset(str(path), {}, file_meta=meta, preamble=bytes(128))
    dataset.Rows, dataset.Columns = values.shape[-2:]
    dataset.SamplesPerPixel, dataset.PhotometricInterpretation = 1, "MONOCHROME2"
    dataset.BitsAllocated = dataset.BitsStored = 16
    dataset.HighBit, dataset.PixelRepresentation = 15, int(values.dtype.kind == "i")
    if values.ndim == 3:
        dataset.NumberOfFrames = len(values)
    dataset.SOPClassUID = meta.MediaStorageSOPClassUID
    dataset.SOPInstanceUID = meta.MediaStorageSOPInstanceUID
    dataset.PixelData = values.tobytes()
    for name, value in tags.items():
        if name in CT_PD:
            dataset.add_new(*CT_PD[name], value)
        else:
            setattr(dataset, name, value)
    dataset.save_as(path, enforce_file_format=True)


def images(folder, values, ending="tif"):
    """A folder of images, numbered without leading zeros."""
    folder.mkdir(exist_ok=True)
    for k, view in enumerate(values):
        if ending == "dcm":
            dicom_image(folder / f"view_{k}.dcm", view)
        else:
            Pillow.fromarray(view).save(folder / f"view_{k}.{ending}")
    return folder


def many_pages(path, values):
    """A TIFF of several pages."""
    pages = [Pillow.fromarray(view) for view in values]
    pages[0].save(path, save_all=True, append_images=pages[1:])
    return path


def array(path, values, packed=False):
    """An array file by its ending."""
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            options = {"compression": "gzip", "shuffle": True}
            views = file.create_dataset("views", data=values.astype("f4"), **options)
            views.attrs["unit"] = "1/mm * mm"
    else:
        sitk.WriteImage(sitk.GetImageFromArray(values), str(path), packed)
    return path


def dicom_frames(path, values):
    """A DICOM file of several frames."""
    dicom_image(path, values)
    return path


FORMS = {
    "tif": lambda folder, values: images(folder / "scan", values, "tif"),
    "png": lambda folder, values: images(folder / "scan", values, "png"),
    "dcm": lambda folder, values: images(folder / "scan", values, "dcm"),
    "pages": lambda folder, values: many_pages(folder / "scan.tiff", values),
    "frames": lambda folder, values: dicom_frames(folder / "scan.dcm", values),
    "npy": lambda folder, values: array(folder / "scan.npy", values),
    "h5": lambda folder, values: array(folder / "scan.h5", values),
    "mha": lambda folder, values: array(folder / "scan.mha", values),
    "mhd, packed": lambda folder, values: array(folder / "scan.mhd", values, True),
    "nrrd": lambda folder, values: array(folder / "scan.nrrd", values),
    "nrrd, packed": lambda folder, values: array(folder / "scan.nrrd", values, True),
}


@pytest.fixture
def scan(tmp_path):
    """A folder of twelve TIFF images with a dark and a flat field."""
    folder = images(tmp_path / "scan", grey(), "tif")
    for name, value in (("dark", 100), ("flat", 60_100)):
        field = np.full((ROWS, COLUMNS), value, "u2")
        Pillow.fromarray(field).save(folder / f"{name}.tif")
    return folder


def opened(path, **options) -> MeasuredViews:
    """Measured views by their path and options."""
    return MeasuredViews(Measured(path=str(path), **options))
