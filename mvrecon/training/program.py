"""A trained method as a program of `torch.export`: its steps and weights, without its classes."""

import io
import warnings
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.export import ExportedProgram

from mvrecon.core.files.atomic import written_whole
from mvrecon.operators.operator import Projector
from mvrecon.training.trained import load

#: Ending of such files, as torch has it.
ENDING = ".pt2"


class Volume(nn.Module):
    """A method on one operator, from views to the volume in the unit of (views / mm)."""

    def __init__(self, method: nn.Module, A: Projector):
        super().__init__()
        self.method, self.A = method, A

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b 1 d h w"]:
        return self.method(views, self.A).volume


def exported(method: nn.Module, A: Projector, views: Float[Tensor, "b 1 m v u"]) -> ExportedProgram:
    """The program that a method runs, from views to the volume in the unit of (views / mm).

    It is for this number of samples, this rig and this grid, and does not check that its views are
    finite. Its projections are mvrecon's own operators (`torch.ops.mvrecon`): who loads it must
    have imported `mvrecon.operators.torch_ops`.

    Args:
        method: in evaluation, as `eval()` leaves it.
        A: the operator.
        views: of the shape, dtype and device that the program shall take; of any values.

    Raises:
        ValueError: a method whose steps depend on the values of its views, as with a support told
            from them, or which makes its filters or its geometry anew for each call.
    """
    try:
        with torch.no_grad(), warnings.catch_warnings():
            # an operator's last plan, which is no part of the program
            warnings.filterwarnings("ignore", "The tensor attribute .* was assigned during export")
            method(views, A)  # its geometry, which is kept beside A, is a constant of the program
            return torch.export.export(Volume(method, A), (views,), strict=False)
    except RuntimeError as error:  # of many classes, all of them torch's
        why = str(error).strip().partition("\n")[0]
        raise ValueError(
            f"{type(method).__name__} is no fixed sequence of steps, which torch.export asks for "
            f"(expected a network without a support from the views, such as cross_view with "
            f"support=none): {why}"
        ) from error


def save_program(
    run: str | Path, path: str | Path, method: str | None = None, batch: int = 1
) -> Path:
    """Write a trained method as a program of `torch.export` for its own rig and grid in mm; returns
    the file's path.

    Args:
        run: as the `path` of `mvrecon.load`.
        path: of the file, which ends with .pt2; `torch.export.load` reads it.
        method: its label in the run's table; None: the run's main method.
        batch: how many samples the program takes at once.

    Raises:
        ValueError: another ending, fewer than one sample, a method that cannot be exported (see
            `exported`); what `mvrecon.load` raises.
    """
    path = Path(path).expanduser()
    if path.suffix != ENDING:
        raise ValueError(f"Expected a file {ENDING}, got {path}")
    if batch < 1:
        raise ValueError(f"Expected a batch of at least one sample, got {batch}")
    module = load(run, method).module
    A = module.projector
    program = exported(module.method, A, torch.ones(batch, 1, *A.range_shape))
    whole = io.BytesIO()
    torch.export.save(program, whole)
    with written_whole(path) as part:
        part.write_bytes(whole.getbuffer())
    return path
