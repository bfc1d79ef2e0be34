"""The uncertainty of the calibrated arm, input by input."""
