"""Displays of a running hand: text lines, a live table in the terminal, a page in the browser."""
