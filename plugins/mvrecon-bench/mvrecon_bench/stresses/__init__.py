"""The stress plan: cases, what each asks of a part, and the measured violation."""
