"""Methods that map views and an operator to a reconstruction: classical, learned, calibration."""
