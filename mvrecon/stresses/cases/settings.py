"""Settings that do not fit, plugins that do not work, and configs and checkpoints that were made to harm."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from mvrecon.config import import_plugins, instantiate
from mvrecon.engine.checkpoints import finished, load, unfinished
from mvrecon.geometry.grid import Grid
from mvrecon.limits import Refused, yaml_of
from mvrecon.parts import MODELS, PROJECTORS, REGISTRIES, SCENES
from mvrecon.projectors.drr import Drr
from mvrecon.registry import Registry
from mvrecon.stresses.apart import apart, python
from mvrecon.stresses.case import once
from mvrecon.stresses.compositions import Wrong, compositions
from mvrecon.stresses.refusals import none_of, refusal
from mvrecon.stresses.samples import RIG, checkpoint
from mvrecon.stresses.subject import GRID, Subject, rig_about
from mvrecon.testing import check_projector, hostile
from mvrecon.testing.plugins import plugin


@cache
def composed() -> Mapping[str, Wrong]:
    """What configs did that should have been refused, in a process where no Hydra is running; once for all cases."""
    with TemporaryDirectory() as folder:
        return apart(compositions, Path(folder))


def mismatches(subject: Subject) -> float:
    """Grid, rig, volumes, views and models that do not fit: an error that says what was got and what was expected."""
    A = PROJECTORS.build("drr", grid=GRID, cameras=rig_about(GRID))
    model = MODELS.build("backprojection", projector=A)
    ones: Tensor = torch.ones(1, 1, *GRID.shape)
    views = A(ones)
    scenes = {"train": {"name": "ellipsoids"}, "test": {"name": "ellipsoids", "value": 0.5}}
    acts: dict[str, tuple[Any, str]] = {
        "two axes": (lambda: Grid.centred((8, 8), 1.0), r"three positive sizes \(z, y, x\), got \(8, 8\)"),
        "no voxels": (lambda: Grid.centred((8, 0, 8), 1.0), r"got \(8, 0, 8\)"),
        "negative spacing": (lambda: Grid.centred((8, 8, 8), (1.0, -1.0, 1.0)), "positive.* mm, got"),
        "NaN spacing": (lambda: Grid.centred((8, 8, 8), torch.nan), "positive.* mm, got"),
        "axes x, y, z": (lambda: A(ones.mT.transpose(2, 4)), r"\(5, 6, 7\), got \(1, 1, 6, 7, 5\)|got \(1, 1"),
        "no batch": (lambda: A(ones[0, 0]), r"\[b c d h w\].*got \(5, 6, 7\)"),
        "complex values": (lambda: A(ones.to(torch.complex64)), "floating point, got torch.complex64"),
        "a view too few": (lambda: A.T(views[:, :, 1:]), r"\(3, 6, 5\), got \(1, 1, 2, 6, 5\)"),
        "columns for rows": (lambda: A.T(views.mT), r"\(3, 6, 5\), got \(1, 1, 3, 5, 6\)"),
        "views of another rig": (lambda: model(views[..., :-1, :]), r"\(3, 6, 5\), got \(1, 1, 3, 5, 5\)"),
        "a support of another grid": (lambda: A.with_support(torch.ones(5, 6, 8) > 0), "5, 6, 8"),
        "scenes of two ranges": (lambda: _data(scenes), "share their data_range, got .*train.*test"),
        "a set that is none": (lambda: _data({}, tset=3), "train, val and test; missing or unknown: tset"),
    }
    wrong = {name: refusal(act, saying, (ValueError, TypeError)) for name, (act, saying) in acts.items()}
    return none_of({**wrong, **composed()["missing"]})


def _data(scenes: dict[str, Any], **sizes: int) -> Any:
    from mvrecon.data.module import SceneData

    one = {"name": "ellipsoids"}
    grid = {"shape": [4, 4, 4], "spacing": 4.0}
    return SceneData({"train": one, "test": one, **scenes}, grid, RIG, {"train": 1, "val": 1, "test": 1, **sizes})


def typing_mistakes(subject: Subject) -> float:
    """A name, an option or a key that is misspelt is an error with the nearest one."""
    wrong = dict(composed()["misspelt"])
    for kind, registry in REGISTRIES.items():
        name = registry.names()[0]
        near = name + name[-1]  # the last letter twice: two that are swapped may be the same
        wrong[f"{kind} {near}"] = refusal(lambda r=registry, n=near: r.build(n), f"did you mean '{name}'", LookupError)
    calls: dict[str, tuple[Any, str]] = {
        "projector": (lambda: PROJECTORS.build("drr", methd="joseph"), "'methd'; did you mean 'method'"),
        "scene": (lambda: SCENES.build("ellipsoids", valeu=1), "'valeu'; did you mean 'value'"),
        "no name": (lambda: MODELS.from_config({"nme": "sirt"}), r"needs a 'name', got only \['nme'\]"),
    }
    wrong |= {f"option of a {name}": refusal(act, saying, TypeError) for name, (act, saying) in calls.items()}
    return none_of(wrong)


def first(x: float = 1.0) -> float:
    """A part."""
    return x


def second(x: float = 2.0) -> float:
    """Another part."""
    return x


def names_taken_twice(subject: Subject) -> float:
    """Two parts of one name are an error that names both; one that is defined anew takes its own place."""
    registry = Registry("projector", text="json:dumps")
    registry.register("mine")(first)
    registry.register("mine")(first)
    wrong = {
        "in a script": refusal(lambda: registry.register("mine")(second), "exists already: .*:first", LookupError),
        "the first is still there": "" if registry.build("mine") == 1.0 else "it was replaced",
    }
    with TemporaryDirectory() as folder, plugin(Path(folder) / "a", {"projector.twin": "json:loads"}, name="a"):
        wrong["a plugin's"] = refusal(
            lambda: registry.register("twin")(first), "exists already: json:loads", LookupError
        )
        wrong["alone"] = "" if registry.build("twin", "1") == 1 else "it is not found"
        with plugin(Path(folder) / "b", {"projector.twin": "json:dumps"}, name="b"):
            wrong["two plugins'"] = refusal(lambda: registry.get("twin"), "json:dumps, json:loads", LookupError)
            wrong["others"] = "" if registry.build("text", 1) == "1" else "others do not work"
    return none_of(wrong)


BROKEN = {
    "raises": ("1 / 0\n", "does not import: .*division"),
    "syntax": ("def (\n", "does not import: .*invalid syntax"),
    "missing": ("import no_such_module_anywhere\n", "does not import: No module named 'no_such"),
    "hollow": ("", "has no attribute 'Part'"),
    "exits": ("raise SystemExit(3)\n", "does not import"),
}


def broken_plugins(subject: Subject) -> float:
    """Plugins that cannot be imported disturb nobody but who asks for them, each time with the same cause."""
    points = {f"projector.{name}": f"stressed_{name}:Part" for name in BROKEN}
    points["projector.sound"] = "stressed_sound:Part"
    modules = {f"stressed_{name}": source for name, (source, _) in BROKEN.items()}
    modules["stressed_sound"] = "from mvrecon.projectors.drr import Drr as Part\n"
    modules["stressed_half"] = (
        "from mvrecon.parts import PROJECTORS\n@PROJECTORS.register('half')\ndef half(): ...\n1 / 0\n"
    )
    wrong: Wrong = {}
    with TemporaryDirectory() as folder, plugin(Path(folder), points, modules):
        listed = set(BROKEN) | {"sound", "drr"} <= set(PROJECTORS.names())
        wrong["all are listed"] = "" if listed else f"only {PROJECTORS.names()}"
        for turn in ("first", "second"):
            for name, (_, saying) in BROKEN.items():
                wrong[f"{name}, {turn} time"] = refusal(lambda name=name: PROJECTORS.get(name), saying, ImportError)
            wrong[f"half registered, {turn} time"] = refusal(
                lambda: import_plugins(["stressed_half"]), "'stressed_half'.*division by zero", ImportError
            )
            wrong[f"its half is gone, {turn} time"] = "it stays" if "half" in PROJECTORS.names() else ""
        wrong["the sound one works"] = "" if PROJECTORS.get("sound") is Drr else "it does not"
    return none_of(wrong)


class Misshapen(Drr):
    """Loses a column."""

    def forward(self, volume: Tensor) -> Tensor:
        return super().forward(volume)[..., :-1]


class Widened(Drr):
    """Gives float64 for float32."""

    def forward(self, volume: Tensor) -> Tensor:
        return super().forward(volume).double()


class Spoiled(Drr):
    """Gives NaN in one pixel."""

    def forward(self, volume: Tensor) -> Tensor:
        views = super().forward(volume)
        views[0, 0, 0, 0, 0] = torch.nan
        return views


class Unmatched(Drr):
    """Has an adjoint that is a thousandth too large."""

    def adjoint(self, views: Tensor) -> Tensor:
        return 1.001 * super().adjoint(views)


class Mistaken:
    """Is no projector at all."""

    def __init__(self, grid: Grid, cameras: Any):
        self.grid, self.cameras = grid, cameras


BAD = {
    Misshapen: "views are .*, expected",
    Widened: "float32 volumes are torch.float64",
    Spoiled: "views of a finite volume are not finite",
    Unmatched: "<A x, y> and <x, A.T y> differ by .* in torch",
    Mistaken: "not callable",
}


def bad_projectors(subject: Subject) -> float:
    """`check_projector` tells a projector's fault by its name, and finds none in a sound one."""
    points = {f"projector.{part.__name__.lower()}": f"{__name__}:{part.__name__}" for part in BAD}
    wrong, rig = {}, rig_about(GRID)
    with TemporaryDirectory() as folder, plugin(Path(folder), points):
        for part, saying in BAD.items():
            name = part.__name__.lower()
            wrong[name] = refusal(
                lambda name=name: check_projector(name, GRID, rig, gradients=False),
                saying,
                (AssertionError, TypeError),
            )
        check_projector("drr", GRID, rig, gradients=False)
    return none_of(wrong)


def evil_checkpoints(subject: Subject) -> float:
    """Checkpoints that would run something if they were unpickled, or import what they name."""
    kept = checkpoint()
    archive, wrong = hostile.saved(kept), {}
    with TemporaryDirectory() as folder:
        path, sentinel = Path(folder) / "evil.ckpt", Path(folder) / "sentinel"

        def loaded(raw: bytes) -> None:
            path.write_bytes(raw)
            load(path)

        for name, pickle in hostile.pickles(sentinel).items():
            for how, raw in (("in an archive", hostile.with_pickle(archive, pickle)), ("alone", pickle)):
                saying = r"evil\.ckpt: (its pickle names|is cut short or no checkpoint)"
                wrong[f"{name}, {how}"] = refusal(lambda raw=raw: loaded(raw), saying, Refused)
        for name, extra in hostile.SETTINGS.items():
            raw = hostile.saved({**kept, "hyper_parameters": {**kept["hyper_parameters"], **extra}})
            wrong[name] = refusal(lambda raw=raw: loaded(raw), "expected names and numbers", Refused)
        named = {**kept["hyper_parameters"], "model": {"name": "os.system"}}
        raw = hostile.saved({**kept, "hyper_parameters": named})
        wrong["a part that is none"] = refusal(lambda: loaded(raw), "No model is named 'os.system'", Refused)
        for name in ("../../evil", "/etc/evil", ".."):
            for place in (finished, unfinished):
                wrong[f"{place.__name__} {name}"] = refusal(lambda p=place, n=name: p(path.parent, n), "has the name")
        wrong["the sentinel"] = "something ran" if sentinel.exists() else ""
    return none_of(wrong)


def evil_configs(subject: Subject) -> float:
    """Configs that name what runs something, tell Hydra what to do, lead elsewhere, or unfold to a mountain."""
    wrong = dict(composed()["hostile"])
    with TemporaryDirectory() as folder:
        path, sentinel = Path(folder) / "evil.yaml", Path(folder) / "sentinel"
        sentinel.with_name("payload.ckpt").write_bytes(hostile.saved(hostile.Payload(f"touch {sentinel}")))
        for name, node in hostile.targets(sentinel).items():
            wrong[name] = refusal(lambda node=node: instantiate(node), "not allowed; expected", PermissionError)
        for text, saying in ((hostile.BOMB, "unfolds"), ("a: &a [*a]", "unfolds"), ("x: " + "[" * 10_000, "not YAML")):
            path.write_text(text)
            wrong[f"{text[:20]!r}"] = refusal(lambda: yaml_of(path), rf"evil\.yaml: .*{saying}")
        with path.open("wb") as file:
            file.truncate(2**30)  # a hole: a gigabyte on no disk
        wrong["a gigabyte"] = refusal(lambda: yaml_of(path), "is larger than")
        for module in ("os", "lightning.pytorch.cli", "no_such_module", "a b", ".x"):
            wrong[f"the plugin {module}"] = refusal(
                lambda module=module: import_plugins([module]), "own source imports mvrecon", PermissionError
            )
        wrong["the sentinel"] = "something ran" if sentinel.exists() else ""
    return none_of(wrong)


def foreign_places(subject: Subject) -> float:
    """`mvrecon-simulate` in the locale C, in a folder with spaces and letters of other scripts, its HOME no folder."""
    with TemporaryDirectory() as base:
        here, out = Path(base) / "où ça", Path(base) / "ausgabe für 目录"
        here.mkdir()
        home = Path(base) / "home"
        home.touch()
        tiny = ("grid.shape=[4,4,4]", "camera.views=1", "camera.detector.pixels=[4,4]", "cases=[0]")
        done = python(
            *("-m", "mvrecon.simulate", *tiny, f"hydra.run.dir='{out}'"),
            cwd=here,
            env={"HOME": str(home), "LC_ALL": "C", "LANG": "C", "PYTHONIOENCODING": "ascii"},
        )
        kept = sorted(file.name for file in out.rglob("views.h5"))
        left = [file.name for file in here.iterdir()]
    if done.returncode or kept != ["views.h5"] or left:
        raise AssertionError(f"exit {done.returncode}, {kept} kept, {left} in the folder: {done.stderr[-300:]}")
    return 0.0


CASES = (
    once(57, "grids, rigs and volumes that do not fit", "refused, with both sides told", mismatches),
    once(58, "misspelt names, options and keys", "refused, with the nearest one", typing_mistakes),
    once(59, "names that are taken", "refused, with both parts named", names_taken_twice),
    once(60, "plugins that do not import", "told on use, each time alike; others work", broken_plugins),
    once(61, "projectors that break their contract", "told by check_projector", bad_projectors),
    once(71, "checkpoints made to harm", "refused, and nothing runs", evil_checkpoints),
    once(72, "configs made to harm", "refused, and nothing runs", evil_configs),
    once(79, "foreign places", "an app works", foreign_places),
)
