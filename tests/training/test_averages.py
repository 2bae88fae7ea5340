"""Averaged weights of a resumed run: the averages and their counters are those of an uninterrupted
run.
"""

import pytest

from mvrecon.apps.config import compose
from mvrecon.training import fit
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.settings import TrainSettings
from tests.training import lives

STEPS = 8
#: Every other step, and every epoch.
AVERAGED = ("+callbacks.ema.update_every_n_steps=2", "+callbacks.ema.update_starting_at_epoch=0")
CASES = {
    "judged within epochs": (),
    "judged at epochs' ends": ("trainer.val_check_interval=5",),
    "never judged": ("+trainer.limit_val_batches=0",),
}


def trained(folder, options, broken=None):
    """Result of a training with five steps per epoch that is interrupted at a step and resumes from
    its last checkpoint.
    """
    steps = f"trainer.max_steps={STEPS}"
    settings = TrainSettings(**compose(*lives.OPTIONS, *AVERAGED, *options, steps))
    if broken is not None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ReconstructionModule, "training_step", ReconstructionModule.training_step)
            lives.counted(
                ReconstructionModule, "training_step", broken, lives.raising(MemoryError())
            )
            with pytest.raises(MemoryError):
                fit.fit(lives.METHOD, settings, fit.build_data(settings), folder)
    fit.fit(lives.METHOD, settings, fit.build_data(settings), folder)
    return lives.state(folder)


@pytest.mark.parametrize("case", CASES)
def test_an_interruption_changes_no_bit_of_the_averages(case, tmp_path):
    whole = trained(tmp_path / "whole", CASES[case])
    # of the two epochs one is not whole
    assert whole["averaging_state"]["n_averaged"] == STEPS // 2 + 2
    assert lives.different(whole, trained(tmp_path / "broken", CASES[case], 6)) == []
