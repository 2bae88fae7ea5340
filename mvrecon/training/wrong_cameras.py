"""What a method tells of its cameras, for `results.json`."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import torch

from mvrecon.methods.calibration.alignment import Alignment
from mvrecon.report.metrics import camera_metrics

#: Standard errors from which a camera counts as wrong.
CLEAR = 3.0
#: Of the weight that each camera would have if all had the same: below, its view may be wrong.
LITTLE = 0.4
#: The true shifts and gains of a batch, and which cameras are wrong, by their names in it.
TRUTH = ("shift_px", "gain", "wrong")


def cameras_of(alignment: Alignment | None, scene: Mapping[str, Any]) -> dict[str, Any]:
    """What a method tells of the cameras of one scene, beside the truth where it is known."""
    if alignment is None:
        return {}
    truth = {f"true_{key}": scene[key] for key in TRUTH if key in scene}
    return {"cameras": alignment, **truth}


def camera_row(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Shifts (pixels), gains and their errors of every camera in every scene, and the figures of
    `camera_metrics` where the truth is known; empty where a method tells nothing.
    """
    known = [score for score in scores if "cameras" in score]
    if not known:
        return {}
    by = Alignment.joined([score["cameras"] for score in known])
    row = {"deviation": by.deviation().tolist()}
    row |= {field.name: getattr(by, field.name).tolist() for field in fields(Alignment)}
    if all("true_gain" in score for score in known):
        truth = (torch.cat([score[f"true_{key}"] for score in known]) for key in TRUTH)
        row |= camera_metrics(by, *truth)
    return {"cameras": row}


def sentences(row: Mapping[str, Any] | None) -> list[str]:
    """One line for each camera of the first scene whose shift or gain is more than `CLEAR` of its
    standard errors from none, the worst first.
    """
    if row is None:
        return []
    names = [field.name for field in fields(Alignment)]
    by = Alignment(*(torch.tensor(row[name])[:1] for name in names))
    shift = by.shift_px.abs() > CLEAR * by.shift_error
    clear = (shift.any(dim=-1) | ((by.gain - 1).abs() > CLEAR * by.gain_error))[0]
    order = by.deviation()[0].argsort(descending=True)
    return [_sentence(by, int(m)) for m in order if clear[m]]


def _sentence(by: Alignment, m: int) -> str:
    (u, v), (u_error, v_error) = by.shift_px[0, m].tolist(), by.shift_error[0, m].tolist()
    return (
        f"camera {m}: shifted by {u:+.2f} +- {u_error:.2f} columns and {v:+.2f} +- {v_error:.2f} "
        f"rows, gain {by.gain[0, m]:.3f} +- {by.gain_error[0, m]:.3f}"
    )


def little_weight(weights: Sequence[float]) -> list[str]:
    """One line for each camera to which a network gives little weight, the least first."""
    equal = 1 / max(1, len(weights))
    order = sorted(range(len(weights)), key=lambda m: weights[m])
    return [
        f"camera {m}: the network gives it a weight of {weights[m]:.3f} (equal: {equal:.3f}); its "
        f"view may be wrong"
        for m in order
        if weights[m] < LITTLE * equal
    ]
