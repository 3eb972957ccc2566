"""Recordings: capture to MCAP, exact replay, comparison, export and plots."""
