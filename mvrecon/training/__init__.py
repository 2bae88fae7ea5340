"""Training with Lightning, evaluation, and the files of a run."""
