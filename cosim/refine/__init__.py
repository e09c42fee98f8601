"""Measured data: log → replay → residual → attribution → calibration → refined model → replay again → report."""
