"""Images of volumes and views for review, as arrays of 8-bit colours."""
