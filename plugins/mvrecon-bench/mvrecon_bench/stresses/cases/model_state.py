"""State of a model: weights saved and loaded, the same views twice, the global random generator."""

import io

import torch

from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.cases.models import SINGLE
from mvrecon_bench.stresses.learned_subjects import ModelSubject
from mvrecon_bench.stresses.subject import bits


def saved(subject: ModelSubject) -> float:
    """Weights saved, and loaded into a new model: its answer differs in so many values."""
    file = io.BytesIO()
    torch.save(subject.used.state_dict(), file)
    file.seek(0)
    other = subject.model()
    other.load_state_dict(torch.load(file, weights_only=True))
    with torch.no_grad():
        return bits(other(subject.views[:1]).volume, subject.used(subject.views[:1]).volume)


def twice(subject: ModelSubject) -> float:
    """The same views twice: volumes, and gradients by the views, differ in so many values."""
    runs = []
    for _ in range(2):
        views = subject.views[:1].clone().requires_grad_()
        volume = subject.used(views).volume
        slope = torch.autograd.grad(volume.sum(), views)[0] if volume.requires_grad else views
        runs.append(torch.cat([volume.detach().flatten(), slope.detach().flatten()]))
    return bits(*runs)


def randomness(subject: ModelSubject) -> float:
    """Evaluation draws nothing from the global generator."""
    model, views = subject.used, subject.views[:1]  # making it draws its weights
    before = torch.random.get_rng_state()
    with torch.no_grad():
        model(views)
    return bits(torch.random.get_rng_state(), before)


CASES = (
    Case(70, "weights saved and loaded", "the same volume", "model", saved, dtypes=SINGLE),
    Case(74, "twice the same", "the same volume and gradients", "model", twice),
    Case(75, "the global generator", "is left alone", "model", randomness),
)
