"""Lightning's loop over the batches of an epoch, with optimiser steps of equally many batches."""

from typing import Any

from lightning.pytorch.loops import _TrainingEpochLoop


class WholeSteps(_TrainingEpochLoop):
    """Takes an optimiser step after every `accumulate_grad_batches` batches, counted from the
    beginning of the training.

    Lightning counts them within each epoch, and steps at its end with however many there are: with
    5 batches per epoch and steps of 4, every other step would be of a single batch. Here an
    accumulation continues in the next epoch; the module keeps its gradients (see
    `ReconstructionModule.optimizer_step`).
    """

    def _should_accumulate(self) -> bool:
        return self.batch_progress.total.ready % self.trainer.accumulate_grad_batches != 0

    def reset(self) -> None:
        """Number the logged steps and the epochs of a resumed training like an uninterrupted one's:
        Lightning does not count an epoch as begun that it begins after a break.
        """
        super().reset()
        if self.restarting:
            self._batches_that_stepped = self.global_step
        progress: Any = self.trainer.fit_loop.epoch_progress
        for counts in (progress.total, progress.current):
            counts.ready = counts.started = counts.processed + 1

    def _should_check_val_epoch(self) -> bool:
        """Whether the epoch of the last batch is validated. In a training that stopped after the
        last batch of an epoch, Lightning has counted that epoch, and no batch of the next one.
        """
        every = self.trainer.check_val_every_n_epoch
        stopped = self.restarting and self.restarted_on_train_batch_end
        if every is None or not stopped or self.batch_progress.current.ready:
            return super()._should_check_val_epoch()
        return self.trainer.enable_validation and self.trainer.current_epoch % every == 0

    def advance(self, data_fetcher: Any) -> None:
        """Train on a batch; a training that stopped at the end of an epoch resumes after it, and
        one that stopped before or in a validation with that, which Lightning leaves out.

        Raises:
            StopIteration: no batch is left in a resumed epoch.
        """
        if self.restarted_on_train_batch_end and self._should_check_val_fx(data_fetcher):
            # logged as of the step before it was counted
            self._batches_that_stepped -= not self._should_accumulate()
            return
        ended = self.restarting and self._num_ready_batches_reached()
        if ended and not self._should_check_val_fx(data_fetcher):
            raise StopIteration
        super().advance(data_fetcher)

    def on_advance_end(self, data_fetcher: Any) -> None:
        """Count steps, which Lightning counts twice or not at all after some checkpoints."""
        super().on_advance_end(data_fetcher)
        self._batches_that_stepped = self.global_step


def optimizer_steps(trainer: Any) -> float:
    """Number of optimiser steps of a whole training; infinite if it has no end."""
    steps, epochs = trainer.estimated_stepping_batches, trainer.max_epochs
    if epochs is None or epochs < 0:
        return steps
    return min(steps, epochs * trainer.num_training_batches // trainer.accumulate_grad_batches)
