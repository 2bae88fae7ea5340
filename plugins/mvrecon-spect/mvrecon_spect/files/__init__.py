"""SPECT's own files: Interfile as STIR writes it, STIR's pinhole systems, DICOM NM."""
