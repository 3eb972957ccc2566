"""Nodes of a hand from the master's side: boot-up, supervision, recovery."""
