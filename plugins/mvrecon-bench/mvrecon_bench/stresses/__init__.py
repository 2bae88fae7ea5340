"""The stress plan: what a part must bear, case by case, and what was measured."""
