"""A plugin for tests of several processes: each writes down its weights at the end of a training,
and the one that `MVRECON_KILL` names (rank and step) is killed.
"""

import os
import signal
from pathlib import Path

import torch

from mvrecon.training.module import ReconstructionModule

STEP = ReconstructionModule.training_step


def weights(self):
    """Write down the weights of this process."""
    flat = torch.cat([p.detach().flatten() for p in self.method.parameters()])
    torch.save(flat, Path(self.trainer.default_root_dir) / f"weights{self.trainer.global_rank}.pt")


def step(self, batch, batch_idx):
    """A training step, unless it is this process's last."""
    if os.environ.get("MVRECON_KILL") == f"{self.trainer.global_rank} {self.global_step}":
        os.kill(os.getpid(), signal.SIGKILL)
    return STEP(self, batch, batch_idx)


ReconstructionModule.on_train_end = weights  # type: ignore[method-assign]
ReconstructionModule.training_step = step  # type: ignore[method-assign]
