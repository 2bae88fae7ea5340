"""Group normalisation and SiLU as one step."""
