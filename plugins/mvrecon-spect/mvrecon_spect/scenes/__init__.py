"""Scenes of SPECT: activity and attenuation."""
