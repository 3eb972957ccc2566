"""Procedures around a deployment: check, doctor, scan, conformance, commissioning, calibration by weights."""
