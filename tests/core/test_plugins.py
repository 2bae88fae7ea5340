"""Installed plugins: duplicate names, and modules that fail to import."""

import pytest

from mvrecon.core.parts import PROJECTORS
from mvrecon.core.registry import Registry, import_plugins
from mvrecon.operators.drr import Drr
from tests.faults.plugins import plugin


def first(x: float = 1.0) -> float:
    return x


def second(x: float = 2.0) -> float:
    return x


def test_a_taken_name_keeps_its_part_and_both_are_named(tmp_path):
    registry = Registry("projector")
    registry.register("mine")(first)
    registry.register("mine")(first)  # the same anew
    with pytest.raises(LookupError, match="exists already: .*:first"):
        registry.register("mine")(second)
    assert registry.build("mine") == 1.0
    with (
        plugin(tmp_path, {"projector.twin": "json:loads"}),
        pytest.raises(LookupError, match="exists already: json:loads"),
    ):
        registry.register("twin")(first)


def test_two_plugins_with_one_name_are_refused_when_it_is_used_and_others_work(tmp_path):
    """Two installed plugins with a part of one name are refused when it is used, both named; other
    parts work.
    """
    registry = Registry("projector", text="json:dumps")
    with plugin(tmp_path / "a", {"projector.twin": "json:loads"}, name="a"):
        assert registry.build("twin", "1") == 1
        with plugin(tmp_path / "b", {"projector.twin": "json:dumps"}, name="b"):
            with pytest.raises(LookupError, match="json:dumps, json:loads"):
                registry.get("twin")
            assert registry.build("text", 1) == "1"


BROKEN = {
    "raises": ("1 / 0\n", "does not import: .*division"),
    "syntax": ("def (\n", "does not import: .*invalid syntax"),
    "missing": ("import no_such_module_anywhere\n", "does not import: No module named 'no_such"),
    "hollow": ("", "has no attribute 'Part'"),
    "exits": ("raise SystemExit(3)\n", "does not import"),
}
SOUND = "from mvrecon.operators.drr import Drr as Part\n"
HALF = (
    "from mvrecon.core.parts import PROJECTORS\n"
    "@PROJECTORS.register('half')\ndef half(): ...\n1 / 0\n"
)


def test_broken_plugins_affect_only_their_users_with_the_same_cause_each_time(tmp_path):
    """A plugin that fails to import is listed, reports the cause at each use, and affects no other
    part.
    """
    modules = {f"stressed_{name}": source for name, (source, _) in BROKEN.items()}
    modules |= {"stressed_sound": SOUND, "stressed_half": HALF}
    points = {f"projector.{name}": f"stressed_{name}:Part" for name in (*BROKEN, "sound")}
    with plugin(tmp_path, points, modules):
        assert {*BROKEN, "sound", "drr"} <= set(PROJECTORS.names())
        for _ in range(2):
            for name, (_, cause) in BROKEN.items():
                with pytest.raises(ImportError, match=cause):
                    PROJECTORS.get(name)
            with pytest.raises(ImportError, match="'stressed_half'.*division by zero"):
                import_plugins(["stressed_half"])
            assert "half" not in PROJECTORS.names()
        assert PROJECTORS.get("sound") is Drr
