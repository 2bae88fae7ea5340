"""Pictures of volumes and views, as arrays."""
