"""Operators of pinhole SPECT: footprints of voxels, attenuation, response of hole and detector."""
