"""SPECT file formats: Interfile as written by STIR, STIR's pinhole systems, DICOM NM."""
