"""The registry reports errors, and a broken plugin affects only its users."""

from importlib.metadata import EntryPoint
from typing import TypedDict, Unpack

import pytest

from mvrecon.core import registry
from mvrecon.core.parts import REGISTRIES
from mvrecon.core.registry import Registry, importing


def ring(views: int = 8, radius: float = 400.0) -> tuple[int, float]:
    return views, radius


def dome(**anything: float) -> dict[str, float]:
    return anything


@pytest.fixture
def cameras(monkeypatch: pytest.MonkeyPatch) -> Registry:
    """Three cameras, whatever plugins are installed."""
    monkeypatch.setattr(registry, "installed", lambda: ())
    cameras = Registry("camera", text="json:dumps")
    cameras.register("ring")(ring)
    cameras.register("dome")(dome)
    return cameras


@pytest.fixture
def plugins(monkeypatch: pytest.MonkeyPatch):
    """Declares entry points as installed plugins would."""

    def declare(**points: str) -> None:
        found = tuple(
            EntryPoint(k.replace("__", "."), v, registry.GROUP) for k, v in points.items()
        )
        monkeypatch.setattr(registry, "installed", lambda: found)

    return declare


def test_a_part_is_built_from_its_name_and_options(cameras: Registry):
    assert cameras.build("ring", views=3) == (3, 400.0)
    assert cameras.from_config({"name": "ring", "radius": 5.0}, views=2) == (2, 5.0)
    assert cameras.build("dome", a=1.0) == {"a": 1.0}
    assert cameras.get("text")([1]) == "[1]"


class Shared(TypedDict, total=False):
    """Options that parts share."""

    radius: float


def arc(views: int, step: int = 1, /, **shared: "Unpack[Shared]") -> tuple[int, int, Shared]:
    return views, step, shared


@pytest.mark.parametrize("option", ["radios", "views", "step", "shared"])
def test_options_of_unpacked_records_are_known_by_name(cameras: Registry, option: str):
    """With annotations that are texts, as of `from __future__ import annotations`, any option was
    taken; arguments by position alone are no options.
    """
    cameras.register("arc")(arc)
    assert cameras.build("arc", 3, radius=5.0) == (3, 1, {"radius": 5.0})
    assert cameras.takes("arc", "radius") and not cameras.takes("arc", option)
    for act in (cameras.check, cameras.from_config):
        with pytest.raises(TypeError, match=f"'arc' has no option '{option}'"):
            act({"name": "arc", option: 1})


def test_an_unknown_name_reports_the_nearest_and_all(cameras: Registry):
    with pytest.raises(
        LookupError,
        match=r"No camera is named 'rng'; did you mean 'ring'\? Known: dome, ring, text",
    ):
        cameras.build("rng")
    with pytest.raises(LookupError, match=r"No camera is named 'xyzzy'\. Known: dome, ring, text"):
        cameras.origin("xyzzy")


@pytest.mark.parametrize("kind", REGISTRIES)
def test_a_misspelt_part_reports_the_nearest(kind: str):
    """The misspelt name of a part is refused with the nearest one."""
    name = REGISTRIES[kind].names()[0]
    with pytest.raises(LookupError, match=f"did you mean '{name}'"):
        REGISTRIES[kind].build(name[:-2] + name[:-3:-1])  # the last two letters swapped


@pytest.mark.parametrize(
    ("kind", "name", "option", "nearest"),
    [("projector", "drr", "methd", "method"), ("scene", "ellipsoids", "valeu", "value")],
)
def test_a_misspelt_option_of_a_part_reports_the_nearest(
    kind: str, name: str, option: str, nearest: str
):
    """The misspelt option of a part is refused with the nearest one."""
    with pytest.raises(TypeError, match=f"'{option}'; did you mean '{nearest}'"):
        REGISTRIES[kind].build(name, **{option: 1})


def test_an_unknown_option_reports_the_nearest_and_all(cameras: Registry):
    with pytest.raises(
        TypeError, match=r"'ring' has no option 'view'; did you mean 'views'\? Known: radius, views"
    ):
        cameras.build("ring", view=3)


def test_a_config_without_a_name_is_reported(cameras: Registry):
    with pytest.raises(TypeError, match=r"a 'name' .*camera\.name=.* got only \['views'\]"):
        cameras.from_config({"views": 3})


def test_a_name_instead_of_a_mapping_is_explained(cameras: Registry):
    with pytest.raises(TypeError, match=r"got 'circular'; .* camera@<place>=circular"):
        cameras.check("circular")


def test_a_taken_name_is_refused(cameras: Registry, plugins):
    with pytest.raises(
        LookupError, match="exists already: test_registry:ring|exists already: .*ring"
    ):
        cameras.register("ring")(dome)
    plugins(camera__ring="other.module:Ring")
    with pytest.raises(
        LookupError, match="2 parts of kind 'camera' are named 'ring'.*other.module:Ring"
    ):
        cameras.get("ring")


def test_a_redefined_part_replaces_itself(cameras: Registry):
    def again(views: int = 9, radius: float = 1.0) -> tuple[int, float]:
        return views, radius

    again.__module__, again.__qualname__ = ring.__module__, ring.__qualname__
    cameras.register("ring")(again)
    assert cameras.build("ring") == (9, 1.0)


def test_two_plugins_with_one_name_are_refused_but_one_seen_twice_is_not(
    cameras: Registry, monkeypatch
):
    first, second = (
        EntryPoint("camera.spect", f"json:{name}", registry.GROUP) for name in ("dumps", "loads")
    )
    monkeypatch.setattr(registry, "installed", lambda: (first, second))
    with pytest.raises(LookupError, match="named 'spect': json:dumps, json:loads"):
        cameras.get("spect")
    monkeypatch.setattr(registry, "installed", lambda: (first, first))
    assert cameras.get("spect")(1) == "1"


def test_a_plugin_is_found_only_under_its_kind(cameras: Registry, plugins):
    plugins(camera__json="json:dumps", projector__other="json:loads", conf__x="json")
    assert cameras.names() == ["dome", "json", "ring", "text"]
    assert cameras.build("json", [1]) == "[1]"


def test_a_broken_plugin_affects_only_its_users(cameras: Registry, plugins):
    plugins(camera__broken="no_such_module_anywhere:Camera", camera__hollow="json:NoSuchClass")
    assert "broken" in cameras.names()
    assert cameras.build("ring") == (8, 400.0)
    assert cameras.origin("broken") == "no_such_module_anywhere:Camera"
    with pytest.raises(
        ImportError,
        match=r"camera 'broken' \(no_such_module_anywhere:Camera\) does not import: No mod",
    ):
        cameras.get("broken")
    with pytest.raises(ImportError, match="camera 'hollow' .* has no attribute 'NoSuchClass'"):
        cameras.get("hollow")


def test_a_plugin_that_fails_registers_none_of_its_parts(cameras: Registry):
    for error in (ValueError("no"), SystemExit(3)):
        with (
            pytest.raises(ImportError, match="The plugin does not import: (no|3)"),
            importing("The plugin"),
        ):
            cameras.register("half")(dome)
            cameras.register("ring")(ring)
            raise error
        assert cameras.names() == ["dome", "ring", "text"] and cameras.get("ring") is ring


@pytest.mark.parametrize(
    ("kind", "name"), [(k, n) for k, r in REGISTRIES.items() for n in r.names()]
)
def test_every_part_imports_and_is_documented(kind: str, name: str):
    part = REGISTRIES[kind].get(name)
    assert callable(part)
    assert (part.__doc__ or "").strip()
