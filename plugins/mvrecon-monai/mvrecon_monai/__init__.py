"""Networks of MONAI as networks of mvrecon."""
