"""The files of a reconstruction: the volume, in its unit, and what lies beside it."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import gettempdir

from torch import Tensor

from mvrecon.apps import scan_file
from mvrecon.apps.run_method import Outcome
from mvrecon.apps.scan import ATTENUATION, Scan
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.atomic import check_room, check_writable, written_or_kept
from mvrecon.core.files.checks import from_home
from mvrecon.core.files.runs import RESULTS, SETTINGS, VERSIONS, check_inputs
from mvrecon.data.attenuation import hounsfield
from mvrecon.data.volume_files import check_ending, name_of, save_volume, volume_writer
from mvrecon.geometry.grid import Grid

#: Bytes of a voxel in the volume's file, at most.
BYTES_PER_VOXEL = 4
#: What a run writes into its folder beside the volume.
PRODUCTS = (SETTINGS, VERSIONS, "rig.json", "rig.png", "planes.png", "cameras.png", RESULTS)
#: Ends the names of files beside the volume: a calibrated rig, the scan with it, and the error's
#: standard deviation.
RIG_ENDING, SCAN_ENDING, SIGMA_ENDING = ".cameras.json", f".{scan_file.NAME}", ".sigma.nii.gz"


@dataclass(frozen=True)
class Output:
    """Files of a reconstruction.

    Args:
        name: name of the run.
        folder: folder of the run.
        volume: file of the volume.
        unit: unit of the volume.
        like: the file whose order of axes the volume gets, if any.
    """

    name: str
    folder: Path
    volume: Path
    unit: str
    like: Path | None = None

    @classmethod
    def of(cls, settings: ReconstructSettings, folder: Path) -> "Output":
        """The files that settings ask for, which are writable and no input.

        Raises:
            ValueError: an ending without a writer; an output file that is an input in the settings.
            OSError: a path that cannot be written.
        """
        out = from_home(settings.out or folder / "volume.nii.gz")
        check_ending(out)
        check_writable(out)
        like = settings.grid.get("like")
        output = cls(settings.name, folder, out, settings.unit, like and from_home(like))
        written = [out, output.beside(SIGMA_ENDING), *(folder / name for name in PRODUCTS)]
        if settings.calibrate:
            written += [output.beside(RIG_ENDING), output.beside(SCAN_ENDING)]
        check_inputs({**vars(settings), "out": None}, written)
        return output

    def for_scan(self, scan: Scan) -> "Output":
        """The output in the unit of a scan, if the volume's file can hold it.

        Raises:
            ValueError: Hounsfield units for other than attenuation; what the file cannot hold.
            OSError: too little space.
        """
        if self.unit == "HU" and scan.unit != ATTENUATION:
            raise ValueError(f"Expected attenuation in 1/mm for the unit HU, got {scan.unit}")
        output = self if self.unit == "HU" else replace(self, unit=scan.unit)
        volume_writer(self.volume, scan.grid, output.unit, self.like)
        check_room(self.volume, BYTES_PER_VOXEL * math.prod(scan.grid.shape))
        return output

    def beside(self, ending: str) -> Path:
        """The file beside the volume with its name and another ending."""
        return self.volume.with_name(name_of(self.volume) + ending)

    def in_unit(self, values: Tensor) -> Tensor:
        """Values of a volume in the unit of the views per mm, in the unit of the output."""
        return hounsfield(values) if self.unit == "HU" else values

    def write(self, outcome: Outcome, grid: Grid) -> None:
        """Write the volume, and the standard deviation of its error where it is known.

        Raises:
            OSError: a file cannot be written; it is kept elsewhere, and the message says where.
        """
        volume, sigma = outcome.volume, outcome.sigma
        places = (self.folder, Path.cwd(), Path(gettempdir()))

        def write(path: Path) -> None:
            volume_writer(path, grid, self.unit, self.like)(self.in_unit(volume))

        written_or_kept(self.volume, write, places)
        if sigma is None:
            return
        if self.unit == "HU":  # half of the difference, as the scale bends at water
            sigma = (self.in_unit(volume + sigma) - self.in_unit(volume - sigma)) / 2
        written_or_kept(
            self.beside(SIGMA_ENDING),
            lambda path: save_volume(path, sigma, grid, like=self.like),
            places,
        )

    def percentiles(self, volume: Tensor) -> list[float]:
        """The 1st and the 99th percentile of a volume in the unit; of a large one, of every n-th
        voxel.
        """
        values = volume.flatten()[:: 1 + volume.numel() // 2**20].double()
        return self.in_unit(values.quantile(values.new_tensor([0.01, 0.99]))).tolist()
