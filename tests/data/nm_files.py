"""DICOM NM files of views, with frames in a random order."""

import random
from pathlib import Path

import numpy as np

VECTORS = ("EnergyWindowVector", "DetectorVector", "RotationVector", "AngularViewVector")


def study(path: Path, **changes: object) -> Path:
    """Two windows, two detectors, three views each of 4 x 5 pixels, in a random order; the counts
    of a frame are its key as a decimal number."""
    from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian, generate_uid

    keys = [(w, d, 1, a) for w in (1, 2) for d in (1, 2) for a in (1, 2, 3)]
    random.Random(0).shuffle(keys)
    pixels = np.stack([np.full((4, 5), 1000 * w + 100 * d + a) for w, d, _, a in keys])
    pixels[:, 0, 1] = 7  # row 0, column 1
    meta = FileMetaDataset()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.20"
    meta.MediaStorageSOPInstanceUID = generate_uid()
    file = FileDataset(str(path), {}, file_meta=meta, preamble=bytes(128))
    file.Modality, file.Rows, file.Columns, file.NumberOfFrames = "NM", 4, 5, len(keys)
    file.SamplesPerPixel, file.PhotometricInterpretation = 1, "MONOCHROME2"
    file.BitsAllocated = file.BitsStored = 16
    file.HighBit, file.PixelRepresentation = 15, 0
    file.PixelSpacing = [2.0, 1.5]
    for name, values in zip(VECTORS, zip(*keys, strict=True), strict=True):
        setattr(file, name, list(values))
    file.EnergyWindowInformationSequence = [
        item(
            Dataset,
            EnergyWindowName=name,
            EnergyWindowRangeSequence=[
                item(Dataset, EnergyWindowLowerLimit=low, EnergyWindowUpperLimit=high)
            ],
        )
        for name, low, high in (("scatter", 110.0, 126.0), ("peak", 126.5, 154.5))
    ]
    file.DetectorInformationSequence = [
        item(Dataset, StartAngle=start, CollimatorType="PINH") for start in (10.0, 190.0)
    ]
    file.RotationInformationSequence = [
        item(
            Dataset,
            StartAngle=10.0,
            AngularStep=30.0,
            RotationDirection="CW",
            ScanArc=90.0,
            ActualFrameDuration=20000,
            RadialPosition=[250.0, 251.0, 252.0],
            NumberOfFramesInRotation=3,
        )
    ]
    file.PixelData = pixels.astype("<u2").tobytes()
    for name, value in changes.items():
        setattr(file, name, value)
    file.save_as(path)
    return path


def item(kind: type, **values: object):
    dataset = kind()
    for name, value in values.items():
        setattr(dataset, name, value)
    return dataset


def in_time(path: Path, vectors: tuple[str, str], **changes: object) -> Path:
    """Two detectors and six frames in time, in a random order: 4 slices of a phase (or slots of an
    R-R interval) and 2 of a second; the counts of a frame are 100 d + 10 phase + slice.
    """
    moments = [(1, 1), (1, 2), (1, 3), (1, 4), (2, 1), (2, 2)]
    keys = [(d, *moment) for d in (1, 2) for moment in moments]
    random.Random(1).shuffle(keys)
    detector, first, second = (list(values) for values in zip(*keys, strict=True))
    pixels = np.stack([np.full((4, 5), 100 * d + 10 * p + k) for d, p, k in keys])
    fixed = {"EnergyWindowVector": [1] * 12, "AngularViewVector": [1] * 12}
    return study(
        path,
        **fixed,
        DetectorVector=detector,
        **dict(zip(vectors, (first, second), strict=True)),
        PixelData=pixels.astype("<u2").tobytes(),
        **changes,
    )
