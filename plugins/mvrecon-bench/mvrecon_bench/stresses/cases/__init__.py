"""The cases of the stress plan, by what they are about."""
