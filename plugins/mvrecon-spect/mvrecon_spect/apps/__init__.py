"""Commands that measure volumes and views."""
