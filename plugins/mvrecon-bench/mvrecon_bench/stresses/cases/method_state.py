"""State of a method: saving and loading weights, repeated calls, the global generator."""

import io

import torch

from mvrecon.testing.measures import bits
from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.cases.methods import SINGLE
from mvrecon_bench.stresses.learned_subjects import MethodSubject


def saved(subject: MethodSubject) -> float:
    """Number of values in which the volume differs after loading saved weights into a new
    method.
    """
    file = io.BytesIO()
    torch.save(subject.used.func.state_dict(), file)  # pyrefly: ignore[missing-attribute]
    file.seek(0)
    other = subject.method()
    other.load_state_dict(torch.load(file, weights_only=True))
    with torch.no_grad():
        volume = other(subject.views[:1], subject.A).volume
        return bits(volume, subject.used(subject.views[:1]).volume)


def twice(subject: MethodSubject) -> float:
    """Number of values in which volumes and view gradients differ between two calls."""
    runs = []
    learned = any(True for _ in subject.used.func.parameters())  # some classical methods reject it  # pyrefly: ignore[missing-attribute]
    for _ in range(2):
        views = subject.views[:1].clone().requires_grad_(learned)
        volume = subject.used(views).volume
        slope = torch.autograd.grad(volume.sum(), views)[0] if volume.requires_grad else views
        runs.append(torch.cat([volume.detach().flatten(), slope.detach().flatten()]))
    return bits(*runs)


def randomness(subject: MethodSubject) -> float:
    """Evaluation does not use the global generator."""
    method, views = subject.used, subject.views[:1]  # initialisation draws weights
    before = torch.random.get_rng_state()
    with torch.no_grad():
        method(views)
    return bits(torch.random.get_rng_state(), before)


CASES = (
    Case(70, "weights saved and loaded", "the same volume", "method", saved, dtypes=SINGLE),
    Case(74, "two runs", "the same volume and gradients", "method", twice),
    Case(75, "the global generator", "is not used", "method", randomness),
)
