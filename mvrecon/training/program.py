"""A trained method as a program of `torch.export`."""

import io
import warnings
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.files.atomic import written_whole
from mvrecon.operators.operator import Projector
from mvrecon.training.trained import load


class Volume(nn.Module):
    """A method on one operator, which maps views to the volume in the unit of (views / mm)."""

    def __init__(self, method: nn.Module, A: Projector):
        super().__init__()
        self.method, self.A = method, A

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b 1 d h w"]:
        return self.method(views, self.A).volume


def exported(
    method: nn.Module, A: Projector, views: Float[Tensor, "b 1 m v u"]
) -> "torch.export.ExportedProgram":
    """Export a method as a program that maps views to the volume in the unit of (views / mm).

    It is for this number of samples, rig and grid, and does not check that views are finite. Its
    projections are mvrecon's own operators (`torch.ops.mvrecon`): import
    `mvrecon.operators.torch_ops` before loading it.

    Args:
        method: a method in evaluation mode.
        A: the operator.
        views: example of the program's shape, dtype and device, with any values.

    Raises:
        ValueError: a method whose steps depend on the values of its views, as with a support from
            these, or that recomputes filters or geometry in each call.
    """
    try:
        with torch.no_grad(), warnings.catch_warnings():
            # an operator's last plan, which is not part of the program
            warnings.filterwarnings("ignore", "The tensor attribute .* was assigned during export")
            method(views, A)  # caches its geometry with A, as a constant of the program
            return torch.export.export(Volume(method, A), (views,), strict=False)
    except RuntimeError as error:  # several classes of torch
        why = str(error).strip().partition("\n")[0]
        raise ValueError(
            f"{type(method).__name__} is no fixed sequence of steps, which torch.export asks for "
            f"(expected a network without a support from the views, such as cross_view with "
            f"support=none): {why}"
        ) from error


#: File in a program's archive, `extra/load.py`, that says what torch's error does not.
LOAD_TEXT = """# The program calls mvrecon's operators: import them before torch.export.load.
import mvrecon.operators.torch_ops  # registers torch.ops.mvrecon
"""


def save_program(
    run: str | Path, path: str | Path, method: str | None = None, batch: int = 1
) -> Path:
    """Write a trained method as a program of `torch.export` for its own rig and grid in mm; returns
    the file's path.

    The archive's `extra/load.py` has the import that must precede `torch.export.load`.

    Args:
        run: see `path` of `mvrecon.load`.
        path: path of the file, which ends with .pt2; `torch.export.load` reads it.
        method: label of the method in the run's table; None: the run's main method.
        batch: number of samples per call.

    Returns:
        The path of the file.

    Raises:
        ValueError: another ending, fewer than one sample, a method that does not export (see
            `exported`); and as `mvrecon.load`.

    Examples:
        >>> path = mv.save_program("mine.safetensors", "mine.pt2")  # weights of `mv.save_weights`
        >>> import mvrecon.operators.torch_ops  # registers the operators that the program calls
        >>> program = torch.export.load(path).module()
        >>> volume = program(views)
    """
    path = Path(path).expanduser()
    if path.suffix != ".pt2":
        raise ValueError(f"Expected a file .pt2, got {path}")
    if batch < 1:
        raise ValueError(f"Expected a batch of at least one sample, got {batch}")
    module = load(run, method).module
    A = module.projector
    program = exported(module.method, A, torch.ones(batch, 1, *A.range_shape))
    whole = io.BytesIO()
    torch.export.save(program, whole, extra_files={"load.py": LOAD_TEXT})
    with written_whole(path) as part:
        part.write_bytes(whole.getbuffer())
    return path
