"""Bridge of one daemon to ROS 2: its messages as ROS types over DDS, without ROS installed.

A subscriber in a process of its own: what happens on the network never delays a tick.
"""
