"""Estimated errors of the cameras: tables against the truth, and sentences on faulty cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import TypedDict

from mvrecon.data.dataset import Batch
from mvrecon.methods.method import Alignment
from mvrecon.report.metrics import auc

#: Standard errors from which a camera counts as faulty.
MIN_STANDARD_ERRORS = 3.0
#: Weight relative to uniform weights, below which a view may be faulty.
MAX_FAULTY_WEIGHT = 0.4
#: True shifts and gains of a batch, and the faulty cameras, by their names in it.
TRUE_KEYS = ("shift_px", "gain", "wrong")


class CameraEstimates(TypedDict, total=False):
    """A method's estimates of the cameras of one case, and the truth where it is known."""

    cameras: Alignment
    true_shift_px: Float[Tensor, "1 m 2"]
    true_gain: Float[Tensor, "1 m"]
    true_wrong: Bool[Tensor, "1 m"]


def camera_metrics(
    by: Alignment,
    shift_px: Float[Tensor, "b m 2"],
    gain: Float[Tensor, "b m"],
    wrong: Bool[Tensor, "b m"],
) -> dict[str, float]:
    """Root-mean-square errors of estimated shifts (pixels) and gains over all cameras, those of
    zero estimates, and the AUC of detecting faulty cameras.

    Args:
        by: the estimates of b cases.
        shift_px, gain: the truth.
        wrong: the faulty cameras, those with any error.
    """
    return {
        "auc": auc(by.deviation(), wrong),
        "shift_rms_px": _rms(by.shift_px - shift_px),
        "gain_rms": _rms(by.gain - gain),
        "true_shift_rms_px": _rms(shift_px),
        "true_gain_rms": _rms(gain - 1),
    }


def _rms(error: Tensor) -> float:
    return error.double().square().mean().sqrt().item()


def cameras_of(alignment: Alignment | None, scene: Batch) -> CameraEstimates:
    """A method's estimates of the cameras of one scene, with the truth if known."""
    if alignment is None:
        return {}
    truth: Any = {f"true_{key}": scene[key] for key in TRUE_KEYS if key in scene}
    return {"cameras": alignment, **truth}


def camera_row(scores: Sequence[CameraEstimates]) -> dict[str, dict[str, Any]]:
    """Shifts (pixels), gains and their errors of every camera in every scene, and `camera_metrics`
    if the truth is known; empty without estimates.
    """
    known: list[Any] = [score for score in scores if "cameras" in score]
    if not known:
        return {}
    by = Alignment.joined([score["cameras"] for score in known])
    row = {"deviation": by.deviation().tolist()}
    row |= {field.name: getattr(by, field.name).tolist() for field in fields(Alignment)}
    if all("true_gain" in score for score in known):
        truth = (torch.cat([score[f"true_{key}"] for score in known]) for key in TRUE_KEYS)
        row |= camera_metrics(by, *truth)
    return {"cameras": row}


def disturbed_cameras(row: Mapping[str, Any] | None) -> list[str]:
    """Describe each camera of the first scene whose shift or gain exceeds `MIN_STANDARD_ERRORS`
    standard errors, the worst first.
    """
    if row is None:
        return []
    names = [field.name for field in fields(Alignment)]
    by = Alignment(*(torch.tensor(row[name])[:1] for name in names))
    shift = by.shift_px.abs() > MIN_STANDARD_ERRORS * by.shift_error
    clear = (shift.any(dim=-1) | ((by.gain - 1).abs() > MIN_STANDARD_ERRORS * by.gain_error))[0]
    order = by.deviation()[0].argsort(descending=True)
    lines = []
    for m in (int(m) for m in order if clear[m]):
        if by.gain[0, m] == 0:
            lines.append(f"camera {m}: its view is lost")
            continue
        (u, v), (u_error, v_error) = by.shift_px[0, m].tolist(), by.shift_error[0, m].tolist()
        lines.append(
            f"camera {m}: shifted by {u:+.2f} +- {u_error:.2f} columns and {v:+.2f} +- "
            f"{v_error:.2f} rows, gain {by.gain[0, m]:.3f} +- {by.gain_error[0, m]:.3f}"
        )
    return lines


def little_weight(weights: Sequence[float]) -> list[str]:
    """Describe each camera with a small weight, the smallest first."""
    equal = 1 / max(1, len(weights))
    order = sorted(range(len(weights)), key=lambda m: weights[m])
    return [
        f"camera {m}: the network gives it a weight of {weights[m]:.3f} (equal: {equal:.3f}); its "
        f"view may be wrong"
        for m in order
        if weights[m] < MAX_FAULTY_WEIGHT * equal
    ]
