"""The stress plan: cases, their requirements, and measured violations."""
