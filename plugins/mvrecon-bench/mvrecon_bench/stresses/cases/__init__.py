"""Cases of the stress plan, by subject matter."""
