"""Every built-in method keeps the contract."""

import pytest

from mvrecon.core.parts import CAMERAS, METHODS, PROJECTORS
from mvrecon.testing import check_method
from tests.methods.learned.rig import SMALL, small_projector, small_rig, stirred

OPTIONS = {
    **SMALL,
    **{name: {"iterations": 4} for name in ("fista_tv", "pdhg_tv", "mlem", "sirt", "tikhonov")},
    "robust_sirt": {"iterations": 6, "every": 2},
    "finer": {"method": {"name": "sirt", "iterations": 4}},
    "aligned": {"method": {"name": "sirt", "iterations": 3}, "alternations": 1, "iterations": 2},
    "uncertain": {"method": {"name": "world_unet", **SMALL["world_unet"]}},
}
#: Methods of parallel beams, and methods that name a file.
ELSEWHERE = {"fbp", "trained"}
NAMES = [
    name
    for name in METHODS.names()
    if METHODS.origin(name).startswith("mvrecon.") and name not in ELSEWHERE
]


@pytest.mark.parametrize("name", NAMES)
def test_built_in_methods_keep_the_contract(name):
    check_method(name, small_projector(), **OPTIONS.get(name, {}))


def test_parallel_beams_keep_the_contract_too():
    grid, _ = small_rig()
    cameras = CAMERAS.build("parallel", n_views=4, detector={"pixels": [12, 12], "pixel_mm": 3.0})
    A = PROJECTORS.build("radon", grid=grid, cameras=cameras)
    check_method("fbp", A)
    check_method("cross_view", A, **SMALL["cross_view"])


def test_a_mistyped_option_names_the_nearest_and_all():
    for name, typed, meant in (
        ("cross_view", "suport", "support"),
        ("mean_fusion", "consistancy", "consistency"),
        ("fdk", "cutof", "cutoff"),
        ("sirt", "nonegative", "nonnegative"),
        ("osem", "suport", "support"),
    ):
        with pytest.raises(TypeError, match=f"no option '{typed}'; did you mean '{meant}'"):
            stirred(name, **{typed: 1})
