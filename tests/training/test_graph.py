"""A training step as one CUDA graph: what can be known of it without a GPU."""

import contextlib
from types import SimpleNamespace

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.training import fit
from mvrecon.training.graph import GraphedLoss, Pass, captured, check_graph

TRAINER = {"accelerator": "gpu", "devices": 1, "precision": "bf16-mixed"}
METHOD, DATA = {"name": "cross_view", "support": "none"}, {"rigs": 0}


def again(step):
    """A stand-in for a graph: the same memory with new numbers in it."""
    last = step()

    def replay():
        with torch.enable_grad():
            new = step()
        pairs = [(last.terms[name], x) for name, x in new.terms.items()]
        for old, x in [*pairs, *zip(last.gradients, new.gradients, strict=True)]:
            if old is not None:
                old.copy_(x)

    return replay, last


def trained(graph: bool, sizes=(2, 2, 2, 1)) -> dict[str, torch.Tensor]:
    """The weights of a small network after some steps of two batches each."""
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1))
    net.register_parameter("idle", torch.nn.Parameter(torch.ones(2)))
    optimizer = torch.optim.AdamW(net.parameters(), lr=0.1)
    loss = lambda batch: {"total": (net(batch["x"]) - batch["y"]).square().mean()}  # noqa: E731
    if graph:
        loss = GraphedLoss(loss, list(net.parameters()), again)
    for size in sizes:
        for _ in range(2):
            batch = {"x": torch.randn(size, 3), "y": torch.randn(size, 1), "name": ["a"] * size}
            (loss(batch)["total"] / 2).backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 0.5)
        optimizer.step()
        optimizer.zero_grad()
    return net.state_dict()


def test_training_with_a_graph_has_the_same_bits():
    """With batches that are added up, gradients that are clipped, a weight that nothing depends on,
    and a last batch of another size.
    """
    plain, graphed = trained(False), trained(True)
    assert all(torch.equal(plain[name], graphed[name]) for name in plain)
    one = trained(True, sizes=(2,))
    assert not torch.equal(one["0.weight"], graphed["0.weight"])


def test_autocast_keeps_no_weights_of_the_capture():
    """They would be those of the first step for ever."""
    caching = []

    def loss(batch):
        caching.append((torch.is_autocast_enabled("cpu"), torch.is_autocast_cache_enabled()))
        return {"total": (batch["x"] * weight).sum()}

    weight = torch.ones(3, requires_grad=True)
    with torch.autocast("cpu", torch.bfloat16):
        GraphedLoss(loss, [weight], again)({"x": torch.ones(3)})
    assert set(caching) == {(True, False)}


REFUSED = {
    "no GPU": ({"accelerator": "cpu"}, {}, {}, "a GPU, got a training on a CPU"),
    "several devices": ({"devices": 2}, {}, {}, "one device, got trainer.devices=2"),
    "scaled losses": ({"precision": "16-mixed"}, {}, {}, "got trainer.precision=16-mixed"),
    "a crop": ({}, {"support": "hull", "crop": True}, {}, "got method.crop=true"),
    "many rigs": ({}, {}, {"rigs": 4}, "one rig, got data.rigs=4"),
    "alignment": ({}, {"name": "aligned"}, {}, "got aligned"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_no_graph_can_hold_is_refused(what, monkeypatch):
    """trainer.graph=true is refused in one sentence where no CUDA graph can hold a training
    step.
    """
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    A, own = SimpleNamespace(per_case=False), SimpleNamespace(per_case=True)
    check_graph(TRAINER, METHOD, DATA, A)
    check_graph(TRAINER, METHOD | {"support": "hull"}, DATA, A)  # on the whole grid
    trainer, method, data, message = REFUSED[what]
    with pytest.raises(ValueError, match=f"trainer.graph=true needs .*{message}; trainer.graph=f"):
        check_graph(TRAINER | trainer, METHOD | method, DATA | data, A)
    with pytest.raises(ValueError, match="one operator for all cases"):
        check_graph(TRAINER, METHOD, DATA, own)


def test_a_run_on_a_cpu_says_that_it_has_no_graph(tmp_path):
    settings = compose("experiment=smoke", "trainer.graph=true", "trainer.accelerator=cpu")
    with pytest.raises(ValueError, match="trainer.graph=true needs a GPU"):
        fit.fit("cross_view_small", settings, fit.build_data(settings), tmp_path)


def test_a_step_that_cannot_be_captured_says_why(monkeypatch):
    """Three steps run first, on a stream aside."""
    calls = []

    class Failing(contextlib.nullcontext):
        def __exit__(self, *_):
            raise RuntimeError("operation not permitted when stream is capturing\nmore")

    stream = SimpleNamespace(wait_stream=lambda other: None)
    for name, value in {
        "Stream": lambda: stream,
        "current_stream": lambda: stream,
        "stream": lambda _: contextlib.nullcontext(),
        "CUDAGraph": SimpleNamespace,
        "graph": lambda graph, capture_error_mode: Failing(),
    }.items():
        monkeypatch.setattr(torch.cuda, name, value)
    with pytest.raises(RuntimeError, match="No CUDA graph .* not permitted when stream is captu"):
        captured(lambda: calls.append(1) or Pass({}, []))
    assert len(calls) == 4
