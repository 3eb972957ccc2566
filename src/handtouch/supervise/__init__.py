"""Watches over every sensor: what is wrong with a pad, and what helps."""
