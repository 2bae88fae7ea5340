"""Which of a run's processes this one is, by the environment that torchrun, srun or mvrecon gives
it.
"""

import os

#: Variables with the number of this process and with the number of all, by precedence.
RANKS, WORLDS = ("RANK", "SLURM_PROCID"), ("WORLD_SIZE", "SLURM_STEP_NUM_TASKS")


def rank() -> int:
    """Number of this process among those of its run; the first, 0, writes the run's files."""
    return _number(RANKS, 0) if world() > 1 else 0


def world() -> int:
    """Number of processes that a launcher outside has started for this run; 1 without a
    launcher.
    """
    return _number(WORLDS, 1)


def _number(names: tuple[str, ...], default: int) -> int:
    return int(next((os.environ[name] for name in names if name in os.environ), default))
