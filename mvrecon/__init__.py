"""mvrecon: volumes from several cameras' views, by networks that know the cameras' geometry."""

__version__ = "0.1.0"
