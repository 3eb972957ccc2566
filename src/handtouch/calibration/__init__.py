"""Calibration of one pad's node: immutable records, their store, and calibration by ordinary contacts."""
