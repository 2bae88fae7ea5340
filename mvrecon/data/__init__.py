"""Files, volumes, and the samples that a network trains on."""
