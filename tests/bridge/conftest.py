"""Tests of the bridges that need no network."""

from importlib.util import find_spec

# there are no wheels of Cyclone DDS but for x86_64
collect_ignore = [] if find_spec("cyclonedds") else ["test_ros2.py"]
