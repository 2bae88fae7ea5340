"""A trained method as a program of torch.export."""

from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from typing import Any

import pytest
import torch

import mvrecon as mv
from mvrecon.apps.config import compose
from mvrecon.operators import torch_ops
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.program import exported
from mvrecon.training.trained import Trained, save_weights

#: Short, since each step of SIRT is written into the program.
SHORT = ("method.start=1", "method.consistency=1", "method.widths=[4,8]", "grid.size=[8,8,8]")
RIG = ("camera.n_views=3", "camera.detector.pixels=12", "camera.detector.pixel_mm=22")
#: The model's smaller networks, of one level.
NETWORKS = [f"method.{name}_widths=[4]" for name in ("depth", "weight", "ray")]


def method(*options: str) -> ReconstructionModule:
    """A method with weights that are none of a start's, so that every layer takes part."""
    settings = compose(*options, *SHORT, *RIG)
    geometry = {key: settings[key] for key in ("grid", "camera", "projector")}
    torch.manual_seed(0)
    module = ReconstructionModule(
        geometry, settings["method"], settings["loss"], settings["optimizer"], data_range=1.0
    ).eval()
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    return module


def views_of(module: ReconstructionModule) -> torch.Tensor:
    return module.projector(torch.rand(1, 1, *module.projector.grid.shape))


@pytest.fixture(scope="module")
def files(
    tmp_path_factory: pytest.TempPathFactory, run_example: Callable[..., dict[str, Any]]
) -> tuple[Path, Path, str]:
    """Weights, the program that the docstring's example makes of them, and the import that loads
    it.
    """
    assert torch_ops.ops is not None  # all of them are known to torch from here on
    folder = tmp_path_factory.mktemp("program")
    trained = Trained(method("method=world_unet"), seconds=0.0, steps=0)
    run = save_weights(trained, folder / "mine.safetensors")
    with chdir(folder):
        run_example(mv.save_program, views=views_of(trained.module))
    path, extra = folder / "mine.pt2", {"load.py": ""}
    torch.export.load(path, extra_files=extra)
    return run, path, extra["load.py"]


def test_a_program_has_the_volumes_of_the_cross_view_model():
    module = method("method=cross_view", "method.scale=1", *NETWORKS)
    program = exported(module.method, module.projector, torch.ones_like(views_of(module)))
    called = {str(node.target) for node in program.graph.nodes if node.op == "call_function"}
    assert {"mvrecon.project.default", "mvrecon.backproject.default"} <= called
    views = views_of(module)
    with torch.no_grad():
        expected = module(views).volume
        assert (program.module()(views) - expected).abs().max() <= 1e-6 * expected.max()
        assert expected.max() > 0


def test_a_program_in_a_file_has_the_volumes_of_its_method(
    files: tuple[Path, Path, str], tmp_path: Path
):
    run, path, _ = files
    program, module = torch.export.load(path), method("method=world_unet")
    views = views_of(module)
    expected = mv.load(run)(views)
    with torch.no_grad():
        assert (program.module()(views) - expected).abs().max() <= 1e-6 * expected.max()
    for path, batch, why in (("a.onnx", 1, ".pt2"), ("b.pt2", 0, "at least one")):
        with pytest.raises(ValueError, match=why):
            mv.save_program(run, tmp_path / path, batch=batch)


def test_a_program_has_the_import_that_loads_it_in_a_fresh_process(
    files: tuple[Path, Path, str], run_python
):
    """Without mvrecon's operators torch refuses the program, on a page of its own."""
    _, path, imports = files
    load = f"torch.export.load({str(path)!r})"
    without = f"import torch\ntry:\n    {load}\nexcept RuntimeError:\n    print('refused')\n"
    done = run_python("-c", without + imports + load)
    assert done.stdout == "refused\n" and "torch.ops.mvrecon" in done.stderr
    assert done.returncode == 0, done.stderr


def test_a_method_that_looks_at_its_views_is_not_exported():
    """A method whose steps depend on its views' values is not exported: the error says why."""
    module = method("method=world_unet", "method.support=hull")
    with pytest.raises(ValueError, match="no fixed sequence of steps.*support=none"):
        exported(module.method, module.projector, torch.ones_like(views_of(module)))
