"""Compare the modes of one task of `bench=skip`: result, error and time of each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mvrecon_bench.benchmarks.measure import interleaved, once, with_memory
from mvrecon_bench.benchmarks.rows import Row
from mvrecon_bench.benchmarks.skip_tasks import CROPPED, OFF, SkipTrial
from mvrecon_bench.benchmarks.trial import reason

#: Duration of a call in seconds above which each mode is timed once.
LONG_S = 10.0


@dataclass(frozen=True, eq=False)
class Tried:
    """A working mode: its trial, seconds per call, and figures so far."""

    trial: SkipTrial
    seconds: float
    row: Row


def compared(
    setup: Callable[[str], SkipTrial], modes: Sequence[str], repeats: int, device: str
) -> dict[str, Row]:
    """The figures of every mode, with "off" first as the reference result.

    An error of a mode becomes the status of its row; the run continues.
    """
    rows: dict[str, Row] = {}
    tried: dict[str, Tried] = {}
    reference: Tensor | None = None
    for mode in modes:
        try:
            trial = setup(mode)
            once(trial.call, device)  # compiles and fills caches
            (result, seconds), peak = with_memory(
                lambda call=trial.call: once(call, device), device
            )
            whole = trial.whole(result)
            reference = whole if mode == OFF else reference
            row = {"peak_mb": peak, **difference(whole, reference), **_built(trial, device)}
            row |= {"psnr": trial.score()} if trial.score is not None else {}
        except Exception as error:
            rows[mode] = {"status": f"skipped: {reason(error)}"}
        else:
            tried[mode] = Tried(trial, seconds, row)
    return rows | _timed(tried, repeats, device)


def difference(result: Tensor, reference: Tensor | None) -> Row:
    """Maximum absolute difference, and number of values that differ in any bit."""
    if reference is None:
        return {}
    bits = [values.contiguous().view(torch.int32) for values in (result, reference)]
    return {
        "error": (result - reference).abs().max().item(),
        "differing": int((bits[0] != bits[1]).sum()),
    }


def _built(trial: SkipTrial, device: str) -> Row:
    if trial.build is None:
        return {}
    once(trial.build, device)
    return {"build_ms": 1e3 * once(trial.build, device)[1]}


def _timed(tried: dict[str, Tried], repeats: int, device: str) -> dict[str, Row]:
    """Time all modes alternately, then compare each with the two that skip nothing."""
    modes = list(tried)
    seconds = {n: tried[mode].seconds for n, mode in enumerate(modes)}
    repeats = 1 if max(seconds.values(), default=0.0) > LONG_S else repeats
    times = interleaved(
        {n: tried[mode].trial.call for n, mode in enumerate(modes)}, seconds, repeats, device
    )
    rows = {}
    for n, mode in enumerate(modes):
        trial, row = tried[mode].trial, tried[mode].row
        charge = row.get("build_ms", 0.0) if trial.charged else 0.0
        chosen, why = trial.choice()
        rows[mode] = {
            **row,
            "ms": times[n].ms + charge,
            "calls": times[n].calls,
            "chosen": chosen,
            "why": why,
        }
    for row in rows.values():
        for name, unit in (("over_full", OFF), ("over_crop", CROPPED)):
            if unit in rows:
                row[name] = rows[unit]["ms"] / row["ms"]
        if "psnr" in row and "psnr" in rows.get(OFF, {}):
            row["psnr_loss"] = rows[OFF]["psnr"] - row["psnr"]
        row["status"] = "ok"
    return rows
