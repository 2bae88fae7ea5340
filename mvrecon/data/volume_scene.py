"""A scene of volumes in files of their own, whatever their format."""

from dataclasses import dataclass
from pathlib import Path

from mvrecon.data.slabs import Slabs
from mvrecon.data.volume_files import name_of, open_volume, volumes_in
from mvrecon.data.volumes import FileScene
from mvrecon.geometry.grid import Grid


@dataclass(kw_only=True)
class Volumes(FileScene):
    """Volumes in world mm (RAS) as their files say: one NIfTI, MHA or NRRD file, a DICOM CT series,
    or a folder of them.

    The cases of a folder are its files and its folders of DICOM slices, sorted by name. Options:
    see `FileScene`.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self._paths: list[Path] | None = None

    @property
    def paths(self) -> list[Path]:
        """The volumes, sorted by name."""
        if self._paths is None:
            self._paths = volumes_in(self.path)
        return self._paths

    @property
    def length(self) -> int:
        """How many volumes there are."""
        return len(self.paths)

    def case(self, index: int) -> tuple[str, Slabs, Grid]:
        """Name, values and grid of a volume, its axes running roughly to RAS."""
        path = self.paths[index]
        return name_of(path), *open_volume(path)
