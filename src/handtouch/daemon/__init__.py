"""Slab of samples -> tick -> contacts -> messages: the daemon and its replay."""
