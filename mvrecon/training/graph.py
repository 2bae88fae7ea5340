"""The forward and the backward pass of a training step as one CUDA graph: the host starts all their
kernels at once, and no longer one by one.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mvrecon.operators.operator import Projector

#: Steps before a capture, in which kernels are compiled and memory is set up; as torch advises.
WARM_UP = 3


class Pass(NamedTuple):
    """What a forward and a backward pass give.

    Args:
        terms: of the loss, "total" among them.
        gradients: of the total by each weight; none where it does not depend on one.
    """

    terms: dict[str, Tensor]
    gradients: Sequence[Tensor | None]


#: Records what a function launches: what launches it again, and its first results, whose memory the
#: next ones overwrite.
Capture = Callable[[Callable[[], Pass]], tuple[Callable[[], None], Pass]]


def check_graph(
    trainer: Mapping[str, Any],
    method: Mapping[str, Any],
    data: Mapping[str, Any],
    A: Projector,
) -> None:
    """Refuse a training of which no CUDA graph can be made.

    Args:
        trainer: settings of the trainer.
        method: name and options of the method.
        data: settings of the data.
        A: the operator of the run.

    Raises:
        ValueError: no GPU, several of them, scaled losses, several rigs, cases with
            operators of their own, or a method whose sizes depend on its views.
    """
    precision = str(trainer.get("precision", "32-true"))
    gpu = trainer.get("accelerator", "auto") != "cpu" and torch.cuda.is_available()
    reasons = {
        "a GPU, got a training on a CPU": not gpu,
        f"one device, got trainer.devices={trainer.get('devices')}": trainer.get("devices", 1) != 1,
        f"gradients that are not scaled, got trainer.precision={precision}": precision[:2] == "16",
        f"one rig, got data.rigs={data.get('rigs')}": bool(data.get("rigs")),
        "one operator for all cases, got one of each case's own": A.per_case,
        "sizes that do not depend on views, got method.crop=true": bool(method.get("crop")),
        "a method that does not align views on the host, got aligned": method["name"] == "aligned",
    }
    if wrong := [reason for reason, applies in reasons.items() if applies]:
        raise ValueError(
            f"trainer.graph=true needs {wrong[0]}; trainer.graph=false trains without a CUDA graph"
        )


def captured(step: Callable[[], Pass]) -> tuple[Callable[[], None], Pass]:
    """A CUDA graph of a function, after a few calls of it on a stream aside.

    Raises:
        RuntimeError: the function waits for the device, or does what no graph can hold.
    """
    aside = torch.cuda.Stream()
    aside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(aside):
        for _ in range(WARM_UP):
            step()
    torch.cuda.current_stream().wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    try:
        # other threads may go on meanwhile, such as the one that pins the next batch's memory
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            results = step()
    except RuntimeError as problem:
        raise RuntimeError(
            f"No CUDA graph can be made of this training step, expected one that never waits for "
            f"the device ({str(problem).splitlines()[0]}); trainer.graph=false trains without"
        ) from problem
    return graph.replay, results


class GraphedLoss:
    """The loss of a batch, from a graph that is captured at the first one and computes the
    gradients, too.

    Batches of other sizes, such as the last of an epoch, are computed without the graph. Gradients
    are multiplied by that of the loss, so that several batches can be added up to a step.

    Args:
        loss: the terms of a batch's loss.
        weights: what is learned; they may change in place alone.
        capture: another way to capture than a CUDA graph.
    """

    def __init__(
        self,
        loss: Callable[[dict[str, Any]], dict[str, Tensor]],
        weights: Sequence[Tensor],
        capture: Capture = captured,
    ):
        self.loss, self.weights, self._capture = loss, list(weights), capture
        self._batch: dict[str, Tensor] = {}
        self._replay: Callable[[], None] | None = None
        self._last = Pass({}, [])

    def __call__(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """The terms of the loss of a batch."""
        tensors = {name: x for name, x in batch.items() if isinstance(x, Tensor)}
        if self._replay is None:
            self._batch = {name: x.clone() for name, x in tensors.items()}
            self._replay, self._last = self._capture(self._pass)
        if {name: x.shape for name, x in tensors.items()} != {
            name: x.shape for name, x in self._batch.items()
        }:
            return self.loss(batch)
        for name, x in tensors.items():
            self._batch[name].copy_(x)
        total = _Replayed.apply(self._replay, self._last, *self.weights)
        return {name: x.clone() for name, x in self._last.terms.items()} | {"total": total}

    def _pass(self) -> Pass:
        device = next(iter(self._batch.values())).device.type
        # weights that autocast has cast once would stay those of the capture
        cast = torch.autocast(
            device,
            torch.get_autocast_dtype(device),
            enabled=torch.is_autocast_enabled(device),
            cache_enabled=False,
        )
        with cast:
            terms = self.loss(dict(self._batch))
        gradients = torch.autograd.grad(terms["total"], self.weights, allow_unused=True)
        return Pass({name: x.detach() for name, x in terms.items()}, gradients)


class _Replayed(torch.autograd.Function):
    """The total of a loss whose gradients are known with it."""

    @staticmethod
    def forward(ctx: Any, replay: Callable[[], None], last: Pass, *weights: Tensor) -> Tensor:
        replay()
        ctx.gradients = last.gradients
        return last.terms["total"].clone()

    @staticmethod
    def backward(ctx: Any, *outputs: Any) -> Any:
        (factor,) = outputs
        return None, None, *(None if g is None else g * factor for g in ctx.gradients)
