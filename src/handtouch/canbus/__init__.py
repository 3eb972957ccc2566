"""CANopen: the master's side, which boots and watches the nodes of a hand, and a simulated node's side."""

import logging

# Both libraries log every time-out and every failed attempt to open a bus; here these are counted and told as
# reasons. The application's own logging still gets them if it asks.
logging.getLogger("can").addHandler(logging.NullHandler())
logging.getLogger("canopen").addHandler(logging.NullHandler())
