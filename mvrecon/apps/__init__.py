"""The command-line apps and their configuration."""
