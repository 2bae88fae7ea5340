"""Ctrl-C during training reports how to resume."""

import sys
from pathlib import Path

import pytest

from mvrecon.training.resume import report_checkpoint


@pytest.mark.parametrize("kept", [False, True])
def test_ctrl_c_reports_how_to_resume(kept: bool, tmp_path: Path, capsys):
    """Lightning turns it into an exit without a word; the status is that of the signal, and the
    report is given once. Also tried: SIGTERM.
    """
    run = tmp_path / "run"
    last = run / "checkpoints" / "cross_view_small" / "last.ckpt"
    last.parent.mkdir(parents=True)
    if kept:
        last.touch()
    then = "resumes it" if kept else "starts again"
    message = f"Stopped by Ctrl-C; .*mvrecon-train resume={run} {then}"
    with pytest.raises(SystemExit, match=message) as stop, report_checkpoint(last):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            sys.exit(1)
    assert stop.value.code == 130 and capsys.readouterr().err == f"{stop.value}\n"


def test_other_exits_are_unchanged(tmp_path: Path):
    with (
        pytest.raises(SystemExit) as stop,
        report_checkpoint(tmp_path / "a" / "b" / "c" / "last.ckpt"),
    ):
        sys.exit(3)
    assert stop.value.code == 3
