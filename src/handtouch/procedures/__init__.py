"""Procedures around a deployment: check, doctor, scan, commissioning, calibration by weights."""
