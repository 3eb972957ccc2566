"""Bridge of daemons' topics to a Zenoh network, for fleets and for Zenoh clients.

A subscriber in a process of its own: what happens on the network never delays a tick.
"""
