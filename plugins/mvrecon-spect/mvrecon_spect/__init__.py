"""Multi-pinhole SPECT as a plugin of mvrecon."""
