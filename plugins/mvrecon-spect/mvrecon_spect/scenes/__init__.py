"""Scenes of SPECT: what emits, and the matter that attenuates it."""
