"""One reconstruction of a measured scan: the method, its time and memory."""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from inspect import signature
from typing import Any, TypedDict

import torch
from jaxtyping import Float
from numba.core.event import TimingListener, install_listener
from torch import Tensor, nn

from mvrecon.apps.progress import Bar
from mvrecon.apps.scan import Scan
from mvrecon.core.files.checks import Refused
from mvrecon.core.machine import peak
from mvrecon.core.options import parts_in
from mvrecon.core.parts import MethodPart
from mvrecon.core.quantities import PositiveInt
from mvrecon.data.attenuation import CONCENTRATION
from mvrecon.methods.classical import stopping
from mvrecon.methods.classical.solver import Iterate
from mvrecon.methods.method import Solver, build_method, check_volume

#: Views that a streamed method's volume is compared with, at most; pixels of these at a time.
COMPARED_VIEWS, COMPARED_PIXELS = 40, 2**24


@dataclass
class Outcome:
    """A reconstruction.

    Args:
        volume: reconstructed volume, in the unit of the views per mm.
        seconds: run time of the method in s, without the compilation of kernels.
        peak_bytes: most memory of the process so far; None if the system does not report it.
        residuals: |y - A x| after each iteration, in the unit of the views; empty for a method
            that does not iterate.
        chosen: iterations and weight chosen on left-out views.
        view_nrmse: |y - A x| / |y| over the measured pixels; NaN for views of zero.
        compared_views: number of the views that it is of, at equal steps; None: of all.
        sigma: standard deviation of each voxel's error, if the method estimates it.
        camera_weights: weight of each camera, sum one; empty without weights.
        lost: numbers of the views that are zero everywhere.
        stopped: the iteration after which Ctrl-C ended the method; None: it finished.
    """

    volume: Float[Tensor, "d h w"]
    seconds: float = 0.0
    peak_bytes: int | None = None
    view_nrmse: float = math.nan
    compared_views: int | None = None
    residuals: list[float] = field(default_factory=list)
    chosen: dict[str, Any] = field(default_factory=dict)
    sigma: Float[Tensor, "d h w"] | None = None
    camera_weights: list[float] = field(default_factory=list)
    lost: list[int] = field(default_factory=list)
    stopped: int | None = None

    def row(self) -> dict[str, Any]:
        """All but volumes, for `results.json`."""
        volumes = ("volume", "sigma")
        return {name: value for name, value in vars(self).items() if name not in volumes}


class Choose(TypedDict, total=False):
    """Settings of `stopping.held_out`, which chooses on left-out views.

    Args:
        every: one view in so many is left out.
        weights: values of the method's option `weight` to choose from.
        patience: iterations without improvement that end a trial.
    """

    every: PositiveInt
    weights: Sequence[float] | None
    patience: PositiveInt


@dataclass(frozen=True, eq=False)
class Method:
    """A method with the rules that end it.

    Args:
        name: name of the method.
        module: method f(views, A).
        stop_sigma: standard deviation of the line integrals' noise: an iterative method stops
            where it explains the residual; None: no such rule.
        choose: chooses iterations and weight on left-out views; None: no choice.

    Raises:
        ValueError: a stopping rule or choice for a method that does not iterate.
    """

    name: str
    module: nn.Module
    stop_sigma: float | None = None
    choose: Choose | None = None

    def __post_init__(self) -> None:
        if self.stop_sigma is not None and not math.isfinite(self.stop_sigma):
            raise ValueError(
                f"stop.sigma: expected a finite standard deviation, got {self.stop_sigma}"
            )
        if (self.choose or self.stop_sigma is not None) and not self.declares("iterates"):
            raise ValueError(
                f"{self.name} does not iterate: expected choose=null and stop.sigma=null"
            )
        if self.choose and self.choose.get("every", 2) < 2:
            raise ValueError(f"choose.every: expected at least 2, got {self.choose['every']}")
        weighed = (
            isinstance(self.module, Solver) and "weight" in signature(self.module.solve).parameters
        )
        if self.choose and self.choose.get("weights") and not weighed:
            raise ValueError(
                f"choose.weights: {self.name} has no option weight; leave out choose.weights"
            )

    @classmethod
    def of(
        cls, method: MethodPart, stop_sigma: float | None = None, choose: Choose | None = None
    ) -> "Method":
        """Build a method before any view is read.

        Args:
            method: name and options.
            stop_sigma, choose: see `Method`.

        Raises:
            LookupError, TypeError: no such method, or no such option of it.
            ImportError, OSError: its module does not import, or its weights cannot be read.
            ValueError: as the class; what the method raises.
        """
        module = build_method(method)
        if any(node.get("name") == "trained" for _, _, node in parts_in(method, MethodPart)):
            # Lightning's import takes seconds
            from mvrecon.training.trained import check_trained

            check_trained([method])
        return cls(method["name"], module, stop_sigma, choose)

    def check_scatter(self) -> None:
        """Raise Refused for a method that does not take expected scatter."""
        solver = self.module
        takes = isinstance(solver, Solver) and "background" in signature(solver.solve).parameters
        if not takes:
            raise Refused(
                f"expected a method with a background for scatter, such as osem, got {self.name}"
            )

    def declares(self, what: str) -> Any:
        """What a classical method declares of itself, such as that it iterates; else None."""
        return getattr(self.module.solve, what, None) if isinstance(self.module, Solver) else None


def run_method(scan: Scan, method: Method, device: str, bar: Bar) -> Outcome:
    """Reconstruct a scan. Ctrl-C ends an iterative method with its last iterate.

    Raises:
        ValueError: what the method raises.
        KeyboardInterrupt: Ctrl-C before the first iterate, or in a method that does not iterate.
    """
    iterates, streamed = method.declares("iterates"), method.declares("streamed")
    run = _iterated if iterates else _streamed if streamed else _direct
    start = time.perf_counter()
    with install_listener("numba:compile", TimingListener()) as compiling:
        outcome, misfit = run(scan, method, device, bar)
    seconds = time.perf_counter() - start - (compiling.duration if compiling.done else 0)
    volume = outcome.volume.cpu()
    return replace(outcome, volume=volume, seconds=seconds, peak_bytes=peak(), view_nrmse=misfit())


#: What a run leaves, and |y - A x| / |y|, which is computed without the method's time.
_Run = tuple[Outcome, Callable[[], float]]


class _RunMonitor:
    """A monitor of one run after the other: moves the bar, and keeps the last run's curve and
    volume.
    """

    def __init__(self, bar: Bar, iterations: int | None, size: float):
        self.curve, self._bar, self._size = stopping.Curve(), bar, size
        self.last: Tensor | None = None
        self._length, self._before = iterations or 0, -(iterations or 0)

    def __call__(self, iterate: Iterate) -> bool:
        if iterate.number == 1:
            self.curve, self._before = stopping.Curve(), self._before + self._length
        self.curve(iterate)
        self.last = iterate.volume
        self._bar(self._before + iterate.number, _share(self.curve.residuals[-1], self._size))
        return False


def emission(scan: Scan, volume: Float[Tensor, "d h w"], device: str = "cpu") -> dict[str, float]:
    """The sensitivity of a system that counts, in counts per s and MBq at the centre of the grid,
    for all views at once and one photon per decay, attenuated as by the projector, and without
    factors; and the total in MBq of a volume in kBq/ml. Empty for line integrals.

    Joint scans, whose photons per decay differ, have no sensitivity.
    """
    if not scan.counts:
        return {}
    voxel, figures = scan.grid.affine[:3, :3].det().abs().item(), {}
    if not scan.parts:
        A = replace(scan, factors=None).operator().to(device)
        with torch.no_grad():
            seen = A.T(torch.ones(1, 1, *A.range_shape, device=device))[0, 0]
        middle = tuple(slice((n - 1) // 2, n // 2 + 1) for n in scan.grid.shape)
        figures["sensitivity_cps_per_mbq"] = 1e6 * seen[middle].mean().item() / voxel
    if scan.unit == CONCENTRATION:  # Bq / mm^3
        figures["total_mbq"] = 1e-6 * voxel * volume.sum(dtype=torch.float64).item()
    return figures


def left_out(scan: Scan, method: Method, device: str = "cpu") -> list[float]:
    """The relative error of each view as the method predicts it from the others."""
    module, A = method.module.to(device), scan.operator().to(device)
    views = scan.measured.whole().views[None, None].to(device)
    return stopping.left_out_residual(lambda A, y: module(y, A).volume, A, views)[0].tolist()


def _iterated(scan: Scan, method: Method, device: str, bar: Bar) -> _Run:
    bar.phase("reading")
    A, views = scan.posed(device)
    solver: Any = method.module
    options = {**solver.options}
    parameters = signature(solver.solve).parameters
    most, chosen = options.get("iterations", parameters["iterations"].default), {}
    trials = 0 if not method.choose else len(method.choose.get("weights") or [None])
    bar.phase(method.name, most and most * (1 + trials))
    if scan.scatter is not None:
        options["background"] = scan.scatter.to(device)
    size, scatter = views.norm().item(), options.get("background", 0.0)
    runs, lost = _RunMonitor(bar, most, size), lost_views(views[0, 0], 0)
    try:
        if method.choose:
            options["monitor"] = runs
            choice = stopping.held_out(solver.solve, A, views, options=options, **method.choose)
            volume = choice.volume
            chosen = {  # of the one sample that a scan is
                "iterations": choice.iterations[0],
                "weight": choice.weights[0] if choice.weights else None,
                "trials": [{"weight": t.weight, "errors": t.errors[0]} for t in choice.trials],
            }
        else:
            sigma = method.stop_sigma
            rules = () if sigma is None else (stopping.discrepancy(sigma),)
            monitor = stopping.combined(runs, *rules)
            volume = solver.solve(A, views, monitor=monitor, **options)
        check_volume(volume, method.name, views, A)
    except KeyboardInterrupt:
        if runs.last is None:
            raise
        last = runs.last  # in a trial of `choose` the volume of fewer views
        residuals = runs.curve.residuals
        stopped = Outcome(last[0, 0], residuals=residuals, lost=lost, stopped=len(residuals))
        return stopped, lambda: _share((views - A(last) - scatter).norm().item(), size)
    residuals = runs.curve.residuals
    rest = residuals[-1] if residuals else size  # nothing to explain: the volume stayed zero
    outcome = Outcome(volume[0, 0], residuals=residuals, chosen=chosen, lost=lost)
    return outcome, lambda: _share(rest, size)


def lost_views(views: Float[Tensor, "m v u"], first: int) -> list[int]:
    """The numbers of the views that are zero everywhere, counted from `first`."""
    return (first + (~views.flatten(1).any(dim=1)).nonzero().flatten()).tolist()


def _direct(scan: Scan, method: Method, device: str, bar: Bar) -> _Run:
    """A method that does not iterate, with all views in memory."""
    bar.phase("reading")
    whole = scan.measured.whole()
    bar.phase(method.name)
    A, views = scan.operator().to(device), whole.views[None, None].to(device)
    with torch.no_grad():
        out = method.module.to(device)(views, A)
    mask = whole.mask.to(device)

    def misfit() -> float:
        rest = (views - A(out.volume))[0, 0]
        return _share(rest[mask].norm().item(), views[0, 0][mask].norm().item())

    weights = [] if out.camera_weights is None else out.camera_weights[0].tolist()
    sigma = None if out.sigma is None else out.sigma[0, 0].cpu()
    lost = lost_views(whole.views, 0)
    return Outcome(out.volume[0, 0], sigma=sigma, camera_weights=weights, lost=lost), misfit


def _share(rest: float, whole: float) -> float:
    return rest / whole if whole else math.nan


def _streamed(scan: Scan, method: Method, _: str, bar: Bar) -> _Run:
    """A method that reads the views block by block, once, and some again for the misfit."""
    odd = Counter[str]()
    lost: list[int] = []
    bar.phase(method.name, len(scan.cameras))

    def read(first: int, last: int) -> Tensor:
        part = scan.measured.read(first, last)
        odd.update(part.odd)
        lost.extend(lost_views(part.views, first))
        bar(last)
        return part.views

    solver: Any = method.module
    volume = solver.solve.streamed(read, scan.cameras, scan.grid, **solver.options)[0, 0]
    scan.measured.warn_of_values(odd)
    count = len(scan.cameras)
    compared = range(0, count, math.ceil(count / COMPARED_VIEWS))
    outcome = Outcome(volume, compared_views=len(compared), lost=lost)
    return outcome, lambda: _residual(scan, volume, compared)


def _residual(scan: Scan, volume: Float[Tensor, "d h w"], numbers: range) -> float:
    """|y - A x| / |y| over the measured pixels of some views, in blocks."""
    squares, total = 0.0, 0.0
    size = max(1, COMPARED_PIXELS // math.prod(scan.cameras.shape))
    for first in range(0, len(numbers), size):
        some = numbers[first : first + size]
        A = scan.operator(slice(some.start, some.stop, some.step))
        for predicted, number in zip(A(volume[None, None])[0, 0], some, strict=True):
            part = scan.measured.read(number, number + 1)
            view, mask = part.views[0], part.mask[0]
            squares += (view - predicted)[mask].double().square().sum().item()
            total += view[mask].double().square().sum().item()
    return _share(squares**0.5, total**0.5)
