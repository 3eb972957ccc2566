"""Bridges of daemons' topics: to a Zenoh network, for fleets and Zenoh clients; to ROS 2 (`ros2`).

Each is a subscriber in a process of its own: what happens on the network never delays a tick.
"""
