"""Networks that turn views into a volume."""
