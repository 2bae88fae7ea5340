"""`import mvrecon as mv`: every name is there, and nothing is imported before it is used."""

from pathlib import Path

import pytest
import torch

import mvrecon as mv

NAMES = sorted(set(dir(mv)) - {"__version__"})


def test_importing_mvrecon_imports_nothing_but_itself(run_python):
    code = (
        "import sys; before = set(sys.modules); import mvrecon; dir(mvrecon); "
        "new = {name for name in set(sys.modules) - before}; "
        "print(sorted(n for n in new if n.split('.')[0] not in sys.stdlib_module_names))"
    )
    assert run_python("-c", code).stdout == "['mvrecon']\n"


def test_a_volume_or_a_rig_imports_neither_training_libraries_nor_a_compiler(run_python):
    code = (
        "import sys, mvrecon as mv; mv.Grid, mv.circular, mv.Drr, mv.sirt, mv.read_volume; "
        "print(sorted({'lightning', 'hydra', 'torchmetrics', 'tensorboard', 'matplotlib', "
        "'torch._dynamo'} & set(sys.modules)))"
    )
    assert run_python("-c", code).stdout == "[]\n"


@pytest.mark.parametrize("name", NAMES)
def test_every_name_imports(name: str):
    value = getattr(mv, name)
    assert callable(value) and value.__doc__


def test_a_mistyped_name_names_the_nearest():
    with pytest.raises(AttributeError, match=r"no 'cirkular'; did you mean 'circular'\? Known: .*"):
        mv.cirkular  # noqa: B018
    with pytest.raises(ImportError):
        from mvrecon import cirkular  # noqa: F401


def test_submodules_do_not_shadow_names():
    from mvrecon import methods  # noqa: F401


@pytest.mark.parametrize("ending", [".nii", ".nii.gz", ".NII.GZ", ".mha", ".nrrd"])
def test_a_volume_round_trips_with_its_grid(ending: str, tmp_path: Path):
    pytest.importorskip("nibabel")
    grid = mv.Grid.centred(size=(5, 4, 3), spacing=(1.0, 1.5, 2.0), centre=(8.0, -4.0, 2.0))
    volume = torch.rand(3, 4, 5)
    mv.save_volume(str(tmp_path / f"a{ending}"), volume, grid)
    again, there = mv.read_volume(str(tmp_path / f"a{ending}"))
    assert torch.equal(again, volume)
    assert torch.allclose(there.affine, grid.affine, rtol=1e-6)


@pytest.mark.parametrize(
    ("path", "shape", "message"),
    [
        ("a.png", (3, 4, 5), r"a\.png: expected a volume whose name ends in \.nii or \.nii\.gz"),
        ("a.nii", (1, 1, 3, 4, 5), r"\[d h w\] of the grid's \(3, 4, 5\) .*got \(1, 1, 3, 4, 5\)"),
        ("a.nii", (5, 4, 3), r"of the grid's \(3, 4, 5\) voxels, got \(5, 4, 3\)"),
    ],
)
def test_a_volume_unsupported_by_file_or_grid_is_refused(path, shape, message, tmp_path: Path):
    grid = mv.Grid.centred(size=(5, 4, 3), spacing=1.0)
    with pytest.raises(ValueError, match=message):
        mv.save_volume(tmp_path / path, torch.zeros(shape), grid)
    assert not list(tmp_path.iterdir())


def test_an_unknown_file_extension_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match=r"expected a volume whose name ends in"):
        mv.read_volume(tmp_path / "a.png")
