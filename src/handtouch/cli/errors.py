"""Texts of errors on the command line.

Public name: `file_error_text`.
"""

from __future__ import annotations


def file_error_text(error: Exception) -> str:
    """Return "FILE: reason" for an error of the operating system, else the error's own text."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {(error.strerror or str(error)).lower()}"
    return str(error)
