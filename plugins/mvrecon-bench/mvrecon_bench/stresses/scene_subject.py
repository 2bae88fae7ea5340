"""A registered scene under stress, on a small grid and rig."""

import inspect
from functools import cached_property
from typing import Any

from mvrecon.core.parts import SCENES
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.testing.scene import GRID, RIG
from mvrecon_bench.stresses.case import DoesNotApply
from mvrecon_bench.stresses.subject import Subject

#: Seed of the tested series of cases.
SEED = 3
#: Options that replace defaults with details finer than the grid.
COARSER = {"well_diameters": [14, 13, 12, 11, 10, 9]}


class SceneSubject(Subject):
    """A scene under stress, with defaults for all options that the user does not set."""

    def scene(self) -> Scene:
        """Build a new scene.

        Raises:
            DoesNotApply: a required option is missing, such as the path of a file.
        """
        parameters = inspect.signature(SCENES.get(self.name)).parameters
        for name, parameter in parameters.items():
            has_value = name in self.options or parameter.default is not parameter.empty
            if not has_value and parameter.kind not in (
                parameter.VAR_POSITIONAL,
                parameter.VAR_KEYWORD,
            ):
                raise DoesNotApply(
                    f"it needs {name}; stress it as {{kind: scene, name: {self.name}, {name}: ..}}"
                )
        return self.build(**self.coarser)

    @cached_property
    def coarser(self) -> dict[str, Any]:
        """The options in `COARSER` that the scene has and the user does not set."""
        parameters = inspect.signature(SCENES.get(self.name)).parameters
        return {key: v for key, v in COARSER.items() if key in set(parameters) - set(self.options)}

    @cached_property
    def used(self) -> Scene:
        """A shared scene, for cases that do not require a new one."""
        return self.scene()

    def case(self, index: int = 0, cameras: Cameras = RIG, scene: Scene | None = None) -> Sample:
        """A case of the series, with grid and rig of `mvrecon.testing.check_scene`.

        Raises:
            DoesNotApply: the scene does not support the grid, for example because of its fixed
                size.
        """
        try:
            return (scene or self.used).sample(index, SEED, GRID, cameras)
        except ValueError as error:
            if "grid" not in str(error):
                raise
            raise DoesNotApply(f"it refuses the plan's grid: {error}") from error

    def need_whole(self) -> None:
        """Raise DoesNotApply unless the object is inside the grid."""
        inner = self.case().inside[0, 1:-1, 1:-1, 1:-1]
        if self.case().inside.sum() > inner.sum():
            raise DoesNotApply("its object reaches beyond the plan's grid of 120 mm")

    def need_two(self) -> None:
        """Raise DoesNotApply unless the scene has a second case."""
        if self.used.length == 1:
            raise DoesNotApply("it has one case")
